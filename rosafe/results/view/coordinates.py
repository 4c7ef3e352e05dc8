"""Coordinates of the axes of a result, derived from its declaration: times, frequencies, lags, names of features."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rosafe.interface import KINDS, Representation

EARS = ("left", "right")
MAX_COORDINATE = 1e12  # seconds or hertz along an axis


def check_result(result: Any) -> None:
    """Raise ValueError if `result` is not a mapping, for example a file name."""
    if not isinstance(result, Mapping):
        kind = type(result).__name__
        raise ValueError(f"result: expected a result of rosafe.process, or of rosafe.load for a file, got {kind}")


def frame_times(
    result: Mapping[str, Any], kind: Representation, count: int, sample_rate: float | None = None
) -> np.ndarray:
    """Return the centre of each of `count` frames of a kind (s). Raise ValueError if the sample rate is not known."""
    name = kind.kind
    if f"{name}_time" in result:
        return _checked(f"{name}_time", result[f"{name}_time"])[:count]
    if f"{name}_frameRate" in result:  # exact for windows of two hops, the default
        return np.asarray((1 + np.arange(count)) / float(result[f"{name}_frameRate"]))
    return np.asarray(np.arange(count) / _rate(result, name, sample_rate))


def _rate(result: Mapping[str, Any], name: str, sample_rate: float | None) -> float:
    if rate := sample_rate or result.get("sample_rate"):
        return float(rate)
    for lags in (name for known in KINDS.values() for name in known.coordinates if known.units[name] == "s"):
        if np.size(result.get(lags, ())) > 1:
            return 1 / float(np.diff(result[lags][:2])[0])
    raise ValueError(f"{name}: the sample rate of the result is not known; pass it as sample_rate (Hz)")


def axis_coordinates(result: Mapping[str, Any], kind: Representation, axis: str, size: int) -> np.ndarray:
    """Return the frequencies (Hz), lags (s) or names along an axis of a kind; indices if they are not known."""
    if axis == "feature" and len(kind.features) == size:
        return np.asarray(kind.features)
    while kind.parent and any(axis in part.axes for part in KINDS[kind.parent].parts):
        kind = KINDS[kind.parent]  # the representation that introduces the axis
    unit = {"channel": "Hz", "filter": "Hz", "lag": "s", "feature": ""}[axis]
    for name in kind.coordinates:
        values = result.get(name, ())
        if kind.units[name] == unit and len(values) == size:
            return _checked(name, values) if unit else np.asarray(values)
    return np.arange(size)


def _checked(name: str, values: Any) -> np.ndarray:
    """Return the coordinates of an axis; raise ValueError if they are not finite or too large."""
    coordinates = np.asarray(values, np.float64)
    if coordinates.size and not np.abs(coordinates).max() < MAX_COORDINATE:
        raise ValueError(f"{name}: expected numbers between -{MAX_COORDINATE:g} and {MAX_COORDINATE:g}")
    return coordinates
