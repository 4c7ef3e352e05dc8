function callOther(name, folder, varargin)
%CALLOTHER  Call the next function of this name on the path, with our FOLDER behind its folder; without one, do nothing.
%
%   It is for functions that stand in for Two!Ears, so that an installed Two!Ears is used if our folder precedes it.

folders = strsplit(path(), pathsep());
others = folders(~strcmp(folders, folder) & ~strcmp(folders, '.'));
if ~strcmp(pwd(), folder) && any(cellfun(@(other) exist(fullfile(other, [name '.m']), 'file') == 2, others))
    addpath(folder, '-end');
    restored = onCleanup(@() addpath(folder));
    feval(name, varargin{:});
end
end
