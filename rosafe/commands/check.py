"""Check a plugin file: whether it can be imported, and whether its declaration is complete and free of conflicts.

The file is imported in a child process, together with the plugins that ROSAFE_PLUGINS names: one may be its parent."""

from __future__ import annotations

import argparse
import os

from rosafe.commands import Failure, _plugins
from rosafe.terminal import printable
from rosafe.vocabulary import plugins


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("file", metavar="FILE", help="a Python file with one or more representations")
    parser.epilog = (
        "exit status: 0 if the plugin can be used (there may be warnings), 1 if not\n\n"
        "example:\n  rosafe check zerocrossings.py"
    )


def run(options: argparse.Namespace) -> int:
    """Check the file and print one line for each finding."""
    origin, extra = _origin(options.file)
    report = _plugins.report(extra)
    errors = [line for line in report.problems if line.startswith(f"{origin}: ")]
    kinds = [kind for kind, where in report.kinds.items() if where == origin]
    if not errors and not report.kinds and report.problems:  # another plugin ended the process, or blocked it
        errors = report.problems
    if not errors and not kinds:
        errors = [f"{origin}: it defines no representation, that is, no class with a REPRESENTATION"]
    warnings = [line for line in report.warnings if line.startswith(f"{origin}: ")]
    if os.path.basename(origin).startswith(plugins.SKIPPED):
        warnings.append(
            f"{origin}: files whose names begin with {', '.join(plugins.SKIPPED)} are not loaded from folders"
        )
    # What a run of the stages shows is added here: only for `kinds`, and in another child process.
    for state, lines in (("ERROR", errors), ("warning", warnings)):
        for line in lines:
            print(f"{state:8}{printable(line)}")
    for kind in kinds:
        print(f"{'ok':8}{printable(origin)}: {kind}: the declaration is complete and has no conflicts")
    return 1 if errors else 0


def _origin(file: str) -> tuple[str, str]:
    """The path under which `file` is loaded, and the file itself unless it is in one of the folders of plugins."""
    if not (os.path.isfile(file) and file.endswith(".py")):
        raise Failure(f"{printable(file)}: expected a Python file (.py), found none")
    path = os.path.abspath(file)
    if os.pathsep in path:
        raise Failure(f"{printable(path)}: expected a path without {os.pathsep}, which separates folders of plugins")
    if not os.path.basename(path).startswith(plugins.SKIPPED):
        for folder in plugins.named():
            if os.path.isdir(folder) and os.path.samefile(folder, os.path.dirname(path)):
                return os.path.join(os.path.abspath(folder), os.path.basename(path)), ""
    return path, path
