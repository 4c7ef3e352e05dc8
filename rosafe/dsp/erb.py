"""The ERB-rate scale, on which equal distances correspond to equal distances along the basilar membrane.

B. R. Glasberg and B. C. J. Moore (1990), "Derivation of auditory filter shapes from notched-noise data", Hear. Res. 47,
103-138; with the rounding of the Two!Ears front-end: 9.265 for 1 / 0.10793, and 0.108.
"""

from __future__ import annotations

from typing import Any

import numpy as np

EAR_Q = 9.265  # asymptotic filter quality at high frequencies
MIN_BANDWIDTH = 24.7  # Hz, bandwidth at low frequencies
BANDWIDTH_SLOPE = 0.108  # Hz per Hz


def erb_rate(frequency: Any) -> Any:
    """Return the ERB rate, 9.265 ln(1 + f / (24.7 * 9.265)): the number of bandwidths below `frequency` (Hz)."""
    return EAR_Q * np.log1p(np.asarray(frequency) / (MIN_BANDWIDTH * EAR_Q))


def erb_rate_to_frequency(rate: Any) -> Any:
    """Return the frequency (Hz) at an ERB rate; the inverse of `erb_rate`."""
    return MIN_BANDWIDTH * EAR_Q * np.expm1(np.asarray(rate) / EAR_Q)


def bandwidth(frequency: Any) -> Any:
    """Return the equivalent rectangular bandwidth (Hz) of the auditory filter at `frequency` (Hz): 24.7 + 0.108 f."""
    return MIN_BANDWIDTH + BANDWIDTH_SLOPE * np.asarray(frequency)
