"""The difference between two clocks, although a thread may wait between the readings of both."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

NEAR_SECONDS = 5e-5  # between two readings, most of which are much nearer
MAX_READINGS = 10


def clock_difference(clock: Callable[[], float], reference: Callable[[], float]) -> float:
    """Return by how much a clock is ahead of another.

    Between two readings a thread may wait some milliseconds, for the interpreter or a processor. The clock is therefore
    read between two readings of the other, again until these are near each other.

    Parameters
    ----------
    clock, reference : callable
        Return the time of a clock (s).

    Returns
    -------
    float
        In s, that of the nearest readings.
    """
    least, difference = math.inf, 0.0
    for _ in range(MAX_READINGS):
        before, there, after = reference(), clock(), reference()
        if abs(after - before) < least:
            least, difference = abs(after - before), there - (before + after) / 2
        if least < NEAR_SECONDS:
            break
    return difference


def wall_difference() -> float:
    """Return by how much the system's clock, time.time, is ahead of time.monotonic (s)."""
    return clock_difference(time.time, time.monotonic)
