"""The little of YAML that setups and lists of parameters are in: nodes that know their lines; scalars, lists, maps.

Texts come from anywhere, over the network too. There are no tags, no anchors and no merging, and so nothing that grows
or is evaluated; what a scalar means is for the parameter to say, not for YAML.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import yaml

from rosafe.vocabulary.parameter import shown

MAX_DEPTH = 6  # a setup has 4
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_FRAMES = (yaml.StreamStartEvent, yaml.StreamEndEvent, yaml.DocumentStartEvent, yaml.DocumentEndEvent)


class SetupError(ValueError):
    """A setup cannot be used; the text is one line that names the line of the setup."""

    def __init__(self, line: int, what: str) -> None:
        super().__init__(f"line {line}: {what}")


class Node(NamedTuple):
    """A value and its line. One of `text`, `items` and `pairs` is there; none is where nothing stands."""

    line: int
    text: str | None = None
    items: tuple[Node, ...] | None = None
    pairs: tuple[tuple[Node, Node], ...] | None = None

    @property
    def empty(self) -> bool:
        """Whether nothing stands there."""
        return self.text is self.items is self.pairs is None

    def word(self, what: str) -> str:
        """The text; SetupError where there is none."""
        if self.text is None:
            raise SetupError(self.line, f"{what}: wanted is a word")
        return self.text

    def members(self, what: str, known: tuple[str, ...] = ()) -> list[tuple[str, Node, Node]]:
        """The names, keys and values of a map; SetupError where a name is there twice, or is none of those `known`.

        Nothing is an empty map.
        """
        if self.pairs is None and not self.empty:
            raise SetupError(self.line, f"{what}: wanted are lines with NAME: VALUE")
        members: dict[str, tuple[str, Node, Node]] = {}
        for key, value in self.pairs or ():
            name = key.word(f"{what}: a name")
            if name in members:
                raise SetupError(
                    key.line, f"{what}: {shown(name)} is there twice, first in line {members[name][1].line}"
                )
            if known and name not in known:
                raise SetupError(key.line, f"{what}: unknown {shown(name)}; there are: {', '.join(known)}")
            members[name] = name, key, value
        return list(members.values())


def parse(text: str) -> Node:
    """The one document of `text`, or SetupError."""
    try:
        events = iter(yaml.parse(text, Loader=_LOADER))
        documents = [_build(events, event, 0) for event in events if not isinstance(event, _FRAMES)]
    except yaml.MarkedYAMLError as problem:
        mark = problem.problem_mark or problem.context_mark
        raise SetupError(1 if mark is None else mark.line + 1, f"not YAML: {problem.problem}") from None
    except (yaml.YAMLError, UnicodeError) as problem:
        raise SetupError(1, f"not YAML: {str(problem).splitlines()[0]}") from None
    if len(documents) > 1:
        raise SetupError(documents[1].line, "a second document; wanted is one")
    return documents[0] if documents else Node(1)


def _build(events: Iterator[yaml.Event], event: yaml.Event, depth: int) -> Node:
    line = event.start_mark.line + 1
    if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
        raise SetupError(line, "anchors and aliases (& and *) are not taken")
    if event.tag is not None:
        raise SetupError(line, f"tags ({shown(event.tag)}) are not taken")
    if isinstance(event, yaml.ScalarEvent):
        nothing = event.style in (None, "") and event.value in ("", "~", "null")
        return Node(line) if nothing else Node(line, text=event.value)
    if depth == MAX_DEPTH:
        raise SetupError(line, "nested too deeply")
    if isinstance(event, yaml.SequenceStartEvent):
        return Node(line, items=tuple(_until(events, yaml.SequenceEndEvent, depth)))
    nodes = _until(events, yaml.MappingEndEvent, depth)
    return Node(line, pairs=tuple(zip(nodes, nodes, strict=True)))


def _until(events: Iterator[yaml.Event], end: type[yaml.Event], depth: int) -> Iterator[Node]:
    while not isinstance(event := next(events), end):
        yield _build(events, event, depth + 1)
