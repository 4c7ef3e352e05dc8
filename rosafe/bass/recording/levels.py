"""How loud it is: peak and RMS of both ears in dB below full scale, and where the converter was at its end."""

from __future__ import annotations

import math

import numpy as np

CLIPPED = 32767 << 16  # from here up a sample counts as clipped: the end of 16 bits, and of everything wider
SILENCE = -math.inf  # dBFS
EARS = ("L", "R")


def decibels(amplitude: float) -> float:
    """`amplitude` relative to full scale, 2^31, in dBFS; silence is minus infinity."""
    return 20 * math.log10(amplitude / 2.0**31) if amplitude > 0 else SILENCE


def reference(spl: float, rms: float) -> float:
    """`pp_refSPLdB` for a microphone at which sound of `spl` (dB SPL) has the level `rms` (dBFS).

    Level scaling multiplies by 10**((100 - pp_refSPLdB) / 20), and then an RMS of 1 is to stand for 100 dB SPL.
    """
    return 200.0 - spl + rms


class LevelMeter:
    """Levels of the samples that were added. An RMS of 0 dBFS is a full square wave; a full sine has -3 dBFS."""

    def __init__(self) -> None:
        self.frames = 0
        self.clipped = [0, 0]  # samples per ear
        self._peaks = [0, 0]
        self._energies = [0.0, 0.0]

    def add(self, samples: np.ndarray) -> None:
        """Take int32 (2, n) in."""
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
        """The highest sample, dBFS."""
        return decibels(self._peaks[ear])

    def rms(self, ear: int) -> float:
        """The root of the mean square, dBFS."""
        return decibels(math.sqrt(self._energies[ear] / self.frames)) if self.frames else SILENCE
