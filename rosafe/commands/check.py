"""Check a plugin file: import, declaration, and whether its stages do what the tree relies on.

The stages are tried on blocks of different lengths, at the limits of all parameters, on silence, loud and long sound,
and so on; their cost is compared with that of the built-in representations. All of this happens in child processes,
together with the plugins that ROSAFE_PLUGINS names: one may be the parent."""

from __future__ import annotations

import argparse
import os
import textwrap

from rosafe.commands import CommandError, _plugins
from rosafe.declarations import plugins
from rosafe.terminal import printable


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
    trials = _plugins.trials(kinds, extra) if kinds else []
    errors += [f"{origin}: {trial.kind}: {trial.error}" for trial in trials if trial.error]
    for state, lines in (("ERROR", errors), ("warning", warnings)):
        for line in lines:
            print(f"{state:8}{printable(line)}")
    for trial in trials:
        if not trial.error:
            print(f"{'ok':8}{printable(origin)}: {trial.kind}: the declaration and the stage passed all checks")
            _print_costs(trial)
    return 1 if errors else 0


def _print_costs(trial: _plugins.Trial) -> None:
    """Milliseconds per second of sound, each without its parents."""
    print(f"{'cost':8}{trial.kind} takes {trial.costs[trial.kind]:.3g} ms per second of sound at 44.1 kHz; built in:")
    others = [f"{kind} {cost:.3g}" for kind, cost in trial.costs.items() if kind != trial.kind]
    print(textwrap.fill(", ".join(others), 100, initial_indent=" " * 8, subsequent_indent=" " * 8))


def _origin(file: str) -> tuple[str, str]:
    """The path under which `file` is loaded, and the file itself unless it is in one of the folders of plugins."""
    if not (os.path.isfile(file) and file.endswith(".py")):
        raise CommandError(f"{printable(file)}: expected a Python file (.py), found none")
    path = os.path.abspath(file)
    if os.pathsep in path:
        raise CommandError(
            f"{printable(path)}: expected a path without {os.pathsep}, which separates folders of plugins"
        )
    if not os.path.basename(path).startswith(plugins.SKIPPED):
        for folder in plugins.named():
            if os.path.isdir(folder) and os.path.samefile(folder, os.path.dirname(path)):
                return os.path.join(os.path.abspath(folder), os.path.basename(path)), ""
    return path, path
