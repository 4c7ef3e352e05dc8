"""Representations: what one computes and is called, declared once, beside its numerics, for every door to read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from rosafe.declarations.checks import as_tuple, bad_name, bad_text, short, twice
from rosafe.declarations.idl import SCALARS, element
from rosafe.declarations.parameter import REQUIRED, Parameter

AXES = ("ear", "channel", "lag", "filter", "feature", "time")
# Other fields of the requests that a parameter goes into, and arguments of Stage
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


@dataclass(frozen=True)
class Part:
    """One array of what a representation puts out.

    Attributes
    ----------
    name : str
        The kind, where there is only one.
    axes : tuple of str
        Out of `AXES`, time last. Without `ear` it is of both ears together.
    unit : str
        Of its values.
    """

    name: str
    axes: tuple[str, ...]
    unit: str = ""

    def __post_init__(self) -> None:
        problem = as_tuple(self, "axes", str, "strings") or bad_text(self.unit, empty=True)
        if name := bad_name(self.name):
            problem = f"name: {name}"
        if problem:
            raise ValueError(f"part {short(self.name)}: {problem}")


@dataclass(frozen=True)
class Derived:
    """Something that follows from the parameters and is reported beside them, such as the lags."""

    name: str
    idl: str
    doc: str
    unit: str = ""

    def __post_init__(self) -> None:
        problem = bad_name(self.name) or bad_text(self.doc, empty=True) or bad_text(self.unit, empty=True)
        if not isinstance(self.idl, str) or (element(self.idl) or self.idl) not in SCALARS:
            problem = f"type: expected a type of parameters, got {short(self.idl)}"
        if problem:
            raise ValueError(f"derived value {short(self.name)}: {problem}")


@dataclass(frozen=True)
class Representation:
    """The declaration of one kind of processor.

    What is empty follows from `kind`: for `onsetMap` that is the request `OnsetMapProc`, the port `onsetMapPort`, and
    `onsetMap` as the default name of a processor and as the word of `rosafe request` and of MATLAB.

    Attributes
    ----------
    kind : str
        Also the name of its output of `rosafe.process`, and of its array in getParameters and getSignals.
    doc : str
        What it computes, in one line.
    parent : str
        The kind of processor that it hangs on; empty for the input.
    axes : tuple of str
        Of what it puts out; `parts` instead where that is several arrays.
    unit : str
        Of what it puts out.
    parameters : tuple of Parameter
        In the order of the parameter structure.
    request_order : tuple of str
        Names of the parameters in the order of the request, where that is another one.
    coordinates : tuple of str
        The parameters and derived values that tell what lies along its axes; `rosafe.process` returns them.
    features : tuple of str
        What the rows along its `feature` axis are, where that never changes.
    centred : str
        The axis whose middle stays where it is when a change alters its length; others are aligned at their first.
    allow_nan : bool
        Whether the output of a plugin may contain NaN or infinity; otherwise such output ends the processor.
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

    def __post_init__(self) -> None:
        for problem in self._bad_types():
            raise ValueError(f"representation {short(self.kind)}: {problem}")
        kind = self.kind
        capital = kind[:1].upper() + kind[1:]
        defaults = {
            "name": kind,
            "name_doc": f"The name of this {self.word or kind} processor",
            "request": f"{capital}Proc",
            "port": f"{kind}Port",
            "port_doc": self.doc,
            "word": kind,
            "parts": (Part(kind, self.axes, self.unit),),
        }
        for attribute, default in defaults.items():
            object.__setattr__(self, attribute, getattr(self, attribute) or default)
        for problem in self._problems():
            raise ValueError(f"representation {kind!r}: {problem}")

    def _problems(self) -> Iterator[str]:
        """What is wrong with the declaration by itself; rosafe/representations checks how it fits the others."""
        for field in ("name", "request", "port", "word"):
            if problem := bad_name(getattr(self, field)):
                yield f"{field}: {problem}"
        for field in ("request_aliases", "port_aliases", "word_aliases"):
            for name in getattr(self, field):
                if problem := bad_name(name):
                    yield f"{field}: {problem}"
        for field in ("doc", "name_doc", "port_doc"):
            if problem := bad_text(getattr(self, field)):
                yield f"{field}: {problem}"
        if self.parent and (problem := bad_name(self.parent)):
            yield f"parent: {problem}"
        if problem := bad_text(self.unit, empty=True):
            yield f"unit: {problem}"
        yield from self._bad_parts()
        yield from self._bad_values()

    def _bad_types(self) -> Iterator[str]:
        if problem := bad_name(self.kind):
            yield f"kind: {problem}"
        for field in ("doc", "parent", "unit", "centred", "name", "name_doc", "request", "port", "port_doc", "word"):
            if not isinstance(getattr(self, field), str):
                yield f"{field}: expected a string, got {short(getattr(self, field))}"
        allow_nan: object = self.allow_nan
        if not isinstance(allow_nan, bool):
            yield f"allow_nan: expected True or False, got {short(allow_nan)}"
        words = "axes", "request_order", "coordinates", "features", "request_aliases", "port_aliases", "word_aliases"
        kinds: tuple[tuple[str, type, str], ...] = (
            *((field, str, "strings") for field in words),
            ("parts", Part, "Part"),
            ("parameters", Parameter, "Parameter"),
            ("derived", Derived, "Derived"),
        )
        for field, of, what in kinds:
            if problem := as_tuple(self, field, of, what):
                yield problem

    def _bad_parts(self) -> Iterator[str]:
        for part in self.parts:
            axes = part.axes
            if axes[-1:] != ("time",) or len(set(axes)) < len(axes) or not set(axes) <= set(AXES):
                yield f"axes: expected different ones of {', '.join(AXES)}, time last, got {short(axes)}"
            if "ear" in axes[1:]:
                yield f"axes: expected ear first, got {short(axes)}"
        if name := twice(part.name for part in self.parts):
            yield f"parts: two are called {name!r}"
        if len(self.parts) > 1:
            for part in self.parts:
                if part.name in RESERVED_PARTS:
                    yield f"parts: {part.name!r} is the name of another field of the message, or of another result"
        axes = tuple(axis for part in self.parts for axis in part.axes)
        if self.centred and (self.centred not in axes or self.centred == "time"):
            yield f"centred: expected one of the axes, got {short(self.centred)}"
        if self.features:
            if "feature" not in axes:
                yield "features: expected none without an axis feature"
            for name in self.features:
                if problem := bad_text(name):
                    yield f"features: {problem}"
            if name := twice(self.features):
                yield f"features: {name!r} occurs twice"

    def _bad_values(self) -> Iterator[str]:
        for parameter in self.parameters:
            if parameter.default is REQUIRED:
                yield f"parameters: {parameter.name} has no default"
        own = [name for p in self.parameters for name in (p.name, *p.aliases, *p.former)]
        own += [derived.name for derived in self.derived]
        if name := twice(own):
            yield f"parameters: two parameters, or a derived value, are called {name!r}"
        for name in own:
            if name in RESERVED_PARAMETERS or name.startswith("genom_"):
                yield f"parameters: {name!r} is the name of another field of the request"
        if self.request_order and sorted(self.request_order) != sorted(p.name for p in self.parameters):
            yield "request_order: expected the names of all parameters, each once"
        types = {p.name: p.idl for p in self.parameters} | {d.name: d.idl for d in self.derived}
        for name in self.coordinates:
            if not types.get(name, "").startswith("sequence<"):
                yield f"coordinates: expected a parameter or derived value that is a sequence, got {name!r}"
        if name := twice(self.coordinates):
            yield f"coordinates: {name!r} occurs twice"

    def parameter(self, name: str) -> Parameter:
        """The parameter that modifyParameter calls `name`, or KeyError."""
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
        """The parts by their names in a result: the kind, with the part's name where there are several."""
        several = len(self.parts) > 1
        return {f"{self.kind}_{part.name}" if several else self.kind: part for part in self.parts}

    @property
    def task(self) -> str:
        """The component's task that its processors belong to in genom_state."""
        return self.request[:1].lower() + self.request[1:]

    @property
    def binaural(self) -> bool:
        """Whether what it puts out is of both ears together."""
        return all("ear" not in part.axes for part in self.parts)

    def __str__(self) -> str:
        return self.kind
