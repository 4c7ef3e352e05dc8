"""Sound that arrives block by block, at another sample rate: a polyphase filter with the same output for all blocks.

The kernel is a sinc with a Kaiser window (J. O. Smith, "Digital Audio Resampling", ccrma.stanford.edu/~jos/resample).
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.sparse
import scipy.special

from rosafe.dsp.copies import OwnState
from rosafe.dsp.numeric_limits import FloatArray

_HALF = 32  # samples of the lower rate on each side of the kernel
_CUTOFF = 0.475  # of the lower rate: -6 dB
_BETA = 7.0  # of the Kaiser window: 70 dB in the stop band


class Resampler(OwnState):
    """Two ears at another sample rate, in units of a constant number of samples.

    Parameters
    ----------
    from_rate, to_rate : float
        Hz.
    unit : int
        Samples of the output that are computed together.
    """

    def __init__(self, from_rate: float, to_rate: int, unit: int) -> None:
        self._step = Fraction(from_rate).limit_denominator(1000) / to_rate  # input samples for an output sample
        self._unit = unit
        self._half = 0 if self._step == 1 else math.ceil(_HALF * max(1.0, float(self._step)))
        self.reset()

    def reset(self) -> None:
        """Return to the state before the first block."""
        self._kept = np.zeros((2, self._half))  # the input from `_first` on
        self._first = -self._half
        self._count = 0  # samples of the output

    def process(self, block: FloatArray) -> list[FloatArray]:
        """Return the units (2, `unit`) that are complete with the next block (2, n); it is aligned with the input."""
        self._kept = np.concatenate((self._kept, block), axis=1)
        units: list[FloatArray] = []
        while True:
            position = self._count * self._step
            begin = math.floor(position)
            weights = _weights(position - begin, self._step, self._unit, self._half)
            kept = self._kept[:, begin - self._half - self._first :]
            if kept.shape[1] < weights.shape[1]:
                return units
            self._kept, self._first = kept, begin - self._half
            units.append(np.ascontiguousarray((weights @ kept[:, : weights.shape[1]].T).T))
            self._count += self._unit


@lru_cache(maxsize=64)
def _weights(phase: Fraction, step: Fraction, unit: int, half: int) -> Any:
    """Return the sparse matrix (unit, n) from input samples to the output samples of a unit.

    `phase` is the position of the first output sample after the input sample with the index `half`.
    """
    positions = [phase + number * step for number in range(unit)]
    whole = np.array([math.floor(position) for position in positions])
    parts = np.array([float(position - math.floor(position)) for position in positions])
    taps = np.arange(-half, half + 1)
    distance = taps - parts[:, np.newaxis]
    band = 2 * _CUTOFF / max(1.0, float(step))  # both edges, in cycles per input sample
    window = scipy.special.i0(_BETA * np.sqrt(np.maximum(0.0, 1 - (distance / max(1, half)) ** 2)))
    values = band * np.sinc(band * distance) * window / scipy.special.i0(_BETA) if half else np.ones((unit, 1))
    rows = np.arange(unit + 1) * len(taps)
    columns = whole[:, np.newaxis] + half + taps
    return scipy.sparse.csr_matrix((values.ravel(), columns.ravel(), rows))
