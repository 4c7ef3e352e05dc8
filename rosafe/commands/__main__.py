"""The command `rosafe`: find the subcommands in `rosafe.commands` and run one of them."""

from __future__ import annotations

import argparse
import ast
import importlib
import importlib.util
import inspect
import os
import pkgutil
import re
import sys
import warnings
from pathlib import Path

from rosafe import commands
from rosafe.commands import CommandError
from rosafe.declarations import plugins
from rosafe.ros1.component.generate import GenerationError
from rosafe.ros1.component.startup import Parser, without_names, without_remappings
from rosafe.ros1.transport.master import MasterError
from rosafe.system import missing, streams
from rosafe.system.output import OutputError
from rosafe.system.terminal import printable
from rosafe.system.version import VERSION

# compute nothing or built-in representations only, or import plugins in a child process
_WITHOUT_PLUGINS = ("check", "doctor", "record", "trace", "validate")
_LAUNCHED = ("live", "localize", "record", "setup")  # by roslaunch; others have arguments NAME=VALUE
_ONE_BLAS_THREAD = ("localize",)  # multiplies small matrices: more threads take several times the processor time
_EPILOG = """example:
  rosafe process speech.wav -o speech.npz --outputs ild,ratemap --set fb_nChannels=64
  rosafe process -h          # all options and parameters"""


def main(argv: list[str] | None = None) -> int:
    """Run `rosafe` and return its exit code. SystemExit: 2 for a wrong command line, 0 after -h and --version."""
    name = "rosafe"
    try:
        words = _without_ros1(sys.argv[1:] if argv is None else argv)
        options, rest = _parser(words).parse_known_args(words)
        name = f"rosafe {options.command}"
        if hasattr(options, "missing"):
            raise CommandError(options.missing)
        if hasattr(options, "interspersed"):
            options.interspersed = [word for word in rest if not word.startswith("-")]
            rest = [word for word in rest if word.startswith("-")]
        if rest:
            options.usage_error(f"unrecognized arguments: {' '.join(rest)}")
        with warnings.catch_warnings():
            warnings.showwarning = lambda text, *_, **__: print(f"{name}: {printable(text)}", file=sys.stderr)
            return int(options.run(options))
    except (CommandError, OutputError, GenerationError, MasterError) as problem:
        print(f"{name}: {printable(problem)}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as problem:
        if not problem.name or problem.name.startswith("rosafe."):  # a bug of this package
            raise
        print(f"{name}: {printable(missing.advice(problem.name))}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def _without_ros1(words: list[str]) -> list[str]:
    """Return a command line without arguments that roslaunch adds; those of ROS 2 have the same form."""
    if words[:1] == ["ros2"]:
        return words
    words = without_names(words)
    return without_remappings(words) if words[:1] and words[0] in _LAUNCHED else words


def _parser(words: list[str]) -> argparse.ArgumentParser:
    """Return a parser with the subcommand of the command line, or with a line for each without importing any."""
    parser = Parser(
        prog="rosafe",
        description="The Two!Ears auditory front-end without ROS, and its tools.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"rosafe {VERSION}")
    subparsers = parser.add_subparsers(title="commands", dest="command", metavar="COMMAND", required=True)
    modules = [module for module in pkgutil.iter_modules(commands.__path__) if not module.ispkg]
    names = [module.name for module in modules if not module.name.startswith("_")]
    chosen = words[0].replace("-", "_") if words else ""
    if chosen in names:
        if chosen in _WITHOUT_PLUGINS:
            plugins.disable()
        if chosen in _ONE_BLAS_THREAD:
            os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported
        _add(subparsers, chosen)
    else:
        for name in names:
            spec = importlib.util.find_spec(f"{commands.__name__}.{name}")
            text = ast.get_docstring(ast.parse(Path(str(spec and spec.origin)).read_bytes())) or ""
            listed = subparsers.add_parser(name.replace("_", "-"), help=_summary(text), add_help=False)
            listed.set_defaults(run=lambda _: parser.error("expected the command first"), usage_error=parser.error)
    return parser


def _summary(text: str) -> str:
    return text.partition("\n")[0].rstrip(".")


def _add(subparsers: argparse._SubParsersAction[Parser], name: str) -> None:
    try:
        module = importlib.import_module(f"{commands.__name__}.{name}")
    except ModuleNotFoundError as problem:  # the other commands still work, above all `doctor`
        why = missing.advice(str(problem.name))
        subparsers.add_parser(name, help=why, add_help=False).set_defaults(missing=why)
        return
    text = inspect.getdoc(module) or ""
    description, *ends = re.split(r"\n\n(?=exit status:|examples?:)", text, maxsplit=1)
    subparser = subparsers.add_parser(
        name.replace("_", "-"),
        help=_summary(text),
        description=description,
        epilog="".join(ends),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    subparser.set_defaults(run=module.run, usage_error=subparser.error)
    module.configure(subparser)


def program() -> int:
    """Run `rosafe` as a program with the standard streams of this process."""
    return streams.run("rosafe", main)


if __name__ == "__main__":
    sys.exit(program())
