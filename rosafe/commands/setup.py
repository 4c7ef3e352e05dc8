"""Save the tree of a running rosAFE with its sound as a file, and build it again from that.

`save` writes what bass acquires, what the Audio port hears, and every processor with its parent and parameters, to the
last digit. `load` makes all that: wholly, or nothing is changed. What is there already and the same is used; where
something else has a name of the setup's, or bass acquires something else, it is refused. docs/setups.md describes the
file, which is meant to be read and written by people."""

from __future__ import annotations

import argparse
import asyncio
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from rosafe.commands import CommandError
from rosafe.commands._component import component, format_error, prepare
from rosafe.input import read_regular
from rosafe.interface import MAX_SETUP, ROSAFE, ComponentError
from rosafe.output import write_whole
from rosafe.setups import Setup, SetupError, read, write
from rosafe.terminal import printable


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = (
        "rosafe setup save FILE.yaml [--full] [--wait SECONDS] [-i INSTANCE]\n"
        "       rosafe setup load FILE.yaml [--keep FILE] [--wait SECONDS] [-i INSTANCE]\n"
        "       rosafe setup -h"
    )
    parser.add_argument("action", choices=("save", "load"), help="what to do")
    parser.add_argument("file", metavar="FILE.yaml", help="the setup; - is the standard output or input")
    parser.add_argument("--full", action="store_true", help="save: write what has its default value, too")
    parser.add_argument(
        "--keep",
        metavar="FILE",
        default="",
        help="load: where FILE, in which the node keeps its tree, holds processors, load no others, but sound alone",
    )
    parser.add_argument(
        "--wait",
        type=_seconds,
        default=0.0,
        metavar="SECONDS",
        help="wait so long for master and nodes that are just starting (default: 0)",
    )
    parser.add_argument(
        "-i",
        "--instance",
        default=ROSAFE.name,
        metavar="INSTANCE",
        help=f"name of the rosAFE node (default: {ROSAFE.name})",
    )
    parser.epilog = (
        "exit status: 0 done, 1 refused (nothing has changed), 2 wrong command line\n\n"
        "examples:\n"
        "  rosafe setup save tree.yaml\n"
        "  rosafe setup load tree.yaml\n"
        "  rosafe setup save - --full"
    )


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds <= 3600:
        raise argparse.ArgumentTypeError(f"{text!r} is no time: seconds from 0 to 3600")
    return seconds


def run(options: argparse.Namespace) -> int:
    """Save or load."""
    if options.full and options.action == "load":
        options.usage_error("--full is for save")
    if options.keep and options.action == "save":
        options.usage_error("--keep is for load")
    setup = without_saved_tree(read_file(options.file), options.keep) if options.action == "load" else None
    prepare(options.wait)
    if setup is not None:
        show(asyncio.run(load(setup, options.instance, options.wait)))
    else:
        _keep(options.file, asyncio.run(_saved(options)))
    return 0


def read_file(name: str) -> Setup:
    """The setup in the file `name`; Failure, with file and line, where there is none."""
    try:
        limit = 4 * MAX_SETUP + 1  # bytes of that many characters, and one more
        data = sys.stdin.buffer.read(limit) if name == "-" else read_regular(name, limit)
        return read(data.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise CommandError(f"{name}: not a setup: the file is not UTF-8") from None
    except OSError as problem:
        raise CommandError(f"{name}: {problem.strerror or problem}") from None
    except SetupError as problem:
        raise CommandError(f"{name}, {problem}") from None


def without_saved_tree(setup: Setup, keep: str) -> Setup:
    """What is to be loaded of `setup` for a node that keeps its tree in the file `keep`: that comes back by itself."""
    if keep and Path(keep).exists() and read_file(keep).processors:
        return replace(setup, processors=())
    return setup


async def load(setup: Setup, instance: str, wait: float = 0.0) -> dict[str, Any]:
    """Build it on a running rosAFE; the outputs of `interface.LOAD_SETUP`, or Failure."""
    from rosafe.client import setup_transaction

    async with component(instance, wait) as proxy:
        try:
            return await setup_transaction.apply(proxy, setup, wait)
        except ComponentError as problem:
            raise CommandError(format_error(problem)) from None


async def _saved(options: argparse.Namespace) -> str:
    from rosafe.client import setup_transaction

    async with component(options.instance, options.wait) as proxy:
        try:
            return write(await setup_transaction.capture(proxy), options.full)
        except ComponentError as problem:
            raise CommandError(format_error(problem)) from None


def _keep(name: str, text: str) -> None:
    if name == "-":
        print(text, end="")
    else:
        write_whole(name, text.encode())
        print(f"{printable(name)}: {text.count(chr(10))} lines", file=sys.stderr)


def show(answer: dict[str, Any]) -> None:
    """A line for the sound and one for each processor."""
    if answer["sound"]:
        print(f"{answer['sound']:7}  sound")
    for how in ("reused", "created"):
        for name in answer[how]:
            print(f"{how:7}  {printable(name)}")
