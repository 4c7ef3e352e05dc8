"""Memory for very large blocks, which is used again when nobody holds the block any more.

The C library gives what is larger than 32 MiB back to the system at once, which clears each page that it hands out
again: that takes as long as the filters themselves take.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np

from .guard import FloatArray

SMALLEST, LARGEST = 2**24, 2**28  # bytes of the blocks that are kept
KEPT = 2  # idle ones of a size
SIZES = 2  # of which idle ones are kept

_idle: dict[int, deque[FloatArray]] = {}


def empty(shape: tuple[int, ...]) -> FloatArray:
    """As `numpy.empty`, of float64."""
    size = 8 * math.prod(shape)
    return np.asarray(_Loan(shape)) if SMALLEST <= size <= LARGEST else np.empty(shape)


class _Loan:
    """The memory of one array and its views: numpy lets go of this with the last one of them."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        count = math.prod(shape)
        try:
            self._memory = _idle[count].pop()
        except (KeyError, IndexError):
            self._memory = np.empty(count)
        self.__array_interface__: dict[str, Any] = {**self._memory.__array_interface__, "shape": shape}

    def __del__(self) -> None:  # on any thread and at any time: single steps, which need no lock
        _idle.setdefault(len(self._memory), deque(maxlen=KEPT)).append(self._memory)
        for size in list(_idle)[:-SIZES]:
            _idle.pop(size, None)
