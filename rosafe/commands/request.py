"""Request a representation from a running rosAFE: reuse or create the processors that it needs.

NAME=VALUE are parameters of the representation or of its ancestors; the others have their defaults. Existing processors
with the same parameters are reused. The others are created with names such as ild_0, ild_1, ... If one cannot be
created, the new ones are removed.

Prints a line for each processor, from the input to the requested one: created or reused, name, topic.

exit status: 0 the representation is computed, 1 refused, 2 wrong command line

examples:
  rosafe request ild
  rosafe request pitch pi_rangeHz=80,300
  rosafe request ratemap fb_nChannels=64 rm_wSizeSec=0.03 nFramesPerBlock=4410
  rosafe request filterbank fb_cfHz=500,1000,2000 --json"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from collections.abc import Mapping
from typing import Any

from rosafe.commands import CommandError
from rosafe.commands._component import add_instance, component, format_error, prepare
from rosafe.declarations import ros_names
from rosafe.declarations.text import did_you_mean, short_repr
from rosafe.interface import REQUEST, ROSAFE, ComponentError, Representation
from rosafe.interface.arguments import check_parameter
from rosafe.system.terminal import printable
from rosafe.tree import tree_planner as request

_SETTINGS = [p for p in REQUEST.parameters if p.name not in ("representation", "connect")]  # separate arguments


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    words = ", ".join(REQUEST.parameter("representation").choices)
    parser.add_argument("representation", metavar="REPRESENTATION", help=f"one of {words}")
    parser.add_argument(
        "settings",
        nargs="*",
        default=[],
        metavar="NAME=VALUE",
        help=f"a parameter: {', '.join(request.OF_THE_INPUT[1:])}, or one that `rosafe process -h` lists",
    )
    parser.add_argument(
        "--connect",
        metavar="TOPIC",
        help="topic of the sound for a new input (default: bass/Audio, unless the port Audio is connected)",
    )
    add_instance(parser)
    parser.add_argument("--json", action="store_true", help="print the response of genomixd as JSON")
    parser.set_defaults(interspersed=[])


def run(options: argparse.Namespace) -> int:
    """Send the request and print the response."""
    try:
        kind = request.kind_of(options.representation)
        values = {"representation": kind.word}
        for name, value in map(_parameter, [*options.settings, *options.interspersed]):
            if name in values:
                raise ValueError(f"{name}: expected one value, got two")
            values[name] = value
    except ValueError as problem:
        raise CommandError(str(problem)) from None
    if options.connect is not None:
        values["connect"] = options.connect
    prepare()
    node, answer = asyncio.run(_send(options.instance, values, kind))
    if options.json:
        print(json.dumps(answer, indent=2))
    else:
        _show(node, answer, kind)
    return 0


def _parameter(setting: str) -> tuple[str, Any]:
    name, equals, text = setting.partition("=")
    if not equals:
        raise ValueError(f"expected NAME=VALUE, got {setting!r}")
    parameter = next((p for p in _SETTINGS if name in (p.name, *p.aliases)), None)
    if parameter is None:
        known = [p.name for p in _SETTINGS]
        raise ValueError(
            f"parameters: expected a known parameter, got {short_repr(name)}; there are: {', '.join(known)}"
            f"{did_you_mean(name, known)}"
        )
    if name in request.OF_THE_INPUT:
        return name, parameter.parse(text)
    return check_parameter(name, text, text=True)


async def _send(instance: str, values: Mapping[str, Any], kind: Representation) -> tuple[str, Mapping[str, Any]]:
    """Return the full name of the node, and the response as genomixd would.

    Raises CommandError, with the next step, if the request is refused.
    """
    async with component(instance) as client:
        try:
            existing = (await client.outputs("getProcessors", {}))["processors"]
            _warn(kind, values, new_input=all(processor["upperDepName"] for processor in existing))
            return client.node, await client.outputs(REQUEST.name, values)
        except ComponentError as problem:
            if problem.ex != "::rosAFE::e_noData":
                raise CommandError(format_error(problem)) from None
            topic = ros_names.resolve(str(values.get("connect", REQUEST.parameter("connect").default)), client.node)
            start = "" if await client.published(topic) else "bass-ros -b; "
            acquire = f"rosservice call {topic.rpartition('/')[0]}/Acquire \"{{device: 'scene:'}}\""
            silent = f"{problem.ex}: {ROSAFE.exceptions['e_noData']}"
            raise CommandError(f"{silent}; start the sound first: {start}{acquire}") from None


def _warn(kind: Representation, values: Mapping[str, Any], new_input: bool) -> None:
    """Print a line on stderr for each parameter without effect, before any processor is created."""
    names = [name for name in values if name != "representation"]
    for name in request.unused(request.ancestor_kinds(kind), names, new_input):
        reason = ": the input exists already" if name in request.OF_THE_INPUT else " on this representation"
        print(f"rosafe request: {name} has no effect{reason}", file=sys.stderr, flush=True)


def _show(node: str, answer: Mapping[str, Any], kind: Representation) -> None:
    """Print a line for each processor."""
    width = max(map(len, answer["dependencies"]))
    for name, ancestor in zip(answer["dependencies"], request.ancestor_kinds(kind), strict=True):
        state = "created" if name in answer["created"] else "reused"
        print(printable(f"{state:7}  {name:{width}}  {ros_names.port_topic(node, ancestor, name)}"))
