"""From the text of a setup to what it says, checked against the interface; errors tell the line."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from rosafe.declarations.parameter import MAX_STRING, short_repr
from rosafe.declarations.text import did_you_mean
from rosafe.interface import KINDS, MAX_SETUP, REQUEST, Parameter, Representation
from rosafe.tree.tree_planner import kind_of

from .markup import SetupError, YamlNode, parse
from .setup import ACQUIRE, INPUT_PORTS, AcquireSettings, Setup, SetupProcessor, parameters_of

MAX_PROCESSORS = 10_000  # more than a node takes
MAX_PARAMETER_VALUES = 2**15  # of a request, all of whose parameters are read while sound is processed
_NAME = re.compile(r"\w+(/\w+)*", re.ASCII)
_TOPIC = re.compile(r"/?[A-Za-z]\w*(/[A-Za-z]\w*)*", re.ASCII)
_OF_TREES = tuple(p for p in REQUEST.parameters if p.name not in ("representation", "connect"))
_BOOLEANS = {**dict.fromkeys(("true", "yes", "on"), True), **dict.fromkeys(("false", "no", "off"), False)}


class _ProcessorEntry(NamedTuple):
    """A processor, with the line of its name and that of its parent's."""

    line: int
    parent_line: int
    wanted: SetupProcessor


def read(text: str, absent: list[str] | None = None) -> Setup:
    """The setup that `text` (YAML, docs/setups.md) describes.

    If `absent` is given, processors of unknown kinds, and those below them, are left out, and a line for each is
    appended to it.

    Raises
    ------
    SetupError
        Where it is none, or where the interface does not allow what it says.
    """
    if len(text) > MAX_SETUP:
        raise SetupError(1, f"{len(text)} characters are too many for a setup, at most {MAX_SETUP}")
    document = parse(text)
    sections = {name: node for name, _, node in document.members("a setup", ("sound", "connections", "processors"))}
    nothing = YamlNode(document.line)
    sound = sections.get("sound", nothing)
    return Setup(
        None if sound.empty else AcquireSettings.of(_values(sound, ACQUIRE, "sound")),
        dict(_connections(sections.get("connections", nothing))),
        _ordered(_processors(sections.get("processors", nothing), absent)),
    )


def read_parameters(text: str) -> dict[str, Any]:
    """The parameters of a request for a whole tree that `text` says, checked; nothing says none.

    A mapping in YAML: a line for each, or one line, of which the braces may be left out.

    Raises
    ------
    SetupError
        Where it is none, or where the interface does not allow what it says.
    """
    short = text.strip()
    if short and not short.startswith("{") and "\n" not in short:
        text = f"{{{short}\n}}"  # a comment ends with its line
    return _values(parse(text, MAX_PARAMETER_VALUES), _OF_TREES, "parameters")


def _connections(node: YamlNode) -> Iterator[tuple[str, str]]:
    for port, _, value in node.members("connections", INPUT_PORTS):
        topic = value.word(f"connections: {port}")
        if len(topic) > MAX_STRING or not _TOPIC.fullmatch(topic):
            raise SetupError(value.line, f"connections: {short_repr(topic)} is no name of a topic, such as bass/Audio")
        yield port, f"/{topic.removeprefix('/')}"


# --- parameters -------------------------------------------------------------------------------------------------


def _values(node: YamlNode, parameters: tuple[Parameter, ...], what: str, but: tuple[str, ...] = ()) -> dict[str, Any]:
    """The checked values of a map of parameters, without those members that are none of them, `but` others."""
    values: dict[str, Any] = {}
    for name, key, value in node.members(what):
        if name in but:
            continue
        parameter = next((p for p in parameters if name in (p.name, *p.aliases)), None)
        if parameter is None:
            known = ", ".join((*but, *(p.name for p in parameters)))
            near = did_you_mean(name, [p.name for p in parameters])
            raise SetupError(key.line, f"{what}: unknown {short_repr(name)}; there are: {known}{near}")
        if parameter.name in values:
            raise SetupError(key.line, f"{what}: {parameter.name} is given twice")
        try:
            values[parameter.name] = _value(parameter, value)
        except ValueError as problem:
            raise SetupError(value.line, f"{what}: {problem}") from None
    return values


def _value(parameter: Parameter, node: YamlNode) -> Any:
    sequence = parameter.idl.startswith("sequence<")
    if node.text is not None:
        return parameter.check(_parsed(parameter, node.text))
    if node.items is None or not sequence:
        raise ValueError(f"{parameter.name}: wanted is {'a list' if sequence else 'one value'}")
    items: list[Any] = []
    if len(node.items) > parameter.most:
        raise ValueError(f"{parameter.name}: too many values, at most {parameter.most}")
    for item in node.items:
        if item.text is None:
            raise ValueError(f"{parameter.name}: a list has single values in it")
        items += parameter.parse(item.text)
    return parameter.check(items)


def _parsed(parameter: Parameter, text: str) -> Any:
    if parameter.idl == "string":
        return text
    if parameter.idl == "boolean" and text.lower() in _BOOLEANS:
        return _BOOLEANS[text.lower()]
    return parameter.parse(text)


# --- processors -------------------------------------------------------------------------------------------------


def _processors(node: YamlNode, absent: list[str] | None) -> dict[str, _ProcessorEntry]:
    members = node.members("processors")
    if len(members) > MAX_PROCESSORS:
        raise SetupError(members[MAX_PROCESSORS][1].line, f"more than {MAX_PROCESSORS} processors")
    if absent is not None:
        without = _of_unknown_kinds(members)
        absent += without.values()
        members = [member for member in members if member[0] not in without]
    return {name: _processor(name, key, value) for name, key, value in members}


def _of_unknown_kinds(members: Sequence[tuple[str, YamlNode, YamlNode]]) -> dict[str, str]:
    """A line for each processor of an unknown kind, and for each one below it, by name."""
    without: dict[str, str] = {}
    parents: dict[str, str] = {}
    for name, _, node in members:
        values = {member: value for member, _, value in node.members(short_repr(name))}
        parents[name] = values["parent"].word(name) if "parent" in values else ""
        if "kind" in values:
            word = values["kind"].word(name)
            try:
                kind_of(word)
            except ValueError:
                without[name] = f"{name} (there is no plugin {short_repr(word)})"
    while below := {name for name, parent in parents.items() if parent in without and name not in without}:
        without |= {name: f"{name} (it is below {parents[name]})" for name in below}
    return without


def _processor(name: str, key: YamlNode, node: YamlNode) -> _ProcessorEntry:
    what = short_repr(name)
    members = {member: value for member, _, value in node.members(what)}
    if "kind" not in members:
        raise SetupError(key.line, f"{what}: kind is missing; there are: {', '.join(KINDS)}")
    kind = _kind(members["kind"], what)
    _check_name(name, key.line, kind)
    parent, parent_line = KINDS[kind.parent].name if kind.parent else "", key.line
    if "parent" in members:
        parent, parent_line = members["parent"].word(f"{what}: parent"), members["parent"].line
        if not kind.parent:
            raise SetupError(parent_line, f"{what}: an input has no parent")
    parameters = parameters_of(kind)
    values = _values(node, parameters, what, but=("kind", "parent"))
    given = {p.name: values[p.name] for p in parameters if p.name in values and values[p.name] != p.check(p.default)}
    wanted = SetupProcessor(name, kind.kind, parent, given)
    try:
        _ = wanted.level
    except ValueError as problem:
        raise SetupError(key.line, f"{what}: {problem}") from None
    return _ProcessorEntry(key.line, parent_line, wanted)


def _kind(node: YamlNode, what: str) -> Representation:
    word = node.word(f"{what}: kind")
    try:
        return kind_of(word)
    except ValueError:
        raise SetupError(
            node.line, f"{what}: {short_repr(word)} is no kind of processor; there are: {', '.join(KINDS)}"
        ) from None


def _check_name(name: str, line: int, kind: Representation) -> None:
    if not 0 < len(name) <= MAX_STRING or "\0" in name:
        raise SetupError(line, f"{short_repr(name)} is no name of a processor")
    if kind.parent and not _NAME.fullmatch(name):
        raise SetupError(line, f"{short_repr(name)} names a topic too: letters, digits and _ only")


def _ordered(entries: Mapping[str, _ProcessorEntry]) -> tuple[SetupProcessor, ...]:
    """The processors, each after its parent and else in the order of the setup; SetupError where they are no tree."""
    inputs = [entry for entry in entries.values() if not entry.wanted.parent]
    if len(inputs) > 1:
        names = " and ".join(short_repr(entry.wanted.name) for entry in inputs[:2])
        raise SetupError(inputs[1].line, f"{names} are two inputs; there can be but one")
    ordered: dict[str, SetupProcessor] = {}
    for entry in entries.values():
        _check_parent(entry, entries)
    for entry in entries.values():
        line = []
        name = entry.wanted.name
        while name and name not in ordered:  # a kind's parent is of another kind, and so on up to an input: no circle
            line.append(entries[name].wanted)
            name = entries[name].wanted.parent
        ordered.update({wanted.name: wanted for wanted in reversed(line)})
    return tuple(ordered.values())


def _check_parent(entry: _ProcessorEntry, entries: Mapping[str, _ProcessorEntry]) -> None:
    wanted = entry.wanted
    if not wanted.parent:
        return
    what, kind = f"{short_repr(wanted.name)}: its parent {short_repr(wanted.parent)}", wanted.representation.parent
    if wanted.parent not in entries:
        raise SetupError(entry.parent_line, f"{what} is not in the setup; wanted is one of kind {kind}")
    found = entries[wanted.parent].wanted.kind
    if found != kind:
        raise SetupError(entry.parent_line, f"{what} is of kind {found}, wanted is {kind}")
