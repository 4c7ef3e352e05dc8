"""Levels of both ears: peak and RMS in dB relative to full scale, and the number of clipped samples."""

from __future__ import annotations

import math

import numpy as np

CLIPPED = 32767 << 16  # magnitude from which a sample counts as clipped: the maximum of 16 bits
SILENCE = -math.inf  # dBFS
EARS = ("L", "R")


def decibels(amplitude: float) -> float:
    """Return `amplitude` relative to full scale, 2^31, in dBFS; minus infinity for silence."""
    return 20 * math.log10(amplitude / 2.0**31) if amplitude > 0 else SILENCE


def reference(spl: float, rms: float) -> float:
    """Return `pp_refSPLdB` for a microphone with which sound of `spl` (dB SPL) has the level `rms` (dBFS).

    Level scaling multiplies by 10**((100 - pp_refSPLdB) / 20); after it, an RMS of 1 represents 100 dB SPL.
    """
    return 200.0 - spl + rms


class LevelMeter:
    """Levels of the added samples. A full-scale square wave has an RMS of 0 dBFS; a full-scale sine has -3 dBFS."""

    def __init__(self) -> None:
        self.frames = 0
        self.clipped = [0, 0]  # samples per ear
        self._peaks = [0, 0]
        self._energies = [0.0, 0.0]

    def add(self, samples: np.ndarray) -> None:
        """Add samples, int32 (2, n)."""
        if not samples.shape[1]:
            return
        self.frames += samples.shape[1]
        for ear, channel in enumerate(samples):
            low, high = int(channel.min()), int(channel.max())
            self._peaks[ear] = max(self._peaks[ear], high, -low)
            self._energies[ear] += float(np.square(channel, dtype=np.float64).sum())
            if max(high, -low) >= CLIPPED:
                self.clipped[ear] += int(np.count_nonzero((channel >= CLIPPED) | (channel <= -CLIPPED)))

    def peak(self, ear: int) -> float:
        """Return the maximum magnitude, dBFS."""
        return decibels(self._peaks[ear])

    def rms(self, ear: int) -> float:
        """Return the root mean square, dBFS."""
        return decibels(math.sqrt(self._energies[ear] / self.frames)) if self.frames else SILENCE
