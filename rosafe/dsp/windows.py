"""Analysis windows, symmetric, by the names of the original.

F. J. Harris (1978), "On the use of windows for harmonic analysis with the discrete Fourier transform", Proc. IEEE 66,
51-83; several exact forms exist; these are MATLAB's.
"""

from __future__ import annotations

import numpy as np
import scipy

from .numeric_limits import FloatArray

NAMES = ("hamming", "hanning", "hann", "blackman", "triang", "sqrt_win")  # windows of the original's processors
ALL_NAMES = (*NAMES, "rectwin")


def window(name: str, length: int) -> FloatArray:
    """Return the symmetric window `name` of `length` samples.

    With N = `length` and i from 0 to N - 1:

    ======== ===================================================================================
    hann     (1 - cos(2 pi i / (N - 1))) / 2, 0 at both ends
    hanning  (1 - cos(2 pi (i + 1) / (N + 1))) / 2, with its zeros one sample outside
    hamming  0.54 - 0.46 cos(2 pi i / (N - 1))
    blackman 0.42 - 0.5 cos(2 pi i / (N - 1)) + 0.08 cos(4 pi i / (N - 1))
    triang   rising (2 i + 1) / N for even N, 2 (i + 1) / (N + 1) for odd N; falling likewise
    sqrt_win sqrt(triang)
    rectwin  1
    ======== ===================================================================================

    Raises ValueError for other names.
    """
    values: FloatArray
    if name == "hanning":
        values = scipy.signal.windows.hann(length + 2, sym=True)[1:-1]
    elif name == "sqrt_win":
        values = np.sqrt(scipy.signal.windows.triang(length, sym=True))
    elif name == "rectwin":
        values = np.ones(length)
    elif name in NAMES:
        values = scipy.signal.windows.get_window(name, length, fftbins=False)
    else:
        raise ValueError(f"window: expected one of {', '.join(ALL_NAMES)}, got {name!r}")
    return values
