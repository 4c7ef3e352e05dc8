"""One request for a whole tree: what a representation needs, which of it is there, and the requests for the rest.

Pure: `plan` goes from what getParameters and getDependencies tell to the requests to make. rosafe/tree/tree_builder.py
makes them; docs/request.md has the rules.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from rosafe.declarations import plugins
from rosafe.declarations.text import did_you_mean
from rosafe.interface import BASS, KINDS, REQUEST, ROSAFE, ComponentError, Representation, format_value
from rosafe.interface.arguments import check_parameter
from rosafe.representations import PROBLEMS, STAGES

HIGHEST_RATE = float(BASS.service("Acquire").parameter("sampleRate").maximum or 0)  # Hz; what is wrong there is at any
INTERRUPTED = "::genom::interrupted"
_RACES = {f"::rosAFE::{short}" for short in ("e_existsAlready", "e_noUpperDependencie", "e_noSuchProcessor")}
# What only the making of an input needs: the topic, and InputProc's parameters without its name.
OF_THE_INPUT = ("connect", *(p.name for p in ROSAFE.service("InputProc").parameters[1:]))


class ExistingProcessor(NamedTuple):
    """A processor of the tree. `values` are those of getParameters; `parent` is empty for the input."""

    name: str
    kind: str
    parent: str
    values: Mapping[str, Any]
    rate: float = 0.0  # frames of output per second


class ServiceCall(NamedTuple):
    """One request to make, with all its values; `makes` is the name of the processor that it adds, if it does."""

    service: str
    values: dict[str, Any]
    makes: str = ""


class TreePlan(NamedTuple):
    """The names from the input down to the wanted processor, and what to do for those that are not there."""

    dependencies: list[str]
    steps: list[ServiceCall]


@dataclass(frozen=True)
class ProcessorSpec:
    """One processor on the way from the input to the wanted one.

    `values` are all its parameters, as asked for; `in_force` what getParameters tells of a processor that was made
    with them (of a filterbank, the channels that come of it); `given` those that the client named.
    """

    kind: Representation
    values: Mapping[str, Any]
    in_force: Mapping[str, Any]
    given: Mapping[str, Any]

    def matches(self, found: ExistingProcessor, sample_rate: float) -> bool:
        """Whether `found`, at a sample rate (Hz), is what is wanted: each parameter the same, to the last digit.

        A structure of getParameters fits the processor that it describes, though one that was made with all that
        it names would tell otherwise of how its channels were chosen.
        """
        told = {name: found.values[name] for name in self.in_force}
        in_force = self.in_force
        if sample_rate and any(p.follows_rate for p in self.kind.parameters):
            stage = STAGES[self.kind.kind]
            in_force = stage.effective_values(stage.resolve_rate_defaults(self.values, self.given, sample_rate))
        return told in (in_force, {**in_force, **self.given})


@dataclass(frozen=True)
class TreeRequest:
    """A checked request for a whole tree: `levels` from the input to the wanted processor, `given` by the client."""

    levels: tuple[ProcessorSpec, ...]
    input_values: Mapping[str, Any]  # of InputProc, less its name
    given: Mapping[str, Any]

    @property
    def kinds(self) -> list[str]:
        """The kinds of processors on the way, the input first."""
        return [level.kind.kind for level in self.levels]

    @property
    def connect(self) -> str:
        """The topic to connect the Audio port to, whatever it is connected to; empty where the client named none."""
        return str(self.given.get("connect", ""))


# --- what is wanted ---------------------------------------------------------------------------------------------


def kind_of(representation: str) -> Representation:
    """The kind of processor that computes `representation`, by the original client's name or ours, in any case.

    Raises ValueError for any other name.
    """
    for kind in KINDS.values():
        if representation.lower() in map(str.lower, (kind.word, *kind.word_aliases, kind.kind)):
            return kind
    parameter = REQUEST.parameter("representation")
    hint = did_you_mean(representation, parameter.choices)
    raise ValueError(
        f"representation: {representation[:80]!r} is not {parameter.range_text}; plugins are loaded when a program "
        f"starts: {searched()}{hint}"
    )


def searched() -> str:
    """Where plugins were searched for, and which were left out."""
    return "; left out: ".join((plugins.where(), *PROBLEMS))


def ancestor_kinds(kind: Representation) -> list[Representation]:
    """The kinds of processors from the input down to `kind`."""
    return [*(ancestor_kinds(KINDS[kind.parent]) if kind.parent else ()), kind]


def parse_request(kind: Representation, given: Mapping[str, Any]) -> TreeRequest:
    """The checked request for a processor of `kind`.

    Parameters
    ----------
    kind : Representation
        From `kind_of`.
    given : mapping
        Parameters of `interface.REQUEST` by their own names, of the right Python types; taken literally, 0 too.

    Raises
    ------
    ComponentError
        ``::rosAFE::e_badNewValue``, as the component itself would, for what no sample rate makes possible.
    """
    for above in ancestor_kinds(kind):
        given = STAGES[above.kind].request_values(given)
    try:
        for name in OF_THE_INPUT:
            if name in given:
                REQUEST.parameter(name).check(given[name])
        # What belongs to none of them has no effect, and is checked all the same.
        checked = dict(check_parameter(name, value) for name, value in given.items() if name not in OF_THE_INPUT)
        levels = tuple(_level(above, checked) for above in ancestor_kinds(kind))
    except ValueError as problem:
        raise ROSAFE.error("e_badNewValue", what=str(problem)) from None
    input_values = {p.name: given.get(p.name, p.default) for p in ROSAFE.service("InputProc").parameters[1:]}
    return TreeRequest(levels, input_values, dict(given))


def _level(kind: Representation, checked: Mapping[str, Any]) -> ProcessorSpec:
    given = {p.name: checked[p.name] for p in kind.parameters if p.name in checked}
    values = {p.name: p.check(p.default) for p in kind.parameters} | given
    return ProcessorSpec(kind, values, STAGES[kind.kind].effective_values(values), given)


# --- what to do -------------------------------------------------------------------------------------------------


def plan(wish: TreeRequest, found: Sequence[ExistingProcessor], reserved: Collection[str] = ()) -> TreePlan:
    """What to do for `wish` in a tree that consists of `found`; new processors get none of the names `reserved`.

    What is there and fits is used, as far down as possible; the rest is made below it, under new names.

    Raises
    ------
    ComponentError
        ``::rosAFE::e_existsAlready`` where the input, of which there is but one, has other parameters than given.
    """
    root = next((p for p in found if not p.parent and p.kind == "input"), None)
    if root is not None:
        _check_input(root, wish.levels[0])
    reused = _deepest(wish.levels, found, root.rate if root is not None else 0.0)
    names = {*reserved, *(p.name for p in found)}
    dependencies, steps = reused[:], []
    for level in wish.levels[len(reused) :]:
        name = free_name(level.kind, names)
        names.add(name)
        steps += creation_call(level, name, dependencies[-1] if dependencies else "", wish.input_values)
        dependencies.append(name)
    return TreePlan(dependencies, steps)


def _check_input(root: ExistingProcessor, level: ProcessorSpec) -> None:
    for name, value in level.given.items():
        if root.values[name] != value:
            there = f"the input {root.name!r} has {name} {format_value(root.values[name])}"
            what = f"{there}, which modifyParameter changes for all"
            raise ROSAFE.error("e_existsAlready", what=what)


def _deepest(levels: Sequence[ProcessorSpec], found: Iterable[ExistingProcessor], sample_rate: float) -> list[str]:
    """The names, from the input on, of the longest line of processors that fit."""
    lines: dict[str, list[str]] = {"": []}  # that fit so far, by the name of their last processor
    for level in levels:
        longer = {
            p.name: [*lines[p.parent], p.name]
            for p in found
            if p.kind == level.kind.kind and p.parent in lines and (not p.parent or level.matches(p, sample_rate))
        }
        if not longer:
            break
        lines = longer
    return next(iter(lines.values()))


def free_name(kind: Representation, names: Collection[str]) -> str:
    """A name for another processor of `kind` beside those called `names`: numbered after the highest of its sort."""
    pattern = re.compile(rf"{kind.word}_([0-9]{{1,9}})")
    number = 1 + max((int(match[1]) for match in map(pattern.fullmatch, names) if match), default=-1)
    while f"{kind.word}_{number}" in names:
        number += 1
    return f"{kind.word}_{number}"


def creation_call(level: ProcessorSpec, name: str, parent: str, input_values: Mapping[str, Any]) -> list[ServiceCall]:
    """The requests for one processor. What that of an input cannot carry is set before anything hangs on it.

    `input_values` are those of InputProc less its name, of which only an input takes notice.
    """
    if level.kind.parent:
        free = {p.name: math.nan for p in level.kind.parameters if p.follows_rate and p.name not in level.given}
        return [ServiceCall(level.kind.request, {"name": name, "upperDepName": parent, **level.values, **free}, name)]
    changed = {p.name: level.values[p.name] for p in level.kind.parameters if level.values[p.name] != p.default}
    return [
        ServiceCall(level.kind.request, {"name": name, **input_values}, name),
        *(
            ServiceCall("modifyParameter", {"nameProc": name, "nameParam": parameter, "newValue": format_value(value)})
            for parameter, value in changed.items()
        ),
    ]


# --- what has been done -----------------------------------------------------------------------------------------


def build_response(
    wish: TreeRequest, dependencies: Sequence[str], created: Collection[str], instance: str
) -> dict[str, Any]:
    """The outputs of `interface.REQUEST`, once the processors `dependencies` are there."""
    return {
        "name": dependencies[-1],
        "dependencies": list(dependencies),
        "created": [name for name in dependencies if name in created],
        "reused": [name for name in dependencies if name not in created],
        "unused": unused((level.kind for level in wish.levels), wish.given, dependencies[0] in created),
        "port": wish.levels[-1].kind.port,
        "topic": topic(instance, wish.levels[-1].kind, dependencies[-1]),
    }


def unused(kinds: Iterable[Representation], given: Iterable[str], new_input: bool) -> list[str]:
    """Which of the parameters `given` have no effect on a processor with these kinds from the input down to it."""
    own = {p.name for kind in kinds for p in kind.parameters} | {*(OF_THE_INPUT if new_input else ())}
    return [name for name in given if name not in own]


def topic(instance: str, kind: Representation, name: str) -> str:
    """Where the processor `name` publishes."""
    return f"/{instance}/{kind.port}" + (f"/{name}" if ROSAFE.port(kind.port).multiple else "")


def chain_exists(dependencies: Sequence[str], found: Iterable[ExistingProcessor]) -> bool:
    """Whether processors of these names hang on each other, the first one being the input."""
    parents = {p.name: p.parent for p in found}
    return all(parents.get(name) == parent for parent, name in itertools.pairwise(["", *dependencies]))


def is_race(problem: ComponentError) -> bool:
    """Whether somebody else changed the tree between the look at it and a step: to be planned anew."""
    if problem.ex == INTERRUPTED:
        return problem.detail.get("by") == "InputProc"
    return problem.ex in _RACES
