"""The gammatone filterbank: per channel a cascade of equal complex one-pole filters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .cascade import Cascade
from .erb import bandwidth
from .guard import FloatArray


class GammatoneBank:
    """All-pole gammatone filters (Hohmann 2002) of unit gain at their centre frequencies, without delay compensation.

    With beta = 2 pi b ERB(f) / fs, theta = 2 pi f / fs, p = exp(-beta - j theta) and g = 1 - exp(-beta), a channel is
    y = 2 Re(H x), H(z) = (g / (1 - p / z))**n. One-pole sections keep 1e-13 of accuracy where the expanded polynomial
    of the original loses up to 5e-7 in the lowest channels.

    Parameters
    ----------
    sample_rate : float
        In Hz.
    frequencies : ndarray (C,)
        Centre frequencies (Hz).
    order : int
        Number n of poles (`fb_nGamma`).
    width : float
        Bandwidth b in ERBs (`fb_bwERBs`).
    """

    def __init__(self, sample_rate: float, frequencies: FloatArray, order: int, width: float) -> None:
        decays = 2 * np.pi * width * bandwidth(frequencies) / sample_rate
        poles = np.exp(-decays - 2j * np.pi * frequencies / sample_rate)
        self.channels = [
            Cascade(_sections(pole, -np.expm1(-decay), order)) for pole, decay in zip(poles, decays, strict=True)
        ]

    def reset(self) -> None:
        """All filters back to rest."""
        for channel in self.channels:
            channel.reset()

    def process(self, block: FloatArray, with_envelope: bool) -> tuple[FloatArray, FloatArray | None]:
        """Filter (2, N): output (2, C, N), and the envelope 2 abs(H x) of the same shape if wanted, else None."""
        shape = (2, len(self.channels), block.shape[-1])
        output = np.empty(shape)
        envelope = np.empty(shape) if with_envelope else None
        for index, channel in enumerate(self.channels):
            analytic = channel.process(block)
            output[:, index] = analytic.real
            if envelope is not None:
                np.abs(analytic, out=envelope[:, index])
        return output, envelope


def _sections(pole: complex, gain: float, order: int) -> NDArray[np.complex128]:
    sections = np.tile(np.array([gain, 0, 0, 1, -pole, 0], np.complex128), (order, 1))
    sections[0, 0] *= 2  # y = 2 Re(H x): a real signal has half of its amplitude at each of ±f
    return sections
