"""Plan of a request for a whole tree: the processors to reuse, and the service calls that create the others.

This module calls no service. rosafe/tree/tree_builder.py executes the plan; docs/request.md has the rules.
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
from rosafe.interface import KINDS, REQUEST, ROSAFE, ComponentError, Representation, format_value
from rosafe.interface.arguments import check_parameters
from rosafe.representations import PROBLEMS, STAGES

INTERRUPTED = "::genom::interrupted"
_RACES = {f"::rosAFE::{short}" for short in ("e_existsAlready", "e_noUpperDependencie", "e_noSuchProcessor")}
# Parameters that only the creation of an input needs: the topic, and those of InputProc except its name.
OF_THE_INPUT = ("connect", *(p.name for p in ROSAFE.service("InputProc").parameters[1:]))


class ExistingProcessor(NamedTuple):
    """A processor of the tree. `values` are those that getParameters returns; `parent` is empty for the input."""

    name: str
    kind: str
    parent: str
    values: Mapping[str, Any]
    rate: float = 0.0  # frames of output per second


class ServiceCall(NamedTuple):
    """A service call with all its values. `creates` is the name of the processor that it creates, if any."""

    service: str
    values: dict[str, Any]
    creates: str = ""


class TreePlan(NamedTuple):
    """The names from the input down to the requested processor, and the calls that create the missing ones."""

    dependencies: list[str]
    steps: list[ServiceCall]


@dataclass(frozen=True)
class ProcessorSpec:
    """A processor on the way from the input to the requested one.

    Attributes
    ----------
    kind : Representation
    values : mapping
        All its parameters, with defaults.
    effective : mapping
        The values that getParameters returns for a processor that was created with `values`; for a filterbank these
        include the resulting channels.
    explicit : mapping
        The parameters that the client named.
    """

    kind: Representation
    values: Mapping[str, Any]
    effective: Mapping[str, Any]
    explicit: Mapping[str, Any]

    def matches(self, found: ExistingProcessor, sample_rate: float) -> bool:
        """Return whether `found` has exactly these parameters at a sample rate in Hz.

        The values that getParameters returned for a processor match this processor too, although a processor created
        with all of them would report another selection of its channels.
        """
        reported = {name: found.values[name] for name in self.effective}
        effective = self.effective
        if sample_rate and any(p.follows_rate for p in self.kind.parameters):
            stage = STAGES[self.kind.kind]
            effective = stage.effective_values(stage.resolve_rate_defaults(self.values, self.explicit, sample_rate))
        return reported in (effective, {**effective, **self.explicit})


@dataclass(frozen=True)
class TreeRequest:
    """A checked request for a whole tree: the processors from the input to the requested one."""

    specs: tuple[ProcessorSpec, ...]
    input_values: Mapping[str, Any]  # of InputProc, except its name
    explicit: Mapping[str, Any]  # by the client

    @property
    def kinds(self) -> list[str]:
        """The kinds of the processors, the input first."""
        return [spec.kind.kind for spec in self.specs]


# --- requests ---------------------------------------------------------------------------------------------------


def kind_of(representation: str) -> Representation:
    """Return the kind of processor called `representation`, by the original client's name or ours, in any case.

    Raises ValueError for an unknown name.
    """
    for kind in KINDS.values():
        if representation.lower() in map(str.lower, (kind.word, *kind.word_aliases, kind.kind)):
            return kind
    parameter = REQUEST.parameter("representation")
    hint = did_you_mean(representation, parameter.choices)
    raise ValueError(
        f"representation: expected {parameter.range_text}, got {representation[:80]!r}; plugins are loaded when a "
        f"program starts: {searched()}{hint}"
    )


def searched() -> str:
    """Return where plugins were searched, and which were left out."""
    return "; left out: ".join((plugins.where(), *PROBLEMS))


def ancestor_kinds(kind: Representation) -> list[Representation]:
    """Return the kinds of processors from the input down to `kind`."""
    return [*(ancestor_kinds(KINDS[kind.parent]) if kind.parent else ()), kind]


def parse_request(kind: Representation, values: Mapping[str, Any]) -> TreeRequest:
    """Check a request for a processor of `kind`.

    Parameters
    ----------
    kind : Representation
        From `kind_of`.
    values : mapping
        Parameters of `interface.REQUEST` by their own names, of the right Python types. 0 does not mean the default.

    Raises
    ------
    ComponentError
        ``::rosAFE::e_badNewValue``, as from the component, for a value that is wrong at every sample rate.
    """
    for ancestor in ancestor_kinds(kind):
        values = STAGES[ancestor.kind].request_values(values)
    try:
        for name in OF_THE_INPUT:
            if name in values:
                REQUEST.parameter(name).check(values[name])
        # Parameters of none of the processors have no effect, but they are checked too.
        checked = check_parameters({name: value for name, value in values.items() if name not in OF_THE_INPUT})
        specs = tuple(_spec(ancestor, checked) for ancestor in ancestor_kinds(kind))
    except ValueError as problem:
        raise ROSAFE.error("e_badNewValue", what=str(problem)) from None
    input_values = {p.name: values.get(p.name, p.default) for p in ROSAFE.service("InputProc").parameters[1:]}
    return TreeRequest(specs, input_values, dict(values))


def _spec(kind: Representation, checked: Mapping[str, Any]) -> ProcessorSpec:
    explicit = {p.name: checked[p.name] for p in kind.parameters if p.name in checked}
    values = {p.name: p.check(p.default) for p in kind.parameters} | explicit
    return ProcessorSpec(kind, values, STAGES[kind.kind].effective_values(values), explicit)


# --- plans ------------------------------------------------------------------------------------------------------


def plan(request: TreeRequest, found: Sequence[ExistingProcessor], reserved: Collection[str] = ()) -> TreePlan:
    """Plan `request` in a tree that consists of `found`. New processors get none of the names `reserved`.

    The longest chain of existing processors that match is reused; the others are created below it under new names.

    Raises
    ------
    ComponentError
        ``::rosAFE::e_existsAlready`` if the input, of which there is only one, has other parameters than requested.
    """
    root = next((p for p in found if not p.parent and p.kind == "input"), None)
    if root is not None:
        _check_input(root, request.specs[0])
    reused = _longest_match(request.specs, found, root.rate if root is not None else 0.0)
    names = {*reserved, *(p.name for p in found)}
    dependencies, steps = reused[:], []
    for spec in request.specs[len(reused) :]:
        name = free_name(spec.kind, names)
        names.add(name)
        steps += creation_call(spec, name, dependencies[-1] if dependencies else "", request.input_values)
        dependencies.append(name)
    return TreePlan(dependencies, steps)


def _check_input(root: ExistingProcessor, spec: ProcessorSpec) -> None:
    for name, value in spec.explicit.items():
        if root.values[name] != value:
            present = f"the input {root.name!r} has {name} {format_value(root.values[name])}"
            raise ROSAFE.error("e_existsAlready", what=f"{present}, which modifyParameter changes for all")


def _longest_match(specs: Sequence[ProcessorSpec], found: Iterable[ExistingProcessor], sample_rate: float) -> list[str]:
    """Return the names, from the input on, of the longest chain of processors that match."""
    chains: dict[str, list[str]] = {"": []}  # that match so far, by the name of their last processor
    for spec in specs:
        longer = {
            p.name: [*chains[p.parent], p.name]
            for p in found
            if p.kind == spec.kind.kind and p.parent in chains and (not p.parent or spec.matches(p, sample_rate))
        }
        if not longer:
            break
        chains = longer
    return next(iter(chains.values()))


def free_name(kind: Representation, names: Collection[str]) -> str:
    """Return a name for a new processor of `kind` that is not in `names`, numbered after the highest of its kind."""
    pattern = re.compile(rf"{kind.word}_([0-9]{{1,9}})")
    number = 1 + max((int(match[1]) for match in map(pattern.fullmatch, names) if match), default=-1)
    while f"{kind.word}_{number}" in names:
        number += 1
    return f"{kind.word}_{number}"


def creation_call(spec: ProcessorSpec, name: str, parent: str, input_values: Mapping[str, Any]) -> list[ServiceCall]:
    """Return the calls that create one processor.

    InputProc does not accept the parameters of the input's stage: modifyParameter sets them before the input has
    children. `input_values` are the other parameters of InputProc except its name; only an input uses them.
    """
    kind = spec.kind
    if kind.parent:
        free = {p.name: math.nan for p in kind.parameters if p.follows_rate and p.name not in spec.explicit}
        return [ServiceCall(kind.request, {"name": name, "upperDepName": parent, **spec.values, **free}, name)]
    changed = {p.name: spec.values[p.name] for p in kind.parameters if spec.values[p.name] != p.default}
    return [
        ServiceCall(kind.request, {"name": name, **input_values}, name),
        *(
            ServiceCall("modifyParameter", {"nameProc": name, "nameParam": parameter, "newValue": format_value(value)})
            for parameter, value in changed.items()
        ),
    ]


# --- responses --------------------------------------------------------------------------------------------------


def build_response(
    request: TreeRequest, dependencies: Sequence[str], created: Collection[str], node: str
) -> dict[str, Any]:
    """Return the outputs of `interface.REQUEST` when the processors `dependencies` exist."""
    kinds = [spec.kind for spec in request.specs]
    return {
        "name": dependencies[-1],
        "dependencies": list(dependencies),
        "created": [name for name in dependencies if name in created],
        "reused": [name for name in dependencies if name not in created],
        "unused": unused(kinds, request.explicit, dependencies[0] in created),
        "port": kinds[-1].port,
        "topic": topic(node, kinds[-1], dependencies[-1]),
    }


def unused(kinds: Iterable[Representation], names: Iterable[str], new_input: bool) -> list[str]:
    """Return the parameters `names` that have no effect on a processor with these kinds from the input down to it."""
    own = {p.name for kind in kinds for p in kind.parameters} | {*(OF_THE_INPUT if new_input else ())}
    return [name for name in names if name not in own]


def topic(node: str, kind: Representation, name: str) -> str:
    """Return the topic of the processor `name`."""
    return f"{node}/{kind.port}" + (f"/{name}" if ROSAFE.port(kind.port).multiple else "")


def chain_exists(dependencies: Sequence[str], found: Iterable[ExistingProcessor]) -> bool:
    """Return whether these names are a chain of parents and children that begins with the input."""
    parents = {p.name: p.parent for p in found}
    return all(parents.get(name) == parent for parent, name in itertools.pairwise(["", *dependencies]))


def is_race(problem: ComponentError) -> bool:
    """Return whether another client changed the tree after it was listed, so that a new plan is needed."""
    if problem.ex == INTERRUPTED:
        return problem.detail.get("by") == "InputProc"
    return problem.ex in _RACES
