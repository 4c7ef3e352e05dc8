"""Variants of a representation: the same computation as a kind of its own, with other defaults and parameter names."""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, ClassVar

from rosafe.declarations.representation import Advice, Representation

from .signal_format import SignalFormat
from .stage import Stage


def variant(base: type[Stage], kind: str, prefix: str, doc: str = "", **defaults: Any) -> type[Stage]:
    """Create a subclass of the stage of a representation that performs the same computation as another kind.

    Parameters
    ----------
    base : type
        The stage, such as ``rosafe.representations.ratemap.Ratemap``.
    kind : str
        The name of the new kind.
    prefix : str
        The prefix of its parameter names: ``rm_decaySec`` of a ratemap becomes ``<prefix>_decaySec``.
    doc : str
        The computation, in one line; by default that of `base`.
    **defaults
        Default values by the new names; other defaults are those of `base`.

    Returns
    -------
    type
        The stage, a class of the calling module.

    Raises
    ------
    ValueError
        If a default is for an unknown parameter, or out of range.
    """
    known = base.REPRESENTATION
    inner_names = [*(p.name for p in known.parameters), *(d.name for d in known.derived)]
    names = {name: f"{prefix}_{name.partition('_')[2]}" for name in inner_names}
    unknown = set(defaults) - set(names.values())
    if unknown:
        raise ValueError(f"{min(unknown)}: expected one of {', '.join(names.values())}")
    inner = tuple(replace(p, default=defaults.get(names[p.name], p.default)) for p in known.parameters)
    single = len(known.parts) == 1
    renewed: dict[str, Any] = {
        **dict.fromkeys(("name", "name_doc", "request", "port", "port_doc", "word"), ""),
        **dict.fromkeys(("request_aliases", "port_aliases", "word_aliases"), ()),
    }
    declared = replace(
        known,
        kind=kind,
        doc=doc or known.doc,
        axes=known.parts[0].axes if single else (),
        unit=known.parts[0].unit if single else "",
        parts=() if single else known.parts,
        parameters=tuple(replace(p, name=names[p.name], aliases=(), former=()) for p in inner),
        request_order=tuple(names[name] for name in known.request_order),
        derived=tuple(replace(d, name=names[d.name]) for d in known.derived),
        **_outward_rules(known, names),
        **renewed,
    )
    attributes: dict[str, Any] = {
        "REPRESENTATION": declared,
        "NAMES": names,
        "DECLARED_WITHIN": replace(known, parameters=inner),
    }
    attributes |= {"__doc__": base.__doc__, "__module__": sys._getframe(1).f_globals["__name__"]}
    return type(kind[:1].upper() + kind[1:], (_Variant, base), attributes)


def _outward_rules(known: Representation, names: Mapping[str, str]) -> dict[str, Any]:
    """Return the fields of the base that contain names of parameters, with the names of the variant."""
    return {
        "coordinates": tuple(names[name] for name in known.coordinates),
        "amplitude_choice": tuple(names.get(word, word) for word in known.amplitude_choice),
        "channel_parameter": names.get(known.channel_parameter, ""),
        "advice": _outward_advice(known.advice, names),
    }


def _outward_advice(advice: Advice, names: Mapping[str, str]) -> Advice:
    """Return the `advice` of the base for values by the names of the variant."""
    if advice is None:
        return None

    def outward(values: Mapping[str, Any]) -> str:
        inward = {name: values[new] for name, new in names.items() if new in values}
        return _renamed(advice({**values, **inward}), names)

    return outward


def _renamed(text: str, names: Mapping[str, str]) -> str:
    """Replace the names of the base in a message by those of the variant."""
    return re.sub("|".join(rf"\b{name}\b" for name in names), lambda found: names[found[0]], text)


class _Variant(Stage):
    """Translates parameter names between callers and the stage of the base, which uses its own names."""

    NAMES: ClassVar[Mapping[str, str]]  # of parameters and derived values, by the names within the stage

    def __init__(self, input_format: SignalFormat | float, **parameters: Any) -> None:
        inward = self._inward(parameters)
        with self._translating():
            super().__init__(input_format, **inward)

    @classmethod
    def _inward(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        inner = {new: name for name, new in cls.NAMES.items()}
        unknown = [name for name in values if name not in inner]
        if unknown:
            raise ValueError(f"{unknown[0]}: {cls.REPRESENTATION.kind} has no such parameter")
        return {inner[name]: value for name, value in values.items()}

    @classmethod
    def _is_inner(cls, values: Mapping[str, Any]) -> bool:
        """Return whether the names are those within the stage, because its own code is the caller."""
        return not set(values) <= set(cls.NAMES.values())

    @classmethod
    def _outward(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        return {cls.NAMES.get(name, name): value for name, value in values.items()}

    @classmethod
    @contextmanager
    def _translating(cls) -> Iterator[None]:
        """Replace the names within the stage by those of the variant in errors."""
        try:
            yield
        except ValueError as problem:
            raise ValueError(_renamed(str(problem), cls.NAMES)).with_traceback(problem.__traceback__) from None

    def reconfigure(self, given: SignalFormat, changes: Collection[Mapping[str, Any]]) -> None:
        inward = [self._inward(change) for change in changes]
        with self._translating():
            super().reconfigure(given, inward)

    @property
    def parameters(self) -> dict[str, Any]:
        return self._outward(super().parameters)

    @property
    def derived(self) -> dict[str, Any]:
        return self._outward(super().derived)

    @classmethod
    def effective_values(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        if cls._is_inner(values):
            return super().effective_values(values)
        with cls._translating():
            return cls._outward(super().effective_values(cls._inward(values)))

    @classmethod
    def resolve_rate_defaults(
        cls, values: Mapping[str, Any], given: Collection[str], sample_rate: float
    ) -> dict[str, Any]:
        if cls._is_inner(values):
            return super().resolve_rate_defaults(values, given, sample_rate)
        with cls._translating():
            names = cls._inward(dict.fromkeys(given))
            return cls._outward(super().resolve_rate_defaults(cls._inward(values), names, sample_rate))

    @classmethod
    def request_values(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        own = {name: value for name, value in values.items() if name in cls.NAMES.values()}
        others = {name: value for name, value in values.items() if name not in own}
        with cls._translating():
            return {**others, **cls._outward(super().request_values(cls._inward(own)))}
