"""The subcommands of `rosafe`, one module each; a module's name is the command's.

A command is a module with a docstring, whose first line (less its full stop) is shown in `rosafe -h` and whose whole
is the head of its own help, and two functions::

    def configure(parser: argparse.ArgumentParser) -> None:   # adds arguments; may set `parser.epilog`
    def run(options: argparse.Namespace) -> int:              # does it; returns the exit code

`configure` may call `parser.set_defaults(interspersed=[])`: `run` finds there the words that stand behind an option,
for which argparse has no place.

`rosafe -h` reads their docstrings and imports none; what is slow to import is imported in `run`; and `doctor` works
where even numpy is missing. `run` may raise `CommandError`, and
call `options.usage_error(text)`, which exits with 2. Modules whose names
begin with _ are parts of commands.
"""

from __future__ import annotations


class CommandError(Exception):
    """The command cannot do it: the text is the one line that the user gets, and the exit code is 1."""
