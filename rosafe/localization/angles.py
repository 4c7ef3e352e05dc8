"""Azimuths in degrees: counter-clockwise from straight ahead (left is positive), in (-180, 180]."""

from __future__ import annotations

from typing import Any

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray

SPACING = 5.0  # degrees between the directions of a model
MAX_DEGREES = 1e6  # of an azimuth that a user gives: larger ones lose precision
MAX_TIME = 1e10  # s, of an azimuth over time: a double has microseconds up to there
LIMITS = f"from {-MAX_DEGREES:.0f} to {MAX_DEGREES:.0f} degrees"


def wrap(azimuths: Any) -> Any:
    """Return `azimuths` (degrees), a float or an array, in (-180, 180]."""
    if not isinstance(azimuths, float):  # numpy takes ten times as long for a number
        azimuths = np.asarray(azimuths, np.float64)
    return 180.0 - (180.0 - azimuths) % 360.0


def grid() -> FloatArray:
    """Return the azimuths (A,) of a direction model: -175 to 180 degrees."""
    return np.arange(-180.0 + SPACING, 180.0 + SPACING / 2, SPACING)


def difference(first: Any, second: Any) -> Any:
    """Return `first` - `second` in (-180, 180], floats or arrays."""
    if not (isinstance(first, float) and isinstance(second, float)):
        first, second = np.asarray(first, np.float64), np.asarray(second, np.float64)
    return wrap(first - second)


def lateral(azimuths: Any) -> FloatArray:
    """Return the lateral angles (-90 to 90 degrees): azimuths behind the head are mirrored to the front."""
    wrapped = wrap(azimuths)
    return np.where(np.abs(wrapped) > 90.0, np.sign(wrapped) * 180.0 - wrapped, wrapped)


def in_front(azimuths: Any) -> Any:
    """Return whether azimuths are at most 90 degrees from straight ahead."""
    return np.abs(wrap(azimuths)) <= 90.0


def unwrap(azimuths: FloatArray) -> FloatArray:
    """Return azimuths (degrees) without jumps: each differs from the one before by the shorter way round."""
    steps = difference(azimuths[1:], azimuths[:-1])
    return np.concatenate((azimuths[:1], azimuths[0] + np.cumsum(steps)))


def in_limits(azimuths: Any) -> bool:
    """Return whether all azimuths (degrees) are finite and at most `MAX_DEGREES`."""
    return bool((np.abs(azimuths) <= MAX_DEGREES).all())
