"""Presets of parameters, warnings about valid but unsuitable settings, and advice on misplaced arguments."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from rosafe.interface import KINDS
from rosafe.interface.arguments import is_parameter

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
MIN_PERIODS = 3.0  # of the lowest pitch in the window of the autocorrelation


def warnings_of(values: Mapping[str, Any], outputs: Collection[str]) -> list[str]:
    """Return warnings, each one line, about parameters for these outputs; the defaults complete `values`."""
    if "pitch" not in outputs:
        return []
    text = short_window(
        values.get("pi_rangeHz", KINDS["pitch"].parameter("pi_rangeHz").default),
        values.get("ac_wSizeSec", KINDS["autocorrelation"].parameter("ac_wSizeSec").default),
    )
    return [text] if text else []


def short_window(range_hz: Collection[float], seconds: float) -> str:
    """Return a warning if the window of the autocorrelation is too short for the pitch range; otherwise ''."""
    lowest = min(range_hz)
    if lowest * seconds >= MIN_PERIODS - 1e-9:
        return ""
    return (
        f"pi_rangeHz, ac_wSizeSec: a window of {seconds:g} s contains fewer than {MIN_PERIODS:g} periods of "
        f"{lowest:g} Hz, the lowest pitch of the range; pitches below {MIN_PERIODS / seconds:.0f} Hz are unreliable "
        'and may be reported as higher ones; for voices use rosafe.PRESETS["speech"] (--preset speech)'
    )


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
