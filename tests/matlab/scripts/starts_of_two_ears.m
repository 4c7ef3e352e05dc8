% Functions of Two!Ears, which add folders to the path: without Two!Ears nothing happens; with it, before or behind our
% folder, its own functions are called.
ours = path();
startTwoEars; startTwoEars(); startTwoEars('Config.xml'); startTwoEars('info'); startAuditoryFrontEnd;
show('unchanged', strcmp(ours, path()));
addpath(fullfile(pwd, 'TwoEars'));
startTwoEars;
startRosAFE;
startTwoEars('Config.xml'); startAuditoryFrontEnd('all');
show('first', strsplit(path(), pathsep()){2});
show('wrong', message(@() startTwoEars('missing.xml')));
show('still', strcmp(fileparts(which('startTwoEars')), fileparts(which('startRosAFE'))));
cd(fileparts(which('startRosAFE'))); startTwoEars;
