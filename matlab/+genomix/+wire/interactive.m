function yes = interactive()
%INTERACTIVE  Return whether the call was typed at the prompt: not in a script or function, and on a terminal.

here = fileparts(fileparts(mfilename('fullpath')));
callers = dbstack('-completenames');
yes = all(strncmp({callers.file}, here, numel(here)));
if ~yes
    return
end
if exist('OCTAVE_VERSION', 'builtin')
    % Octave has no isatty; the shell inherits the standard input.
    yes = isguirunning() || system('[ -t 0 ]') == 0;
else
    yes = usejava('desktop');
end
end
