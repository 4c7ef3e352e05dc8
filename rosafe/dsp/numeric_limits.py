"""What keeps every number finite and fast: a bound on huge samples, and 0 for tiny samples and filter states."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# Samples beyond this are taken as this. Even the product of two energies of squared windows stays finite:
# (2**31 * 1e70**2)**2 = 5e298. Sound has amplitudes around 1 (100 dB SPL), so nothing real comes near.
LIMIT = 1e70

# Samples that are smaller than this become 0, and filter states now and then. The square of the smallest
# audible amplitude is some 1e-20; the smallest normal double is 2e-308, and arithmetic below it is many times slower.
TINY = 1e-200
SQUARE_TINY = 1e-145  # the same where samples are squared and weighted

FLUSH_INTERVAL = (
    4096  # samples that a filter goes on by before its state is looked at: it may become tiny in a long block
)


def clamp(block: FloatArray, tiny: float = TINY) -> FloatArray:
    """`block` with samples bounded to ±LIMIT, and 0 for those below `tiny`; `block` itself where none is like that."""
    size = np.abs(block)
    below = size < tiny
    if size.max(initial=0.0) <= LIMIT and not (below & (block != 0)).any():
        return block
    result = np.clip(block, -LIMIT, LIMIT)
    result[below] = 0.0
    return result


def flush_denormals(state: NDArray[Any]) -> None:
    """Set to 0, in place, what is smaller than TINY in a contiguous real or complex `state`."""
    parts = state.view(np.float64)
    parts[np.abs(parts) < TINY] = 0.0
