"""Representations: what one computes and is called, declared once, beside its numerics, for every door to read."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

from .parameter import Parameter

AXES = ("ear", "channel", "lag", "filter", "feature", "time")
_WORD = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


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


@dataclass(frozen=True)
class Derived:
    """Something that follows from the parameters and is reported beside them, such as the lags."""

    name: str
    idl: str
    doc: str
    unit: str = ""


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
        names = [self.kind, self.name, self.request, self.port, self.word, *(p.name for p in self.parameters)]
        for name in names:
            if not (isinstance(name, str) and _WORD.fullmatch(name)):
                yield f"{name!r} is no name: a letter, then letters, digits and _"
        if not self.doc or "\n" in self.doc:
            yield "doc: wanted is one line"
        for part in self.parts:
            if part.axes[-1:] != ("time",) or len(set(part.axes)) < len(part.axes) or not set(part.axes) <= set(AXES):
                yield f"axes: {part.axes} are not different ones of {', '.join(AXES)}, time last"
        own = [name for p in self.parameters for name in (p.name, *p.aliases, *p.former)]
        if len(set(own)) < len(own):
            yield "parameters: two have one name"
        if self.request_order and sorted(self.request_order) != sorted(p.name for p in self.parameters):
            yield "request_order: wanted are the names of all parameters"
        known = {p.name for p in self.parameters} | {d.name for d in self.derived}
        for name in set(self.coordinates) - known:
            yield f"coordinates: there is no {name!r}"
        for parameter in self.parameters:
            parameter.check(parameter.default)

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
