"""The contents of a setup: sound, connections, and processors with their parents and parameters."""

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
# The settings of the localizer node, which are also its private ROS parameters.
LOCALIZER = (
    Parameter.text("head", "sphere", "Head: sphere, pair:SPACING (m), a SOFA file or a learned model"),
    Parameter.flag("mirror", False, "Whether the labels of a SOFA file exchange left and right"),  # or absent
    Parameter.real("seconds", 0.5, "Window of integration", 0.01, 60.0, unit="s"),
    Parameter.text("world_frame", "", "Coordinate frame of the azimuths; empty: the frame of the head"),
    Parameter.text("head_frame", "head", "Coordinate frame of the head"),
    Parameter.real("audio_delay", 0.0, "Latency of the sound card", -5.0, 5.0, unit="s"),
    Parameter.text("noise", "", "File of rosafe localize --calibrate-noise"),
)
LOCALIZER_FILES = ("head", "noise")  # settings that name files
INPUT_PORTS = tuple(port.name for port in ROSAFE.ports if not port.output)
MAX_ATTEMPTS = 1000  # combinations of parameters that are tried to describe a processor


@dataclass(frozen=True)
class AcquireSettings:
    """Arguments of bass' Acquire; `explicit` are those that differ from their defaults, by name."""

    explicit: Mapping[str, Any]

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> AcquireSettings:
        """Return the settings with these (checked) arguments."""
        return cls({p.name: values[p.name] for p in ACQUIRE if values.get(p.name, p.default) != p.default})

    @property
    def values(self) -> dict[str, Any]:
        """All arguments."""
        return {p.name: self.explicit.get(p.name, p.default) for p in ACQUIRE}


@dataclass(frozen=True)
class SetupProcessor:
    """One processor of a setup.

    Attributes
    ----------
    name, kind : str
    parent : str
        The name of another processor of the same setup; empty for the input.
    explicit : mapping
        The checked parameters that differ from their defaults; for an input also those of InputProc.
    """

    name: str
    kind: str
    parent: str = ""
    explicit: Mapping[str, Any] = field(default_factory=dict)

    @property
    def representation(self) -> Representation:
        """The declaration of its kind."""
        return KINDS[self.kind]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters that a setup can contain for it."""
        return parameters_of(self.representation)

    @property
    def values(self) -> dict[str, Any]:
        """All parameters of its kind."""
        return {**_defaults(self.representation.parameters), **self._explicit_of_kind}

    @property
    def all_values(self) -> dict[str, Any]:
        """All parameters that a setup can contain for it, with their values."""
        return {**_defaults(self.parameters), **self.explicit}

    @property
    def input_values(self) -> dict[str, Any]:
        """The parameters of InputProc that modifyParameter does not accept."""
        return {p.name: self.explicit.get(p.name, p.default) for p in BLOCK_AND_BUFFERS}

    @property
    def _explicit_of_kind(self) -> dict[str, Any]:
        return {p.name: self.explicit[p.name] for p in self.representation.parameters if p.name in self.explicit}

    @cached_property
    def spec(self) -> ProcessorSpec:
        """The processor in the form of tree requests. Raises ValueError for values that no sample rate allows."""
        effective = STAGES[self.kind].effective_values(self.values)
        return ProcessorSpec(self.representation, self.values, effective, self._explicit_of_kind)


@dataclass(frozen=True)
class Setup:
    """A tree of processors with its sound. `processors` are ordered: parents first.

    `localizer` has the settings of the localizer node, which `rosafe up` then starts; None without a localizer.
    """

    sound: AcquireSettings | None = None
    connections: Mapping[str, str] = field(default_factory=dict)  # input port -> topic
    processors: tuple[SetupProcessor, ...] = ()
    localizer: Mapping[str, Any] | None = None


def parameters_of(kind: Representation) -> tuple[Parameter, ...]:
    """Return all parameters that a setup can contain for a processor of `kind`."""
    return kind.parameters if kind.parent else (*BLOCK_AND_BUFFERS, *kind.parameters)


def _defaults(parameters: tuple[Parameter, ...]) -> dict[str, Any]:
    return {p.name: p.check(p.default) for p in parameters}


def setup_processor(found: ExistingProcessor) -> SetupProcessor:
    """Describe an existing processor with as few explicit parameters as possible.

    Parameters that follow from others, such as the channels of a filterbank from their number, are left out.
    """
    if found.kind not in KINDS:
        raise ROSAFE.error(
            "e_badNewValue",
            what=f"{found.name!r} is of kind {found.kind}, of a plugin that this program has not loaded; "
            f"set {plugins.FOLDERS} and restart it",
        )
    kind = KINDS[found.kind]
    explicit = _shortest_description(found.kind, {p.name: found.values[p.name] for p in kind.parameters})
    if not kind.parent:
        values = {p.name: found.values.get(p.name, p.default) for p in BLOCK_AND_BUFFERS}
        explicit = {p.name: values[p.name] for p in BLOCK_AND_BUFFERS if values[p.name] != p.default} | explicit
    return SetupProcessor(found.name, found.kind, found.parent, explicit)


def _shortest_description(kind: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a small part of the `values` from which, with the defaults of `kind`, all `values` follow."""
    defaults = _defaults(KINDS[kind].parameters)
    differing = {name: value for name, value in values.items() if value != defaults[name]}

    def suffices(names: frozenset[str]) -> bool:
        try:
            return STAGES[kind].effective_values(defaults | {n: v for n, v in values.items() if n in names}) == values
        except ValueError:
            return False

    all_names = frozenset(differing)
    candidates = (
        all_names - set(left_out)
        for count in range(len(all_names) + 1)
        for left_out in itertools.combinations(differing, count)
    )
    names = next(filter(suffices, itertools.islice(candidates, MAX_ATTEMPTS)), all_names)
    for name in differing:
        if name in names and suffices(names - {name}):
            names -= {name}
    return {name: value for name, value in differing.items() if name in names}
