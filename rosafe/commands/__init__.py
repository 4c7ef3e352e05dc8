"""The subcommands of `rosafe`, one module each; a module's name is the command's.

A command is a module with a docstring and two functions. `rosafe -h` shows the first line of the docstring. The
command's own help begins with it, and ends with its paragraphs from `exit status:` or `examples:` on::

    def configure(parser: argparse.ArgumentParser) -> None:   # adds arguments
    def run(options: argparse.Namespace) -> int:              # runs the command; returns the exit code

`configure` may call `parser.set_defaults(interspersed=[])`; `run` then finds the positional arguments that follow an
option in this list, because argparse cannot assign them.

`rosafe -h` reads the docstrings without importing the modules. Slow imports belong in `run`. `doctor` has to work even
if numpy is missing. `run` may raise `CommandError` (exit code 1) and may call `options.usage_error(text)` (exit code
2). OutputError, MasterError and GenerationError are reported like CommandError. Modules whose names begin with an
underscore are shared by several commands.
"""

from __future__ import annotations


class CommandError(Exception):
    """A failure of the command. Its text is printed as one line, and the exit code is 1."""
