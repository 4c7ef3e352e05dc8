function p = genParStruct(varargin)
%GENPARSTRUCT  Create a structure of parameters: genParStruct('fb_nChannels', 16, 'ild_wSizeSec', 0.03)

if mod(nargin, 2) || ~iscellstr(varargin(1:2:end))
    error('genParStruct:arguments', 'genParStruct: expected pairs of a name and a value');
end
p = struct();
for k = 1:2:nargin
    p.(varargin{k}) = varargin{k + 1};
end
end
