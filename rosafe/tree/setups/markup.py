"""Parser for the subset of YAML in setups and lists of parameters: scalars, lists and maps, with line numbers.

The texts can come from untrusted sources. Tags, anchors and merging are rejected, so that no text expands or is
evaluated; the parameter, not YAML, determines the meaning of a scalar. Directives are rejected before libyaml sees
them, because it needs quadratic time for many %TAG lines; the time for everything else is proportional to the length of
the text and the number of its values, and both are limited.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import yaml

from rosafe.declarations.text import short_repr

MAX_DEPTH = 6  # a setup needs 4
MAX_VALUES = 2**18  # scalars, lists and maps of a setup, ends of lists and maps included: less than a second of parsing
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DIRECTIVE = re.compile("%(?<![^\n\r\x85\u2028\u2029\ufeff]%)[^\n\r\x85\u2028\u2029]*")  # at a start of line (YAML 1.1)
_VERSION = re.compile(r"%YAML[ \t]+1\.[12][ \t]*([ \t]#.*)?")
_FRAMES = (yaml.StreamStartEvent, yaml.StreamEndEvent, yaml.DocumentStartEvent, yaml.DocumentEndEvent)


class SetupError(ValueError):
    """The setup is invalid; the text is one line that starts with the line number in the setup."""

    def __init__(self, line: int, what: str) -> None:
        super().__init__(f"line {line}: {what}")


class YamlNode(NamedTuple):
    """A value and its line number. A scalar has `text`, a list `items`, a map `pairs`; an empty value has none."""

    line: int
    text: str | None = None
    items: tuple[YamlNode, ...] | None = None
    pairs: tuple[tuple[YamlNode, YamlNode], ...] | None = None

    @property
    def empty(self) -> bool:
        """Whether the value is empty."""
        return self.text is None and self.items is None and self.pairs is None

    def scalar(self, what: str) -> str:
        """Return the text. Raises SetupError, which names `what`, if the node is not a scalar."""
        if self.text is None:
            raise SetupError(self.line, f"{what}: expected a single value")
        return self.text

    def members(self, what: str, known: tuple[str, ...] = ()) -> list[tuple[str, YamlNode, YamlNode]]:
        """Return the names, keys and values of a map. An empty value is an empty map.

        Raises SetupError, which names `what`, if the node is not a map, a name occurs twice or is not `known`.
        """
        if self.pairs is None and not self.empty:
            raise SetupError(self.line, f"{what}: expected lines with NAME: VALUE")
        members: dict[str, tuple[str, YamlNode, YamlNode]] = {}
        for key, value in self.pairs or ():
            name = key.scalar(f"{what}: a name")
            if name in members:
                first = members[name][1].line
                raise SetupError(key.line, f"{what}: {short_repr(name)} occurs twice, first in line {first}")
            if known and name not in known:
                raise SetupError(key.line, f"{what}: unknown {short_repr(name)}; expected one of {', '.join(known)}")
            members[name] = name, key, value
        return list(members.values())


def parse(text: str, max_values: int = MAX_VALUES) -> YamlNode:
    """Return the one document of `text`. Raises SetupError, also if it has more than `max_values` values."""
    _check_directives(text)
    try:
        events = _counted(yaml.parse(text, Loader=_LOADER), max_values)
        documents = [_build(events, event, 0) for event in events if not isinstance(event, _FRAMES)]
    except yaml.MarkedYAMLError as problem:
        mark = problem.problem_mark or problem.context_mark
        raise SetupError(1 if mark is None else mark.line + 1, f"not YAML: {problem.problem}") from None
    except (yaml.YAMLError, UnicodeError) as problem:
        raise SetupError(1, f"not YAML: {str(problem).splitlines()[0]}") from None
    if len(documents) > 1:
        raise SetupError(documents[1].line, "expected one document, got a second document")
    return documents[0] if documents else YamlNode(1)


def _check_directives(text: str) -> None:
    """Raise SetupError for any directive other than one ``%YAML 1.1`` or ``%YAML 1.2``."""
    for number, found in enumerate(_DIRECTIVE.finditer(text)):
        if number or not _VERSION.fullmatch(found[0]):
            line = len(re.findall("\r\n|[\n\r\x85\u2028\u2029]", text[: found.start()])) + 1
            directive = short_repr(found[0][:80])
            raise SetupError(line, f"expected no directive except one %YAML 1.1 or 1.2, got {directive}")


def _counted(events: Iterator[yaml.Event], max_values: int) -> Iterator[yaml.Event]:
    for count, event in enumerate(events):
        if count > max_values + 4:  # four events start and end the stream and the document
            raise SetupError(event.start_mark.line + 1, f"expected at most {max_values} values, got more")
        yield event


def _build(events: Iterator[yaml.Event], event: yaml.Event, depth: int) -> YamlNode:
    line = event.start_mark.line + 1
    if type(event) is yaml.ScalarEvent and event.anchor is event.tag is None:  # the most frequent case
        empty = not event.style and event.value in ("", "~", "null")
        return YamlNode(line, None if empty else event.value)
    if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
        raise SetupError(line, "anchors and aliases (& and *) are not supported")
    if event.tag is not None:
        raise SetupError(line, f"tags ({short_repr(event.tag)}) are not supported")
    if depth == MAX_DEPTH:
        raise SetupError(line, "nested too deeply")
    if isinstance(event, yaml.SequenceStartEvent):
        return YamlNode(line, items=tuple(_until(events, yaml.SequenceEndEvent, depth)))
    nodes = _until(events, yaml.MappingEndEvent, depth)
    return YamlNode(line, pairs=tuple(zip(nodes, nodes, strict=True)))


def _until(events: Iterator[yaml.Event], end: type[yaml.Event], depth: int) -> Iterator[YamlNode]:
    while not isinstance(event := next(events), end):
        yield _build(events, event, depth + 1)
