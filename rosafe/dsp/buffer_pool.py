"""A pool of buffers for very large blocks; a buffer returns to the pool when its last reference is dropped.

The C library returns memory above 32 MiB to the system immediately, and the system clears each page when it is
allocated again: that takes as long as the filters themselves.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from typing import Any

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.system import malloc_tuning

MIN_BYTES, MAX_BYTES = 2**24, 2**28  # of a buffer in the pool
MAX_IDLE_PER_SIZE = 2  # idle buffers of each size
MAX_SIZES = 2  # sizes with idle buffers

_idle: dict[int, deque[FloatArray]] = {}


def empty(shape: tuple[int, ...]) -> FloatArray:
    """Return an uninitialised float64 array, as `numpy.empty`."""
    count = math.prod(shape)
    if not MIN_BYTES <= 8 * count <= MAX_BYTES:
        return np.empty(shape)
    try:
        memory = _idle[count].pop()
    except (KeyError, IndexError):
        memory = np.empty(count)
    return np.asarray(_PooledArray(memory, shape))


def trim() -> None:
    """Return the idle buffers, and the free memory of the C library, to the system."""
    _idle.clear()
    malloc_tuning.trim()


class _PooledArray:
    """The memory of one array and its views: numpy drops this object together with the last of them."""

    _memory: FloatArray | None = None

    def __init__(self, memory: FloatArray, shape: tuple[int, ...]) -> None:
        self.__array_interface__: dict[str, Any] = {**memory.__array_interface__, "shape": shape}
        self._memory = memory

    def __del__(self) -> None:  # on any thread, at any time: atomic steps, which need no lock
        if self._memory is None:  # __init__ has failed for lack of memory
            return
        with contextlib.suppress(MemoryError):  # the buffer is freed then
            _idle.setdefault(len(self._memory), deque(maxlen=MAX_IDLE_PER_SIZE)).append(self._memory)
            for size in list(_idle)[:-MAX_SIZES]:
                _idle.pop(size, None)
