"""Azimuths in degrees: counter-clockwise from straight ahead (left is positive), in (-180, 180]."""

from __future__ import annotations

from typing import Any

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray

SPACING = 5.0  # degrees between the directions of a model


def wrap(azimuths: Any) -> FloatArray:
    """Return `azimuths` (degrees) in (-180, 180]."""
    return np.asarray(180.0 - np.mod(180.0 - np.asarray(azimuths, np.float64), 360.0))


def grid() -> FloatArray:
    """Return the azimuths (A,) of a direction model: -175 to 180 degrees."""
    return np.arange(-180.0 + SPACING, 180.0 + SPACING / 2, SPACING)


def difference(first: Any, second: Any) -> FloatArray:
    """Return `first` - `second` in (-180, 180]."""
    return wrap(np.asarray(first, np.float64) - np.asarray(second, np.float64))


def lateral(azimuths: Any) -> FloatArray:
    """Return the lateral angles (-90 to 90 degrees): azimuths behind the head are mirrored to the front."""
    wrapped = wrap(azimuths)
    return np.where(np.abs(wrapped) > 90.0, np.sign(wrapped) * 180.0 - wrapped, wrapped)


def unwrap(azimuths: FloatArray) -> FloatArray:
    """Return azimuths (degrees) without jumps: each differs from the one before by the shorter way round."""
    steps = difference(azimuths[1:], azimuths[:-1])
    return np.concatenate((azimuths[:1], azimuths[0] + np.cumsum(steps)))
