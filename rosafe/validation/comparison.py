"""Comparisons of a representation with an independent reference, and the disturbances that they have to detect."""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rosafe.declarations.reference import LITERATURE, Reference
from rosafe.declarations.text import short_repr
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.validation.stimuli import TALKERS, largest

KEMAR = "/usr/share/libmysofa/default.sofa"  # measured responses of MIT KEMAR
PACKAGES = {KEMAR: "libmysofa1", **dict.fromkeys(TALKERS, "alsa-utils")}  # of Debian

# The evidence that a comparison provides. The order is that of the page.
INDEPENDENT = "independent"  # the expected numbers come from a publication, a closed form, a measurement or a program
STAGE = "stage"  # another program computes one stage from the project's own input of that stage
DEFINITION = "definition"  # the expected numbers follow from the definition that the project itself has chosen
LIMITATION = "limitation"  # a number is reported without a tolerance

Process = Callable[[Any, float, Mapping[str, Any], Sequence[str]], Any]
Change = Callable[[Process], Process]


@dataclass(frozen=True)
class Curve:
    """Reference values and measured values over a common axis, for a figure."""

    x: Any
    expected: Any
    measured: Any
    x_label: str
    y_label: str
    logarithmic: bool = False


@dataclass(frozen=True)
class Measured:
    """The largest deviation from the reference."""

    deviation: float
    curve: Curve | None = None

    @classmethod
    def of(
        cls, x: Any, expected: Any, measured: Any, x_label: str, y_label: str, logarithmic: bool = False
    ) -> Measured:
        """Return the largest difference of two curves, with both of them."""
        curve = Curve(x, expected, measured, x_label, y_label, logarithmic)
        return cls(largest(np.subtract(measured, expected)), curve)


Measure = Callable[[Process], Measured | float]


@dataclass(frozen=True)
class Disturbance:
    """A small error of the representation, which the comparison has to detect."""

    text: str
    change: Change


@dataclass(frozen=True)
class Origin:
    """The publication, program or data set of the reference values.

    Attributes
    ----------
    text : str
        A section, equation, table or figure; or the name of a closed form, a program or a data set.
    reference : Reference or None
        The publication.
    """

    text: str = ""
    reference: Reference | None = None

    @property
    def markdown(self) -> str:
        """The text, with a link to the publication."""
        if self.reference is None:
            return self.text
        label = self.reference.label
        linked = f"[{label}](https://doi.org/{self.reference.doi})" if self.reference.doi else label
        return f"{linked}, {self.text}" if self.text else linked

    def __str__(self) -> str:
        if self.reference is None:
            return self.text
        return ", ".join(filter(None, (self.reference.label, self.text, self.reference.doi)))


@dataclass(frozen=True)
class Comparison:
    """One row of the validation.

    Attributes
    ----------
    kind : str
        The representation.
    subject : str
        The quantity and the stimulus.
    source : Origin
        The publication, program or data set of the reference values.
    unit : str
        Of the deviation.
    tolerance : float
        The largest deviation of a valid representation; infinite for a limitation.
    disturbance : Disturbance or None
        An error whose deviation exceeds the tolerance; None for a limitation.
    measure : callable
        Computes the deviation with a function like `process`.
    evidence : str
        `INDEPENDENT`, `STAGE`, `DEFINITION` or `LIMITATION`.
    criterion : str
        How the deviation is computed from the values.
    requires : tuple of str
        Modules, and paths, without which the comparison is skipped. A package that imports its parts at their first
        use (librosa) is named with the part.
    under_test : callable or None
        The function under test, called like `process`; None for `rosafe.process`.
    """

    kind: str
    subject: str
    source: Origin
    unit: str
    tolerance: float
    disturbance: Disturbance | None
    measure: Measure
    evidence: str
    criterion: str = "largest difference"
    requires: tuple[str, ...] = ()
    under_test: Process | None = None

    @property
    def short(self) -> bool:
        """Whether it is part of the short form, which needs no other toolbox."""
        return all("/" in need for need in self.requires)

    @property
    def group(self) -> str:
        """The name of the module that defines it."""
        return getattr(self.measure, "func", self.measure).__module__.rpartition(".")[2]

    @property
    def missing(self) -> str:
        """The reason for which it cannot be computed here; empty if it can."""
        return next(filter(None, map(_problem, self.requires)), "")


def _problem(need: str) -> str:
    """Return the reason for which a module or a path cannot be used; empty if it can."""
    if "/" not in need:
        return _import_problem(need)
    if not Path(need).exists():
        return f"{need} is not installed" + (f" (Debian's {PACKAGES[need]})" if need in PACKAGES else "")
    return _import_problem("h5py") if need.endswith(".sofa") else ""


@lru_cache
def _import_problem(module: str) -> str:
    """Return the reason for which a module cannot be imported; empty if it can."""
    package = module.partition(".")[0]
    if not importlib.util.find_spec(package):
        return f"{package} is not installed"
    try:
        importlib.import_module(module)
    except Exception as problem:  # any failure of another toolbox, which must not end the validation
        return f"{module} cannot be imported ({type(problem).__name__}: {short_repr(str(problem))})"
    return ""


@dataclass
class Collection:
    """The comparisons of a module, in the order of their definition."""

    comparisons: list[Comparison] = field(default_factory=list)

    def add(
        self,
        kind: str,
        subject: str,
        source: Origin,
        unit: str,
        tolerance: float,
        disturbance: Disturbance | None,
        **more: Any,
    ) -> Callable[[Measure], Measure]:
        """Return a decorator that adds a comparison; the arguments are the attributes of `Comparison`."""

        def register(measure: Measure) -> Measure:
            self.comparisons.append(Comparison(kind, subject, source, unit, tolerance, disturbance, measure, **more))
            return measure

        return register

    def listed(self, disturbance: Disturbance | None = None, **more: Any) -> Callable[[Measure], Measure]:
        """Return a decorator that adds a comparison whose other attributes are in comparisons.json, by its name."""

        def register(measure: Measure) -> Measure:
            row = dict(_LISTED[measure.__name__])
            source = Origin(row.pop("source", ""), LITERATURE[key] if (key := row.pop("reference", "")) else None)
            row["requires"] = tuple(row.pop("requires", ()))
            row.setdefault("tolerance", math.inf)
            return self.add(source=source, disturbance=disturbance, **row, **more)(measure)

        return register

    def limitation(
        self, kind: str, subject: str, source: Origin, unit: str, **more: Any
    ) -> Callable[[Measure], Measure]:
        """Return a decorator that adds a number without a tolerance."""
        return self.add(kind, subject, source, unit, math.inf, None, evidence=LIMITATION, **more)


_LISTED: dict[str, dict[str, Any]] = json.loads(Path(__file__).with_name("comparisons.json").read_text("utf-8"))


def parameter(name: str, value: Any) -> Disturbance:
    """Return a disturbance that computes with another value of a parameter."""

    def change(process: Process) -> Process:
        return lambda signal, rate, parameters, outputs: process(signal, rate, {**parameters, name: value}, outputs)

    return Disturbance(f"`{name}` = {value}", change)


def altered(text: str, name: str, change_array: Callable[[FloatArray], FloatArray]) -> Disturbance:
    """Return a disturbance of one output."""

    def change(process: Process) -> Process:
        def run(signal: FloatArray, rate: float, parameters: Mapping[str, Any], outputs: Sequence[str]) -> Any:
            result = process(signal, rate, parameters, outputs)
            if name in result:
                result[name] = change_array(result[name])
            return result

        return run

    return Disturbance(text, change)


def scaled(name: str, factor: float) -> Disturbance:
    """Return a disturbance that multiplies an output."""
    return altered(f"{name} multiplied by {factor:.12g}", name, lambda values: values * factor)


def shifted(name: str, amount: float, unit: str = "") -> Disturbance:
    """Return a disturbance that adds a constant to an output."""
    return altered(f"{name} + {amount:g} {unit}".rstrip(), name, lambda values: values + amount)


def late(name: str, frames: int = 1) -> Disturbance:
    """Return a disturbance that delays an output by some frames or samples."""
    return altered(f"{name} late by {frames}", name, lambda values: np.roll(values, frames, axis=-1))
