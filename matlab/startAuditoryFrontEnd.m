function startAuditoryFrontEnd(varargin)
%STARTAUDITORYFRONTEND  Call the function of this name of Two!Ears if it is on the path; otherwise do nothing.

rosafe.callOther(mfilename(), fileparts(mfilename('fullpath')), varargin{:});
end
