"""The ERB-rate scale: which frequencies are equally far apart for the ear.

B. R. Glasberg and B. C. J. Moore (1990), "Derivation of auditory filter shapes from notched-noise data", Hear. Res. 47,
103-138; in the rounding of the Two!Ears front-end: 9.265 and 0.108 for what is 1 / 0.10793.
"""

from __future__ import annotations

from typing import Any

import numpy as np

EAR_Q = 9.265  # asymptotic filter quality at high frequencies
MIN_BANDWIDTH = 24.7  # Hz, bandwidth at low frequencies


def erb_rate(frequency: Any) -> Any:
    """Number of equivalent rectangular bandwidths below `frequency` (Hz): 9.265 ln(1 + f / (24.7 * 9.265))."""
    return EAR_Q * np.log1p(np.asarray(frequency) / (MIN_BANDWIDTH * EAR_Q))


def erb_rate_to_frequency(rate: Any) -> Any:
    """Frequency (Hz) at an ERB rate, the inverse of `erb_rate`."""
    return MIN_BANDWIDTH * EAR_Q * np.expm1(np.asarray(rate) / EAR_Q)


def bandwidth(frequency: Any) -> Any:
    """Equivalent rectangular bandwidth (Hz) of the auditory filter at `frequency` (Hz): 24.7 + 0.108 f."""
    return MIN_BANDWIDTH + 0.108 * np.asarray(frequency)
