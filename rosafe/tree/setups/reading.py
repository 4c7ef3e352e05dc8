"""Read the text of a setup and check it against the interface; errors contain the line number."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from rosafe.declarations.parameter import MAX_STRING
from rosafe.declarations.text import did_you_mean, short_repr
from rosafe.interface import KINDS, MAX_SETUP, REQUEST, Parameter, Representation
from rosafe.interface.remarks import PRESETS
from rosafe.tree.tree_planner import kind_of

from .markup import SetupError, YamlNode, parse
from .setup import ACQUIRE, INPUT_PORTS, LOCALIZER, AcquireSettings, Setup, SetupProcessor, parameters_of

MAX_PROCESSORS = 10_000  # more than a node can run
MAX_PARAMETER_VALUES = 2**15  # of a tree request, which is parsed while sound is processed
_NAME = re.compile(r"\w+(/\w+)*", re.ASCII)
_TOPIC = re.compile(r"/?[A-Za-z]\w*(/[A-Za-z]\w*)*", re.ASCII)
_TREE_PARAMETERS = tuple(p for p in REQUEST.parameters if p.name not in ("representation", "connect"))
_SECTIONS = ("sound", "connections", "processors", "preset", "localizer")
_BOOLEANS = {**dict.fromkeys(("true", "yes", "on"), True), **dict.fromkeys(("false", "no", "off"), False)}


class _ProcessorEntry(NamedTuple):
    """A processor with the line numbers of its name and of its parent."""

    line: int
    parent_line: int
    processor: SetupProcessor


def read(text: str, absent: list[str] | None = None) -> Setup:
    """Return the setup in `text` (YAML, docs/setups.md).

    If `absent` is given, processors of unknown kinds and their descendants are left out, and a line for each of them is
    appended to it.

    Raises
    ------
    SetupError
        The text is not a setup, or the interface does not allow its values.
    """
    if len(text) > MAX_SETUP:
        raise SetupError(1, f"a setup: expected at most {MAX_SETUP} characters, got {len(text)}")
    document = parse(text)
    sections = {name: node for name, _, node in document.members("a setup", _SECTIONS)}
    empty = YamlNode(document.line)
    sound = sections.get("sound", empty)
    return Setup(
        None if sound.empty else AcquireSettings.of(_values(sound, ACQUIRE, "sound")),
        dict(_connections(sections.get("connections", empty))),
        _ordered(_processors(sections.get("processors", empty), absent, _preset(sections.get("preset")))),
        _values(sections["localizer"], LOCALIZER, "localizer") if "localizer" in sections else None,
    )


def read_parameters(text: str) -> dict[str, Any]:
    """Return the checked parameters of a tree request in `text`; an empty text contains none.

    The text is a YAML mapping: one line for each parameter, or a single line, whose braces are optional. The values of
    a JSON object are returned unchecked: programs send them, and the request checks them.

    Raises
    ------
    SetupError
        The text is not such a mapping, or the interface does not allow its values.
    """
    with contextlib.suppress(ValueError, RecursionError):
        if isinstance(values := json.loads(text, object_pairs_hook=_unique), dict):
            return values
    short = text.strip()
    if short and not short.startswith("{") and "\n" not in short:
        text = f"{{{short}\n}}"  # the line break ends a comment
    return _values(parse(text, MAX_PARAMETER_VALUES), _TREE_PARAMETERS, "parameters")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the members of a JSON object; ValueError if a name occurs twice."""
    if len(dict(pairs)) < len(pairs):
        raise ValueError
    return dict(pairs)


def _connections(node: YamlNode) -> Iterator[tuple[str, str]]:
    for port, _, value in node.members("connections", INPUT_PORTS):
        topic = value.scalar(f"connections: {port}")
        if len(topic) > MAX_STRING or not _TOPIC.fullmatch(topic):
            what = f"connections: expected the name of a topic, such as bass/Audio, got {short_repr(topic)}"
            raise SetupError(value.line, what)
        yield port, topic


# --- parameters -------------------------------------------------------------------------------------------------


def _values(
    node: YamlNode, parameters: tuple[Parameter, ...], what: str, ignored: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Return the checked values of a map of parameters without its `ignored` members."""
    values: dict[str, Any] = {}
    for name, key, value in node.members(what):
        if name in ignored:
            continue
        parameter = next((p for p in parameters if name in (p.name, *p.aliases)), None)
        if parameter is None:
            known = ", ".join((*ignored, *(p.name for p in parameters)))
            hint = did_you_mean(name, [p.name for p in parameters])
            raise SetupError(key.line, f"{what}: unknown {short_repr(name)}; expected one of {known}{hint}")
        if parameter.name in values:
            raise SetupError(key.line, f"{what}: {parameter.name} occurs twice")
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
        raise ValueError(f"{parameter.name}: expected {'a list' if sequence else 'one value'}")
    items: list[Any] = []
    if len(node.items) > parameter.most:
        raise ValueError(f"{parameter.name}: expected at most {parameter.most} values, got {len(node.items)}")
    for item in node.items:
        if item.text is None:
            raise ValueError(f"{parameter.name}: expected a list of single values")
        items += parameter.parse(item.text)
    return parameter.check(items)


def _parsed(parameter: Parameter, text: str) -> Any:
    if parameter.idl == "string":
        return text
    if parameter.idl == "boolean" and text.lower() in _BOOLEANS:
        return _BOOLEANS[text.lower()]
    return parameter.parse(text)


# --- processors -------------------------------------------------------------------------------------------------


def _preset(node: YamlNode | None) -> Mapping[str, Any]:
    """Return the parameters of the preset of a setup, which apply to all processors that have them."""
    if node is None:
        return {}
    name = node.scalar("preset")
    if name not in PRESETS:
        raise SetupError(node.line, f"preset: expected one of {', '.join(PRESETS)}, got {short_repr(name)}")
    return PRESETS[name]


def _processors(node: YamlNode, absent: list[str] | None, preset: Mapping[str, Any]) -> dict[str, _ProcessorEntry]:
    members = node.members("processors")
    if len(members) > MAX_PROCESSORS:
        raise SetupError(
            members[MAX_PROCESSORS][1].line, f"expected at most {MAX_PROCESSORS} processors, got {len(members)}"
        )
    if absent is not None:
        excluded = _of_unknown_kinds(members)
        absent += excluded.values()
        members = [member for member in members if member[0] not in excluded]
    return {name: _entry(name, key, value, preset) for name, key, value in members}


def _of_unknown_kinds(members: Sequence[tuple[str, YamlNode, YamlNode]]) -> dict[str, str]:
    """Return a line for each processor of an unknown kind, and for each of its descendants, by name."""
    excluded: dict[str, str] = {}
    parents: dict[str, str] = {}
    for name, _, node in members:
        values = {member: value for member, _, value in node.members(short_repr(name))}
        parents[name] = values["parent"].scalar(name) if "parent" in values else ""
        kind = values["kind"].scalar(name) if "kind" in values else "input"
        try:
            kind_of(kind)
        except ValueError:
            excluded[name] = f"{name} (plugin {short_repr(kind)} not found)"
    while children := {name for name, parent in parents.items() if parent in excluded and name not in excluded}:
        excluded |= {name: f"{name} (descendant of {parents[name]})" for name in children}
    return excluded


def _entry(name: str, key: YamlNode, node: YamlNode, preset: Mapping[str, Any]) -> _ProcessorEntry:
    what = short_repr(name)
    members = {member: value for member, _, value in node.members(what)}
    if "kind" not in members:
        raise SetupError(key.line, f"{what}: kind is missing; expected one of {', '.join(KINDS)}")
    kind = _kind(members["kind"], what)
    _check_name(name, key.line, kind)
    parent, parent_line = KINDS[kind.parent].name if kind.parent else "", key.line
    if "parent" in members:
        parent, parent_line = members["parent"].scalar(f"{what}: parent"), members["parent"].line
        if not kind.parent:
            raise SetupError(parent_line, f"{what}: expected no parent, since it is an input")
    parameters = parameters_of(kind)
    values = {p.name: p.check(preset[p.name]) for p in parameters if p.name in preset}
    values |= _values(node, parameters, what, ignored=("kind", "parent"))
    explicit = {p.name: values[p.name] for p in parameters if p.name in values and values[p.name] != p.check(p.default)}
    processor = SetupProcessor(name, kind.kind, parent, explicit)
    try:
        _ = processor.spec
    except ValueError as problem:
        raise SetupError(key.line, f"{what}: {problem}") from None
    return _ProcessorEntry(key.line, parent_line, processor)


def _kind(node: YamlNode, what: str) -> Representation:
    text = node.scalar(f"{what}: kind")
    try:
        return kind_of(text)
    except ValueError:
        kinds = ", ".join(KINDS)
        raise SetupError(node.line, f"{what}: unknown kind {short_repr(text)}; expected one of {kinds}") from None


def _check_name(name: str, line: int, kind: Representation) -> None:
    if not 0 < len(name) <= MAX_STRING or "\0" in name:
        raise SetupError(line, f"expected the name of a processor, got {short_repr(name)}")
    if kind.parent and not _NAME.fullmatch(name):
        raise SetupError(line, f"{short_repr(name)} also names a topic; use only letters, digits and _")


def _ordered(entries: Mapping[str, _ProcessorEntry]) -> tuple[SetupProcessor, ...]:
    """Return the processors in the order of the setup, but each after its parent. Raises SetupError if not a tree."""
    inputs = [entry for entry in entries.values() if not entry.processor.parent]
    if len(inputs) > 1:
        names = " and ".join(short_repr(entry.processor.name) for entry in inputs[:2])
        raise SetupError(inputs[1].line, f"expected at most one input, got two inputs: {names}")
    for entry in entries.values():
        _check_parent(entry, entries)
    ordered: dict[str, SetupProcessor] = {}
    for name in entries:
        branch = []
        while name and name not in ordered:  # ends: the kind of the parent is checked, and kinds form a tree
            branch.append(entries[name].processor)
            name = entries[name].processor.parent
        ordered.update({processor.name: processor for processor in reversed(branch)})
    return tuple(ordered.values())


def _check_parent(entry: _ProcessorEntry, entries: Mapping[str, _ProcessorEntry]) -> None:
    processor = entry.processor
    if not processor.parent:
        return
    what = f"{short_repr(processor.name)}: expected a parent of kind {processor.representation.parent}"
    parent = short_repr(processor.parent)
    if processor.parent not in entries:
        raise SetupError(entry.parent_line, f"{what}, got {parent}, which is not in the setup")
    kind = entries[processor.parent].processor.kind
    if kind != processor.representation.parent:
        raise SetupError(entry.parent_line, f"{what}, got {parent} of kind {kind}")
