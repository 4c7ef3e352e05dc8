function yes = interactive()
%INTERACTIVE  Whether a person at the prompt called: no script or function did, and the input is a terminal.

here = fileparts(fileparts(mfilename('fullpath')));
callers = dbstack('-completenames');
yes = all(strncmp({callers.file}, here, numel(here)));
if ~yes
    return
end
if exist('OCTAVE_VERSION', 'builtin')
    % Octave has no isatty; the shell inherits our input.
    yes = isguirunning() || system('[ -t 0 ]') == 0;
else
    yes = usejava('desktop');
end
end
