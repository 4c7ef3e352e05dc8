"""Declarations of representations: names, parameters and output, from which all interfaces are derived."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from rosafe.declarations.checks import (
    bad_flag,
    bad_name,
    bad_optional_name,
    bad_optional_text,
    bad_string,
    bad_text,
    bad_type,
    duplicate,
    each,
    field_problems,
    tuple_problems,
)
from rosafe.declarations.idl import element
from rosafe.declarations.parameter import REQUIRED, Parameter
from rosafe.declarations.reference import Citation
from rosafe.declarations.text import short_repr

AXES = ("ear", "channel", "lag", "filter", "feature", "time")
# Other fields of the requests with parameters, and arguments of Stage
RESERVED_PARAMETERS = frozenset(
    [
        "name",
        "upperDepName",
        "representation",
        "connect",
        "parameters",
        "nFramesPerBlock",
        "bufferSize_s_port",
        "bufferSize_s_getSignal",
        "input_format",
        "given",
        "sample_rate",
        "block_frames",
    ]
)
# Other fields of the message, and other results that begin with the kind
RESERVED_PARTS = frozenset(
    [
        "sampleRate",
        "lastFrameIndex",
        "framesOnPort",
        "numberOfLags",
        "numberOfFilters",
        "numberOfChannels",
        "time",
        "frameRate",
    ]
)
Advice = Callable[[Mapping[str, Any]], str] | None  # a warning, or '', about the values of parameters


@dataclass(frozen=True)
class Part:
    """One array of the output of a representation.

    Attributes
    ----------
    name : str
        The kind, if there is only one part.
    axes : tuple of str
        A selection of `AXES`, time last. Without `ear` the array is for both ears together.
    unit : str
        The unit of the values.
    """

    name: str
    axes: tuple[str, ...]
    unit: str = ""

    def __post_init__(self) -> None:
        fields = {"name": bad_name, "unit": bad_optional_text}
        for problem in (*field_problems(self, fields), *tuple_problems(self, ("axes",), str, "strings")):
            raise ValueError(f"part {short_repr(self.name)}: {problem}")


def _part_problems(part: Part, single: bool) -> Iterator[str]:
    axes = part.axes
    if axes[-1:] != ("time",) or len(set(axes)) < len(axes) or not set(axes) <= set(AXES):
        yield f"axes: expected different ones of {', '.join(AXES)}, time last, got {short_repr(axes)}"
    if "ear" in axes[1:]:
        yield f"axes: expected ear first, got {short_repr(axes)}"
    if not single and part.name in RESERVED_PARTS:
        yield f"parts: {part.name!r} is the name of another field of the message, or of another result"


@dataclass(frozen=True)
class Derived:
    """A value that is computed from the parameters and reported with them, such as the lags."""

    name: str
    idl: str
    doc: str
    unit: str = ""

    def __post_init__(self) -> None:
        for problem in field_problems(self, {"name": bad_name, **dict.fromkeys(("doc", "unit"), bad_optional_text)}):
            raise ValueError(f"derived value {short_repr(self.name)}: {problem}")
        if problem := bad_type(self.idl):
            raise ValueError(f"derived value {short_repr(self.name)}: type: {problem}")


_NAMES = ("name", "request", "port", "word")
_TEXTS = ("doc", "name_doc", "port_doc")
_ALIASES = ("request_aliases", "port_aliases", "word_aliases")
_TYPES = {
    "kind": bad_name,
    **dict.fromkeys((*_NAMES, *_TEXTS, "parent", "unit", "centred", "background", "channel_parameter"), bad_string),
    "allow_nan": bad_flag,
}
_TUPLES: tuple[tuple[type, str, tuple[str, ...]], ...] = (
    (str, "strings", ("axes", "request_order", "coordinates", "features", "amplitude_choice", *_ALIASES)),
    (Part, "Part", ("parts",)),
    (Parameter, "Parameter", ("parameters",)),
    (Derived, "Derived", ("derived",)),
    (Citation, "Citation", ("references",)),
)
_VALUES = {
    **dict.fromkeys(_NAMES, bad_name),
    **dict.fromkeys(_ALIASES, each(bad_name)),
    **dict.fromkeys(_TEXTS, bad_text),
    **dict.fromkeys(("parent", "background"), bad_optional_name),
    "level": lambda value: "" if value in (0, 10, 20) else f"expected 0, 10 or 20 dB, got {short_repr(value)}",
    "advice": lambda value: "" if value is None or callable(value) else f"expected a function, got {short_repr(value)}",
    "unit": bad_optional_text,
    "features": each(bad_text),
}


@dataclass(frozen=True)
class Representation:
    """The declaration of one kind of processor.

    Empty names are derived from `kind`: for `onsetMap` these are the request `OnsetMapProc`, the port `onsetMapPort`,
    and `onsetMap` as the default name of a processor and as the word of `rosafe request` and of MATLAB.

    Attributes
    ----------
    kind : str
        Also the name of its output of `rosafe.process`, and of its array in getParameters and getSignals.
    doc : str
        The computation, in one line.
    parent : str
        The kind of its parent processor; empty for the input.
    axes : tuple of str
        The axes of the output. Use `parts` instead if the output consists of several arrays.
    unit : str
        The unit of the output.
    parameters : tuple of Parameter
        In the order of the parameter structure.
    request_order : tuple of str
        Names of the parameters in the order of the request, if that order is different.
    coordinates : tuple of str
        The parameters and derived values that hold the coordinates of its axes; `rosafe.process` returns them.
    features : tuple of str
        The names of the rows along its `feature` axis, if they never change.
    centred : str
        The axis that is aligned at its middle if an update changes its length; other axes are aligned at the start.
    level : float
        dB per factor of ten if plots show the values as levels: 10 for powers, 20 for amplitudes; 0 otherwise.
    amplitude_choice : tuple of (str, str)
        The parameter and the choice of it with which the values are amplitudes instead of powers; empty for none.
    background : str
        The kind over which plots draw this one, if a result has both: values that are not 0 as marks, the first
        feature (Hz) as points.
    channel_parameter : str
        The parameter that sets the centre frequencies of the channels, if this kind creates the axis `channel`.
    advice : callable
        Returns a warning about valid but unsuitable values, or ''. It gets a dict with the parameters of the kind and
        of the kinds that it is computed from.
    allow_nan : bool
        Whether the output of a plugin may contain NaN or infinity; otherwise such output ends the processor.
    references : tuple of Citation
        The publications that describe it, the most important one first; `rosafe cite` prints them.
    """

    kind: str
    doc: str
    parent: str = ""
    axes: tuple[str, ...] = ()
    unit: str = ""
    parts: tuple[Part, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    request_order: tuple[str, ...] = ()
    derived: tuple[Derived, ...] = ()
    coordinates: tuple[str, ...] = ()
    features: tuple[str, ...] = ()
    centred: str = ""
    level: float = 0.0
    amplitude_choice: tuple[str, ...] = ()
    background: str = ""
    channel_parameter: str = ""
    advice: Advice = None
    allow_nan: bool = False
    name: str = ""
    name_doc: str = ""
    request: str = ""
    request_aliases: tuple[str, ...] = ()
    port: str = ""
    port_aliases: tuple[str, ...] = ()
    port_doc: str = ""
    word: str = ""
    word_aliases: tuple[str, ...] = ()
    references: tuple[Citation, ...] = ()

    def __post_init__(self) -> None:
        for problem in self._type_problems():
            raise ValueError(f"representation {short_repr(self.kind)}: {problem}")
        kind = self.kind
        defaults = {
            "name": kind,
            "name_doc": f"The name of this {self.word or kind} processor",
            "request": f"{kind[:1].upper()}{kind[1:]}Proc",
            "port": f"{kind}Port",
            "port_doc": self.doc,
            "word": kind,
            "parts": (Part(kind, self.axes, self.unit),),
        }
        for attribute, default in defaults.items():
            object.__setattr__(self, attribute, getattr(self, attribute) or default)
        for problem in self._problems():
            raise ValueError(f"representation {kind!r}: {problem}")

    def _type_problems(self) -> Iterator[str]:
        yield from field_problems(self, _TYPES)
        for of, elements, fields in _TUPLES:
            yield from tuple_problems(self, fields, of, elements)

    def _problems(self) -> Iterator[str]:
        """Yield the defects of the declaration itself; rosafe/representations compares it with the others."""
        yield from field_problems(self, _VALUES)
        for part in self.parts:
            yield from _part_problems(part, single=len(self.parts) == 1)
        if name := duplicate(part.name for part in self.parts):
            yield f"parts: two are called {name!r}"
        axes = {axis for part in self.parts for axis in part.axes}
        if self.centred and self.centred not in axes - {"time"}:
            yield f"centred: expected one of the axes, got {short_repr(self.centred)}"
        if self.features and "feature" not in axes:
            yield "features: expected none without an axis feature"
        yield from self._parameter_problems()
        yield from self._rule_problems()
        for field in ("features", "coordinates"):
            if name := duplicate(getattr(self, field)):
                yield f"{field}: {name!r} occurs twice"

    def _parameter_problems(self) -> Iterator[str]:
        for parameter in self.parameters:
            if parameter.default is REQUIRED:
                yield f"parameters: {parameter.name} has no default"
        if name := duplicate(self.value_names):
            yield f"parameters: two parameters, or a derived value, are called {name!r}"
        for name in self.value_names:
            if name in RESERVED_PARAMETERS or name.startswith("genom_"):
                yield f"parameters: {name!r} is the name of another field of the request"
        if self.request_order and sorted(self.request_order) != sorted(p.name for p in self.parameters):
            yield "request_order: expected the names of all parameters, each once"

    def _rule_problems(self) -> Iterator[str]:
        types = {p.name: p.idl for p in self.parameters} | {d.name: d.idl for d in self.derived}
        choices = {(p.name, choice) for p in self.parameters for choice in p.choices}
        if self.amplitude_choice and self.amplitude_choice not in choices:
            yield f"amplitude_choice: expected a parameter and one of its choices, got {self.amplitude_choice!r}"
        of_channels = self.channel_parameter
        if of_channels and (types.get(of_channels) != "sequence<double>" or "channel" not in self.parts[0].axes):
            yield f"channel_parameter: expected a sequence<double>, and the axis channel, got {of_channels!r}"
        for name in self.coordinates:
            if not element(types.get(name, "")):
                yield f"coordinates: expected a parameter or derived value that is a sequence, got {name!r}"

    @property
    def value_names(self) -> list[str]:
        """The names of all parameters, with their further names, and of all derived values."""
        parameters = [name for p in self.parameters for name in (p.name, *p.aliases, *p.former)]
        return parameters + [derived.name for derived in self.derived]

    @property
    def units(self) -> dict[str, str]:
        """The units of all parameters and derived values, by name."""
        return {p.name: p.unit for p in self.parameters} | {d.name: d.unit for d in self.derived}

    def parameter(self, name: str) -> Parameter:
        """Return the parameter with this name in modifyParameter. Raise KeyError if there is none."""
        for parameter in self.parameters:
            if name == parameter.name or name in parameter.aliases or name in parameter.former:
                return parameter
        raise KeyError(name)

    @property
    def request_parameters(self) -> tuple[Parameter, ...]:
        """The parameters in the order of the request."""
        return tuple(map(self.parameter, self.request_order)) or self.parameters

    @property
    def outputs(self) -> dict[str, Part]:
        """The parts by their names in a result: the kind, followed by the name of the part if there are several."""
        several = len(self.parts) > 1
        return {f"{self.kind}_{part.name}" if several else self.kind: part for part in self.parts}

    def decibels(self, values: Mapping[str, Any]) -> float:
        """Return the dB per factor of ten with which plots show it as a level; 0 if they show the values themselves."""
        name, choice = self.amplitude_choice or ("", "")
        return 20.0 if name and values.get(name) == choice else float(self.level)

    @property
    def task(self) -> str:
        """The task of its processors in genom_state."""
        return self.request[:1].lower() + self.request[1:]

    @property
    def binaural(self) -> bool:
        """Whether the output is for both ears together."""
        return all("ear" not in part.axes for part in self.parts)

    def __str__(self) -> str:
        return self.kind
