"""Analysis windows, symmetric, by the names of the original."""

from __future__ import annotations

import numpy as np
from scipy.signal import windows

from .guard import FloatArray

NAMES = ("hamming", "hanning", "hann", "blackman", "triang", "sqrt_win")


def window(name: str, length: int) -> FloatArray:
    """The symmetric window `name` of `length` samples.

    `hann` ends in zeros; `hanning` is MATLAB's, whose zeros lie one sample outside; `sqrt_win` is the square root of
    `triang`. ValueError for other names.
    """
    if name == "hanning":
        return windows.hann(length + 2, sym=True)[1:-1]
    if name == "sqrt_win":
        return np.sqrt(windows.triang(length, sym=True))
    if name in NAMES:
        return windows.get_window(name, length, fftbins=False)
    raise ValueError(f"window: {name!r} is not one of {', '.join(NAMES)}")
