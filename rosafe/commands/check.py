"""Check a plugin file: import, declaration, and whether its stages follow the rules that the tree relies on.

The stages are tested with blocks of different lengths, at the limits of all parameters, with silence, loud and long
sound, and so on. Their cost is compared with that of the built-in representations. The tests run in child processes
with all plugins that ROSAFE_PLUGINS names, because one of these may be the parent.

exit status: 0 if the plugin can be used (there may be warnings), 1 if not

example:
  rosafe check zerocrossings.py"""

from __future__ import annotations

import argparse
import os
import textwrap

from rosafe.commands import CommandError, _plugins
from rosafe.declarations import plugins
from rosafe.system.terminal import printable


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("file", metavar="FILE", help="a Python file with one or more representations")


def run(options: argparse.Namespace) -> int:
    """Check the file and print one line for each finding."""
    origin, extra = _origin(options.file)
    report = _plugins.report(extra)
    kinds = [kind for kind, where in report.kinds.items() if where == origin]
    trials = _plugins.trials(kinds, extra) if kinds else []
    errors = _import_errors(report, origin, kinds)
    errors += [f"{origin}: {trial.kind}: {trial.error}" for trial in trials if trial.error]
    for line in errors:
        print(f"{'ERROR':8}{printable(line)}")
    for line in _warnings(report, origin):
        print(f"{'warning':8}{printable(line)}")
    for trial in trials:
        if not trial.error:
            print(f"{'ok':8}{printable(origin)}: {trial.kind}: the declaration and the stage passed all checks")
            _print_costs(trial)
    return 1 if errors else 0


def _import_errors(report: _plugins.PluginReport, origin: str, kinds: list[str]) -> list[str]:
    errors = [line for line in report.problems if line.startswith(f"{origin}: ")]
    if not errors and not report.kinds:  # another plugin ended or blocked the process
        errors = report.problems
    if not errors and not kinds:
        errors = [f"{origin}: expected a class with a REPRESENTATION, got none"]
    return errors


def _warnings(report: _plugins.PluginReport, origin: str) -> list[str]:
    warnings = [line for line in report.warnings if line.startswith(f"{origin}: ")]
    if os.path.basename(origin).startswith(plugins.SKIPPED):
        prefixes = ", ".join(plugins.SKIPPED)
        warnings.append(f"{origin}: files whose names begin with {prefixes} are not loaded from folders")
    return warnings


def _print_costs(trial: _plugins.Trial) -> None:
    """Print the processor time in ms per second of sound, each without the parents."""
    print(f"{'cost':8}{trial.kind} takes {trial.costs[trial.kind]:.3g} ms per second of sound at 44.1 kHz; built in:")
    others = [f"{kind} {cost:.3g}" for kind, cost in trial.costs.items() if kind != trial.kind]
    print(textwrap.fill(", ".join(others), 100, initial_indent=" " * 8, subsequent_indent=" " * 8))


def _origin(file: str) -> tuple[str, str]:
    """Return the path from which `file` is loaded, and the file itself unless a plugin folder contains it."""
    if not (os.path.isfile(file) and file.endswith(".py")):
        raise CommandError(f"{printable(file)}: expected a Python file (.py)")
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
