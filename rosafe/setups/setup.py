"""What a setup is made of: sound, connections, processors with their parents and parameters."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from rosafe.declarations import plugins
from rosafe.interface import BASS, BLOCK_AND_BUFFERS, KINDS, ROSAFE, Parameter, Representation
from rosafe.representations import STAGES
from rosafe.tree.tree_planner import ExistingProcessor, ProcessorSpec

ACQUIRE = BASS.service("Acquire").parameters
MAX_NAME_ATTEMPTS = 1000  # ways to say what a processor was made with


@dataclass(frozen=True)
class AcquireSettings:
    """What bass is to acquire: those arguments of its Acquire, by name, that are not at their defaults."""

    given: Mapping[str, Any]

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> AcquireSettings:
        """The sound with these (checked) arguments."""
        return cls({p.name: values[p.name] for p in ACQUIRE if values.get(p.name, p.default) != p.default})

    @property
    def values(self) -> dict[str, Any]:
        """All arguments."""
        return {p.name: self.given.get(p.name, p.default) for p in ACQUIRE}


@dataclass(frozen=True)
class SetupProcessor:
    """One processor of a setup.

    Attributes
    ----------
    name, kind : str
    parent : str
        The name of another one of the same setup; empty for the input.
    given : mapping
        The parameters that are not at their defaults, checked; of an input those of InputProc, too.
    """

    name: str
    kind: str
    parent: str = ""
    given: Mapping[str, Any] = field(default_factory=dict)

    @property
    def representation(self) -> Representation:
        """The declaration of its kind."""
        return KINDS[self.kind]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """All that can be given."""
        return parameters_of(self.representation)

    @property
    def values(self) -> dict[str, Any]:
        """All parameters of its kind."""
        return {**_defaults(self.representation.parameters), **self._own}

    @property
    def all_values(self) -> dict[str, Any]:
        """All that can be given."""
        return {p.name: self.given.get(p.name, p.check(p.default)) for p in self.parameters}

    @property
    def input_values(self) -> dict[str, Any]:
        """The parameters of InputProc that modifyParameter does not take."""
        return {p.name: self.given.get(p.name, p.default) for p in BLOCK_AND_BUFFERS}

    @property
    def _own(self) -> dict[str, Any]:
        return {p.name: self.given[p.name] for p in self.representation.parameters if p.name in self.given}

    @cached_property
    def level(self) -> ProcessorSpec:
        """As requests for whole trees see it; ValueError for values that go together at no sample rate."""
        return ProcessorSpec(
            self.representation, self.values, STAGES[self.kind].effective_values(self.values), self._own
        )


@dataclass(frozen=True)
class Setup:
    """A tree of processors with its sound. `processors` are ordered: parents first."""

    sound: AcquireSettings | None = None
    connections: Mapping[str, str] = field(default_factory=dict)  # input port -> topic
    processors: tuple[SetupProcessor, ...] = ()


INPUT_PORTS = tuple(port.name for port in ROSAFE.ports if not port.output)


def parameters_of(kind: Representation) -> tuple[Parameter, ...]:
    """All parameters that a processor of `kind` can be given in a setup."""
    return kind.parameters if kind.parent else (*BLOCK_AND_BUFFERS, *kind.parameters)


def _defaults(parameters: tuple[Parameter, ...]) -> dict[str, Any]:
    return {p.name: p.check(p.default) for p in parameters}


def wanted(found: ExistingProcessor) -> SetupProcessor:
    """The processor that `found` tells of, with as few parameters as tell all of it.

    What follows from others, such as the channels of a filterbank from their number, is left out.
    """
    if found.kind not in KINDS:
        raise ROSAFE.error(
            "e_badNewValue",
            what=f"{found.name!r} is a {found.kind}, of a plugin that this program was started without; "
            f"set {plugins.FOLDERS} and restart it",
        )
    kind = KINDS[found.kind]
    told = {p.name: found.values[p.name] for p in kind.parameters}
    defaults = _defaults(kind.parameters)
    given = _given(found.kind, told, defaults)
    if not kind.parent:
        of_the_input = {p.name: found.values.get(p.name, p.default) for p in BLOCK_AND_BUFFERS}
        given = {p.name: of_the_input[p.name] for p in BLOCK_AND_BUFFERS if of_the_input[p.name] != p.default} | given
    return SetupProcessor(found.name, found.kind, found.parent, given)


def _given(kind: str, told: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    differing = {name: value for name, value in told.items() if value != defaults[name]}

    def tells(names: frozenset[str]) -> bool:
        try:
            return STAGES[kind].effective_values({**defaults, **{n: v for n, v in told.items() if n in names}}) == told
        except ValueError:
            return False

    everything = frozenset(differing)
    ways = (
        everything - set(left_out)
        for count in range(len(everything) + 1)
        for left_out in itertools.combinations(differing, count)
    )
    names = next(filter(tells, itertools.islice(ways, MAX_NAME_ATTEMPTS)), everything)
    for name in differing:
        if name in names and tells(names - {name}):
            names -= {name}
    return {name: value for name, value in differing.items() if name in names}
