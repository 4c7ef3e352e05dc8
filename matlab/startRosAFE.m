function startRosAFE()
%STARTROSAFE  Add the folder of this file to the path. The examples of the original call it first.

addpath(fileparts(mfilename('fullpath')));
end
