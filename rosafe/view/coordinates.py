"""What lies along the axes of a result, from what its declaration says of them: seconds, hertz, words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rosafe.interface import KINDS, Representation

EARS = ("left", "right")
MAX_COORDINATE = 1e12  # seconds or hertz along an axis


def check_result(result: Any) -> None:
    """ValueError where it is no result at all, but such as the name of a file."""
    if not isinstance(result, Mapping):
        kind = type(result).__name__
        raise ValueError(f"result: {kind} is not what rosafe.process returns, or rosafe.load, which reads a file")


def frame_times(
    result: Mapping[str, Any], kind: Representation, count: int, sample_rate: float | None = None
) -> np.ndarray:
    """The middle of each of `count` frames of a kind (s); ValueError where the result does not tell its sample rate."""
    name = kind.kind
    if f"{name}_time" in result:
        return _checked(f"{name}_time", result[f"{name}_time"])[:count]
    if f"{name}_frameRate" in result:  # exact for windows of two hops, the default
        return np.asarray((1 + np.arange(count)) / float(result[f"{name}_frameRate"]))
    return np.asarray(np.arange(count) / _rate(result, name, sample_rate))


def _rate(result: Mapping[str, Any], name: str, sample_rate: float | None) -> float:
    if rate := sample_rate or result.get("sample_rate"):
        return float(rate)
    for lags in ("cc_lags", "ac_lags", "prec_lags"):
        if np.size(result.get(lags, ())) > 1:
            return 1 / float(np.diff(result[lags][:2])[0])
    raise ValueError(f"{name}: the result does not tell the sample rate; give it as sample_rate (Hz)")


def along(result: Mapping[str, Any], kind: Representation, axis: str, size: int) -> np.ndarray:
    """Frequencies (Hz), lags (s) or words along an axis of a kind; numbers from 0 where nothing is known."""
    if axis == "feature" and len(kind.features) == size:
        return np.asarray(kind.features)
    while kind.parent and any(axis in part.axes for part in KINDS[kind.parent].parts):
        kind = KINDS[kind.parent]  # the one that brought the axis in
    wanted = {"channel": "Hz", "filter": "Hz", "lag": "s", "feature": ""}[axis]
    units = {one.name: one.unit for one in kind.parameters} | {one.name: one.unit for one in kind.derived}
    for name in kind.coordinates:
        values = result.get(name, ())
        if units[name] == wanted and len(values) == size:
            return _checked(name, values) if wanted else np.asarray(values)
    return np.arange(size)


def _checked(name: str, values: Any) -> np.ndarray:
    """Values along an axis; ValueError where they cannot be drawn."""
    found = np.asarray(values, np.float64)
    if found.size and not np.abs(found).max() < MAX_COORDINATE:
        raise ValueError(f"{name}: expected numbers between -{MAX_COORDINATE:g} and {MAX_COORDINATE:g}")
    return found
