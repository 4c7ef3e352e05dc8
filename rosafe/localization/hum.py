"""Mains hum, which cheap microphones have equally in both channels: sounds from which a model learns its cues.

The high-pass of `cues.PARAMETERS` removes a constant offset and attenuates the mains frequency. The cues of the
harmonics that are left are counted, so that they are evidence for no direction.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray

_FREQUENCIES = (50.0, 60.0)  # Hz
_HARMONICS = 12
_DEVIATION = 0.005  # relative, of the mains frequency
_DECAY_DB = 30.0  # by which harmonics are below the fundamental, at most
_NOISE_DB = (-90.0, -70.0, -60.0, -50.0, -40.0, -30.0, -20.0)  # of independent noise of the microphones below the hum
_SECONDS, _PATTERNS = 0.6, 2  # of each sound; for each frequency and noise


def hum_sounds(sample_rate: float) -> Iterator[FloatArray]:
    """Yield sounds (2, n) of hum with a power of 1, with random levels and phases of the harmonics."""
    random = np.random.default_rng(2)
    times = np.arange(round(_SECONDS * sample_rate)) / sample_rate
    for mains in _FREQUENCIES * _PATTERNS:
        for noise_db in _NOISE_DB:
            frequencies = mains * (1 + random.uniform(-_DEVIATION, _DEVIATION)) * np.arange(1, _HARMONICS + 1)
            gains = 10 ** (-random.uniform(0.0, _DECAY_DB, _HARMONICS) / 20)
            phases = random.uniform(0.0, 2 * np.pi, _HARMONICS)
            waves = np.sin(2 * np.pi * frequencies[:, np.newaxis] * times + phases[:, np.newaxis])
            hum = np.einsum("h,hn->n", gains, waves)  # see `Mixture.part_of`
            noise = 10 ** (noise_db / 20) * random.standard_normal((2, len(times)))
            yield hum * np.sqrt(2.0 / np.sum(gains**2)) + noise
