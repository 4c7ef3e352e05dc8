"""Limits that keep all numbers finite and fast: huge samples are clamped, tiny samples and filter states become 0."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rosafe.declarations.text import short_repr

FloatArray = NDArray[np.float64]

EPSILON = 2.2204e-16  # machine epsilon, with the digits of the original's source

# Larger samples are clamped to this. Even the product of two energies of squared windows stays finite:
# (2**31 * 1e70**2)**2 = 5e298. Sound has amplitudes around 1 (100 dB SPL), far below.
LIMIT = 1e70

# Samples below this become 0, and filter states at intervals. The square of the smallest audible amplitude is about
# 1e-20; the smallest normal double is 2e-308, and arithmetic below it is many times slower.
TINY = 1e-200
SQUARE_TINY = 1e-145  # the same for samples that are squared and weighted

FLUSH_INTERVAL = 4096  # samples between two checks of a filter's state, which may become denormal in a long block


def as_numbers(name: str, values: Any) -> FloatArray:
    """Return an array_like of real numbers as float64; ValueError, which begins with `name`, for other values."""
    try:
        array = np.asarray(values)
    except ValueError:  # rows of different lengths
        array = np.empty(0, object)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{name}: expected real numbers, got {short_repr(values)}")
    with np.errstate(over="ignore"):  # a long double beyond the range of double becomes infinite
        return array.astype(np.float64, copy=False)


def clamp(block: FloatArray, tiny: float = TINY) -> FloatArray:
    """Clamp samples to ±LIMIT, and to 0 below `tiny`. Return `block` itself if no sample changes."""
    size = np.abs(block)
    below = size < tiny
    if size.max(initial=0.0) <= LIMIT and not (below & (block != 0)).any():
        return block
    result = np.clip(block, -LIMIT, LIMIT)
    result[below] = 0.0
    return result


def modulus(values: NDArray[np.complex128]) -> FloatArray:
    """Return the absolute values of complex numbers: those of np.abs are rounded differently by versions of numpy."""
    return np.hypot(values.real, values.imag)


def flush_denormals(state: NDArray[Any]) -> None:
    """Set numbers below TINY in a contiguous real or complex `state` to 0, in place."""
    parts = state.view(np.float64)
    parts[np.abs(parts) < TINY] = 0.0
