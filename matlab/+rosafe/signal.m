function obj = signal(class_name, varargin)
%SIGNAL  Construct one of the signal classes: rosafe.signal('FeatureSignal', fs, bufferSize_s, ...)
%
%   The object has the class name of the original (FeatureSignal). If another class of this name is first on the path,
%   for example that of the MATLAB Auditory Front-End with other constructors, it is a rosafe.FeatureSignal.

here = fileparts(fileparts(mfilename('fullpath')));
if ~strcmp(which(class_name), fullfile(here, [class_name '.m']))
    class_name = ['rosafe.' class_name];
end
obj = feval(class_name, varargin{:});
end
