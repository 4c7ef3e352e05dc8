"""Memory for very large blocks, which is used again when nobody holds the block any more.

The C library gives what is larger than 32 MiB back to the system at once, which clears each page that it hands out
again: that takes as long as the filters themselves take.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from typing import Any

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray

SMALLEST, LARGEST = 2**24, 2**28  # bytes of the blocks that are kept
MAX_IDLE_PER_SIZE = 2  # idle ones of a size
SIZES = 2  # of which idle ones are kept

_idle: dict[int, deque[FloatArray]] = {}


def empty(shape: tuple[int, ...]) -> FloatArray:
    """As `numpy.empty`, of float64."""
    count = math.prod(shape)
    if not SMALLEST <= 8 * count <= LARGEST:
        return np.empty(shape)
    try:
        memory = _idle[count].pop()
    except (KeyError, IndexError):
        memory = np.empty(count)
    return np.asarray(_PooledArray(memory, shape))


class _PooledArray:
    """The memory of one array and its views: numpy lets go of this with the last one of them."""

    _memory: FloatArray | None = None

    def __init__(self, memory: FloatArray, shape: tuple[int, ...]) -> None:
        self.__array_interface__: dict[str, Any] = {**memory.__array_interface__, "shape": shape}
        self._memory = memory

    def __del__(self) -> None:  # on any thread and at any time: single steps, which need no lock
        if self._memory is None:  # there was no memory for the rest of this
            return
        with contextlib.suppress(MemoryError):  # then it is freed
            _idle.setdefault(len(self._memory), deque(maxlen=MAX_IDLE_PER_SIZE)).append(self._memory)
            for size in list(_idle)[:-SIZES]:
                _idle.pop(size, None)
