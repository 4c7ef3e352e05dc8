function startRosAFE()
%STARTROSAFE  Put the folder of this file on the path, for the examples of the original begin so.

addpath(fileparts(mfilename('fullpath')));
end
