"""Plan of a request for a whole tree: the processors to reuse, and those to create.

rosafe/tree/tree_builder.py executes the plan; docs/request.md has the rules.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from rosafe.declarations import plugins
from rosafe.declarations.text import did_you_mean
from rosafe.interface import KINDS, REQUEST, ROSAFE, Representation, format_value
from rosafe.interface.arguments import check_parameters
from rosafe.representations import PROBLEMS, STAGES

# Parameters that only the creation of an input needs: the topic, and those of InputProc except its name.
OF_THE_INPUT = ("connect", *(p.name for p in ROSAFE.service("InputProc").parameters[1:]))


class ExistingProcessor(NamedTuple):
    """A processor of the tree. `values` are its parameters; `parent` is empty for the input."""

    name: str
    kind: str
    parent: str
    values: Mapping[str, Any]
    rate: float = 0.0  # frames of output per second


class NewProcessor(NamedTuple):
    """A processor to create. `parameters` are those of its stage; an input also has the values of InputProc."""

    name: str
    kind: str
    parent: str
    parameters: Mapping[str, Any]
    input_values: Mapping[str, Any] = {}


class TreePlan(NamedTuple):
    """The names of all processors of a request, parents first, and those of them that have to be created."""

    names: list[str]
    steps: list[NewProcessor]

    @property
    def created(self) -> list[str]:
        """The names of the processors to create."""
        return [step.name for step in self.steps]

    @property
    def reused(self) -> list[str]:
        """The names of the existing processors."""
        created = set(self.created)
        return [name for name in self.names if name not in created]

    @property
    def new_input(self) -> NewProcessor | None:
        """The input, if it has to be created."""
        return self.steps[0] if self.steps and not self.steps[0].parent else None


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

    def creation(self, name: str, parent: str, input_values: Mapping[str, Any]) -> NewProcessor:
        """Return the step that creates this processor; only an input uses the `input_values`."""
        kind = self.kind
        free = {p.name for p in kind.parameters if p.follows_rate and p.name not in self.explicit}
        requested = STAGES[kind.kind].request_values(self.values)
        parameters = {parameter: value for parameter, value in requested.items() if parameter not in free}
        return NewProcessor(name, kind.kind, parent, parameters, {} if kind.parent else input_values)


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


def plan(request: TreeRequest, found: Sequence[ExistingProcessor]) -> TreePlan:
    """Plan `request` in a tree that consists of `found`.

    The longest chain of existing processors that match is reused; the others are created below it under new names.

    Raises
    ------
    ComponentError
        ``::rosAFE::e_existsAlready`` if the input, of which there is only one, has other parameters than requested.
    """
    root = next((p for p in found if not p.parent and p.kind == "input"), None)
    if root is not None:
        _check_input(root, request.specs[0])
    names = _longest_match(request.specs, found, root.rate if root is not None else 0.0)
    used = {p.name for p in found}
    steps: list[NewProcessor] = []
    for spec in request.specs[len(names) :]:
        name = free_name(spec.kind, used)
        steps.append(spec.creation(name, names[-1] if names else "", request.input_values))
        names.append(name)
    return TreePlan(names, steps)


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


def unused(kinds: Iterable[Representation], names: Iterable[str], new_input: bool) -> list[str]:
    """Return the parameters `names` that have no effect on a processor with these kinds from the input down to it."""
    own = {p.name for kind in kinds for p in kind.parameters} | {*(OF_THE_INPUT if new_input else ())}
    return [name for name in names if name not in own]
