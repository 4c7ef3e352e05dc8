"""Presets of parameters, warnings about valid but unsuitable settings, and advice on misplaced arguments."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from rosafe.declarations.text import short_repr
from rosafe.interface import KINDS
from rosafe.interface.arguments import is_parameter, needed

# Parameters for a purpose, by name. docs/parameters.md describes how they were measured.
PRESETS: dict[str, dict[str, Any]] = {
    "speech": {
        "ac_wSizeSec": 0.07,
        "ac_K": 1.0,
        "pi_rangeHz": [75.0, 420.0],
        "pi_confThres": 0.15,
        "pi_medianOrder": 7,
        "pi_peakRatio": 0.9,
    },
    "onsets": {"trm_minStrengthdB": 8.0, "trm_minSpread": 6, "trm_minValuedB": -80.0},
}
MIN_PLAUSIBLE_RATE = 400.0  # Hz; below it, errors suggest that the sample rate is given in kHz


def warnings_of(values: Mapping[str, Any], outputs: Collection[str]) -> list[str]:
    """Return warnings, each one line, about parameters for these outputs; the defaults complete `values`."""
    kinds = needed(outputs)
    defaults = {p.name: p.default for kind in kinds for p in KINDS[kind].parameters}
    return list(filter(None, (advice(kind, {**defaults, **values}) for kind in kinds)))


def advice(kind: str, values: Mapping[str, Any]) -> str:
    """Return the warning that a kind declares about its parameters and those of its ancestors; empty for none."""
    try:
        return " ".join(str(declared(values)).split()) if (declared := KINDS[kind].advice) else ""
    except Exception as problem:  # of a plugin
        return f"{kind}: advice: {type(problem).__name__}: {short_repr(str(problem))}"


def no_frames(kinds: Collection[str], empty: bool, option: str) -> str:
    """Return the warning about outputs without frames, for a sound that is `empty` or too short without `option`."""
    reason = "has no samples" if empty else f"is shorter than the windows that they need; see {option}"
    return f"{', '.join(kinds)}: no frames: the sound {reason}"


def rate_advice(problem: ValueError, sample_rate: float) -> ValueError:
    """Return `problem`, or an error about the sample rate if that is probably given in kHz."""
    if sample_rate >= MIN_PLAUSIBLE_RATE or str(problem).startswith("sample_rate"):
        return problem
    return ValueError(
        f"sample_rate: expected Hz, got {sample_rate:g}; did you mean {1000 * sample_rate:g}? "
        f"At {sample_rate:g} Hz: {problem}"
    )


def unknown_argument(name: str, function: str = "process") -> TypeError:
    """Return the error for an unknown keyword argument; parameters belong to `parameters`."""
    advice = f"; pass parameters as parameters={{{name!r}: ...}}" if is_parameter(name) else ""
    return TypeError(f"{function}() got an unexpected keyword argument {name!r}{advice}")
