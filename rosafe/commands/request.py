"""Build what a representation needs in a running rosAFE, or find it there.

NAME=VALUE are parameters of the representation or of anything above it, and what is not given has its default.
Processors of the tree whose parameters are the same are used; the others are made, as ild_0, ild_1, ... If something
fails, what was made is removed again.

Prints a line for each processor, from the input to the wanted one: created or reused, its name, its topic."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from collections.abc import Mapping
from typing import Any

from rosafe.commands import CommandError
from rosafe.commands._component import component, format_error, prepare
from rosafe.declarations.parameter import short_repr
from rosafe.declarations.text import did_you_mean
from rosafe.interface import REQUEST, ROSAFE, ComponentError, Representation
from rosafe.interface.arguments import check_parameter
from rosafe.terminal import printable
from rosafe.tree import tree_planner as request

_SETTINGS = [p for p in REQUEST.parameters if p.name not in ("representation", "connect")]  # those have other places


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = (
        "rosafe request REPRESENTATION [NAME=VALUE ...] [--connect TOPIC] [-i INSTANCE] [--json]\n"
        "       rosafe request -h"
    )
    words = ", ".join(REQUEST.parameter("representation").choices)
    parser.add_argument("representation", metavar="REPRESENTATION", help=f"what is wanted: one of {words}")
    parser.add_argument(
        "settings",
        nargs="*",
        default=[],
        metavar="NAME=VALUE",
        help=f"a parameter: {', '.join(request.OF_THE_INPUT[1:])}, and those that `rosafe process -h` lists",
    )
    parser.add_argument(
        "--connect",
        metavar="TOPIC",
        help="the sound of a new input (default: bass/Audio, unless the Audio port is connected already)",
    )
    parser.add_argument(
        "-i",
        "--instance",
        default=ROSAFE.name,
        metavar="INSTANCE",
        help=f"name of the node (default: {ROSAFE.name})",
    )
    parser.add_argument("--json", action="store_true", help="print the answer as genomixd gives it, as JSON")
    parser.set_defaults(interspersed=[])
    parser.epilog = (
        "exit status: 0 it runs, 1 it does not, 2 wrong command line\n\n"
        "examples:\n"
        "  rosafe request ild\n"
        "  rosafe request pitch pi_rangeHz=80,300\n"
        "  rosafe request ratemap fb_nChannels=64 rm_wSizeSec=0.03 nFramesPerBlock=4410\n"
        "  rosafe request filterbank fb_cfHz=500,1000,2000 --json"
    )


def run(options: argparse.Namespace) -> int:
    """Make the request and print what has come of it."""
    try:
        kind = request.kind_of(options.representation)
        values = {"representation": kind.word}
        for name, value in map(_parameter, [*options.settings, *options.interspersed]):
            if name in values:
                raise ValueError(f"{name} is given twice")
            values[name] = value
    except ValueError as problem:
        raise CommandError(str(problem)) from None
    if options.connect is not None:
        values["connect"] = options.connect
    prepare()
    answer = asyncio.run(_make(options.instance, values, kind))
    if options.json:
        print(json.dumps(answer, indent=2))
    else:
        _show(answer, kind)
    return 0


def _parameter(setting: str) -> tuple[str, Any]:
    name, equals, text = setting.partition("=")
    if not equals:
        raise ValueError(f"{setting}: wanted is NAME=VALUE")
    parameter = next((p for p in _SETTINGS if name in (p.name, *p.aliases)), None)
    if parameter is None:
        known = [p.name for p in _SETTINGS]
        raise ValueError(
            f"unknown parameter {short_repr(name)}; there are: {', '.join(known)}{did_you_mean(name, known)}"
        )
    if name in request.OF_THE_INPUT:
        return name, parameter.parse(text)
    return check_parameter(name, text, text=True)


async def _make(instance: str, values: Mapping[str, Any], kind: Representation) -> Mapping[str, Any]:
    """What the component's genomixd would answer; Failure, with what to do next, where it is refused."""
    async with component(instance) as proxy:
        try:
            there = (await proxy.outputs("getProcessors", {}))["processors"]
            _warn(kind, values, new_input=all(processor["upperDepName"] for processor in there))
            return await proxy.outputs(REQUEST.name, values)
        except ComponentError as problem:
            if problem.ex != "::rosAFE::e_noData":
                raise CommandError(format_error(problem)) from None
            topic = "/" + str(values.get("connect", REQUEST.parameter("connect").default)).lstrip("/")
            start = "" if await proxy.published(topic) else "bass-ros -b; "
            acquire = f"rosservice call {topic.rpartition('/')[0]}/Acquire \"{{device: 'scene:'}}\""
            silent = f"{problem.ex}: {ROSAFE.exceptions['e_noData']}"
            raise CommandError(f"{silent}; start the sound first: {start}{acquire}") from None


def _warn(kind: Representation, values: Mapping[str, Any], new_input: bool) -> None:
    """A line on stderr for each parameter that is given in vain, before anything is made."""
    given = [name for name in values if name != "representation"]
    for name in request.unused(request.ancestor_kinds(kind), given, new_input):
        why = ": the input is there already" if name in request.OF_THE_INPUT else " on this representation"
        print(f"rosafe request: {name} has no effect{why}", file=sys.stderr, flush=True)


def _show(answer: Mapping[str, Any], kind: Representation) -> None:
    """A line for each processor."""
    width = max(map(len, answer["dependencies"]))
    instance = answer["topic"].split("/")[1]
    for name, kind_there in zip(answer["dependencies"], request.ancestor_kinds(kind), strict=True):
        how = "created" if name in answer["created"] else "reused"
        print(printable(f"{how:7}  {name:{width}}  {request.topic(instance, kind_there, name)}"))
