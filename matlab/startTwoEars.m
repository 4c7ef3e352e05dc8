function startTwoEars(varargin)
%STARTTWOEARS  Call the function of this name of Two!Ears if it is on the path; otherwise do nothing.
%
%   Two!Ears sets up its paths with it: startTwoEars(), startTwoEars('Config.xml'). rosAFE needs none of them.

rosafe.callOther(mfilename(), fileparts(mfilename('fullpath')), varargin{:});
end
