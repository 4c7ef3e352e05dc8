"""What keeps every number finite and fast: a bound on huge samples, and the flush of tiny filter states."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# Samples beyond this are taken as this. Even the product of two energies of squared windows stays finite:
# (2**31 * 1e70**2)**2 = 5e298. Sound has amplitudes around 1 (100 dB SPL), so nothing real comes near.
LIMIT = 1e70

# Filter states smaller than this become 0 at the end of a block. The square of the smallest audible amplitude is
# some 1e-20; the smallest normal double is 2e-308, and arithmetic below it is many times slower.
TINY = 1e-200


def limited(block: FloatArray) -> FloatArray:
    """`block` with samples bounded to ±LIMIT; `block` itself where it is within already."""
    if block.size == 0 or (block.max() <= LIMIT and block.min() >= -LIMIT):
        return block
    return np.clip(block, -LIMIT, LIMIT)


def flush(state: NDArray[Any]) -> None:
    """Set to 0, in place, what is smaller than TINY in a contiguous real or complex `state`."""
    parts = state.view(np.float64)
    parts[np.abs(parts) < TINY] = 0.0
