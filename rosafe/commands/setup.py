"""Save the tree of a running rosAFE with its sound to a file, or create it from a file.

`save` writes the acquisition of bass, the topic of the port Audio, and all processors with their parents and exact
parameters. `load` creates all of this, or changes nothing. Existing processors that are equal are reused. The setup is
refused if a different processor has one of its names, or if bass acquires from another device. docs/setups.md describes
the file, which can be edited by hand.

exit status: 0 success, 1 refused (nothing was changed), 2 wrong command line

examples:
  rosafe setup save tree.yaml
  rosafe setup load tree.yaml
  rosafe setup save - --full"""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rosafe.commands import CommandError
from rosafe.commands._component import add_instance, component, format_error, prepare
from rosafe.declarations import ros_names
from rosafe.interface import MAX_SETUP, ComponentError
from rosafe.system import option_types
from rosafe.system.input import read_regular
from rosafe.system.output import write_whole
from rosafe.system.terminal import printable
from rosafe.tree.setups import LOCALIZER_FILES, Setup, SetupError, read, write


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("action", choices=("save", "load"), help="action")
    parser.add_argument("file", metavar="FILE.yaml", help="the setup; - means standard output or input")
    parser.add_argument("--full", action="store_true", help="save: also write parameters with default values")
    parser.add_argument(
        "--keep",
        metavar="FILE",
        default="",
        help="load: if FILE, the saved tree of the node, contains processors, load the sound only",
    )
    parser.add_argument(
        "--wait",
        type=option_types.seconds(0, 3600),
        default=0.0,
        metavar="SECONDS",
        help="maximum time to wait for master and nodes that are starting (default: 0)",
    )
    add_instance(parser)


def run(options: argparse.Namespace) -> int:
    """Save or load the setup."""
    if options.full and options.action == "load":
        options.usage_error("--full is for save")
    if options.keep and options.action == "save":
        options.usage_error("--keep is for load")
    setup = without_saved_tree(read_file(options.file), options.keep) if options.action == "load" else None
    prepare(options.wait)
    if setup is not None:
        show(asyncio.run(load(setup, options.instance, options.wait)))
    else:
        _save(options.file, asyncio.run(_captured(options)))
    return 0


def read_file(name: str) -> Setup:
    """Read the setup in the file `name`. Raises CommandError with file and line if it is not valid."""
    try:
        limit = 4 * MAX_SETUP + 1  # maximum number of bytes, and one more
        data = sys.stdin.buffer.read(limit) if name == "-" else read_regular(name, limit)
        setup = read(data.decode("utf-8-sig"))
        return setup if setup.localizer is None else replace(setup, localizer=_absolute(setup.localizer, Path(name)))
    except UnicodeDecodeError:
        raise CommandError(f"{name}: expected a setup in UTF-8") from None
    except OSError as problem:
        raise CommandError(f"{name}: {problem.strerror or problem}") from None
    except SetupError as problem:
        raise CommandError(f"{name}, {problem}") from None


def _absolute(localizer: Mapping[str, Any], setup_file: Path) -> dict[str, Any]:
    """Return the settings of the localizer with absolute paths; relative ones are relative to the setup."""

    from rosafe.localization.pair import PREFIX  # such names are not paths

    def path(value: str) -> str:
        return str((setup_file.parent / Path(value).expanduser()).absolute())

    return {
        name: path(value)
        if name in LOCALIZER_FILES and value not in ("", "sphere", "none") and not value.startswith(PREFIX)
        else value
        for name, value in localizer.items()
    }


def without_saved_tree(setup: Setup, keep: str) -> Setup:
    """Return `setup` without processors if the node restores its own tree from the file `keep`."""
    if keep and Path(keep).exists() and read_file(keep).processors:
        return replace(setup, processors=())
    return setup


async def load(setup: Setup, instance: str, wait: float = 0.0) -> dict[str, Any]:
    """Apply the setup to a running rosAFE, and set the parameters of the localizer, which reads them when it starts.

    Returns the outputs of `interface.LOAD_SETUP`, and `localizer`: running, set or empty. Raises CommandError.
    """
    from rosafe.ros1.client import localizer, whole_trees

    async with component(instance, wait) as client:
        try:
            node = ros_names.resolve(localizer.NODE, client.node)
            answer = {**await whole_trees.load(client, write(setup), wait), "localizer": ""}
            if setup.localizer is not None:
                await localizer.set_parameters(client.graph, node, setup.localizer)
                answer["localizer"] = "running" if await localizer.is_registered(client.graph, node) else "set"
            return answer
        except ComponentError as problem:
            raise CommandError(format_error(problem)) from None


async def _captured(options: argparse.Namespace) -> str:
    from rosafe.ros1.client import localizer, whole_trees

    async with component(options.instance, options.wait) as client:
        try:
            if await localizer.is_registered(client.graph, ros_names.resolve(localizer.NODE, client.node)):
                print("the localizer is not saved; add a section localizer (docs/setups.md)", file=sys.stderr)
            return await whole_trees.save(client, options.full)
        except ComponentError as problem:
            raise CommandError(format_error(problem)) from None


def _save(name: str, text: str) -> None:
    if name == "-":
        print(text, end="")
    else:
        write_whole(name, text.encode())
        print(f"{printable(name)}: {text.count(chr(10))} lines", file=sys.stderr)


def show(answer: dict[str, Any]) -> None:
    """Print a line for the sound and one for each processor."""
    if answer["sound"]:
        print(f"{answer['sound']:7}  sound")
    for state in ("reused", "created"):
        for name in answer[state]:
            print(f"{state:7}  {printable(name)}")
    if answer["localizer"] == "running":
        print("set      parameters of the localizer, which has to be restarted to use them")
    elif answer["localizer"]:
        print("set      parameters of the localizer; start it with: rosafe localize")
