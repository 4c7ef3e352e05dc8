"""Rounding of durations to whole numbers of samples."""

from __future__ import annotations

import math

MAX_SAMPLES = 2**31 - 1  # of a window, hop or lag; more would not fit into memory


def round_half_away(value: float) -> int:
    """Round `value` >= 0 as ``round`` of C and MATLAB does: 220.5 to 221 (``round`` of Python returns 220)."""
    below = math.floor(value)
    return below + (value - below >= 0.5)


def check_length(name: str, samples: float) -> float:
    """Return `samples`, or raise ValueError with `name` if they are too many."""
    if samples > MAX_SAMPLES:
        raise ValueError(f"{name}: expected at most {MAX_SAMPLES} samples, got {samples:.6g}")
    return samples


def sample_count(name: str, samples: float) -> int:
    """Round `samples` half away from zero. Raise ValueError with `name` if the result is below 1 or too large."""
    count = round_half_away(check_length(name, samples))
    if count < 1:
        raise ValueError(f"{name}: expected at least one sample at this sample rate, got {samples:.6g}")
    return count
