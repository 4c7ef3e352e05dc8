"""From seconds to whole numbers of samples."""

from __future__ import annotations

import math

MAX_SAMPLES = 2**31 - 1  # longest window, hop or lag: more cannot be meant, nor held in memory


def round_half_away(value: float) -> int:
    """`value` >= 0 rounded as C's and MATLAB's ``round`` do: 220.5 is 221 (Python's ``round`` says 220)."""
    below = math.floor(value)
    return below + (value - below >= 0.5)


def sample_count(name: str, samples: float) -> int:
    """`samples` rounded half away from zero; ValueError naming `name` if that is below 1 or absurdly many."""
    if samples > MAX_SAMPLES:
        raise ValueError(f"{name}: too long, {samples:.6g} samples")
    count = round_half_away(samples)
    if count < 1:
        raise ValueError(f"{name}: too short for this sample rate")
    return count
