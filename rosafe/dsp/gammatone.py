"""The gammatone filterbank: in each channel a cascade of equal complex one-pole filters.

R. D. Patterson, I. Nimmo-Smith, J. Holdsworth and P. Rice (1987), "An efficient auditory filterbank based on the
gammatone function", APU report 2341; V. Hohmann (2002), "Frequency analysis and synthesis using a gammatone
filterbank", Acta Acust. united Acust. 88, 433-442, whose digital filter this is.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from . import buffer_pool, kernels
from .erb import bandwidth
from .numeric_limits import FLUSH_INTERVAL, FloatArray, clamp, flush_denormals, modulus

POLES_PER_SECTION = 4
TURN_SPAN = 64  # samples; SPAN of kernels/gammatone.c, whose `position` must be below it


class GammatoneBank:
    """All-pole gammatone filters of unit gain at their centre frequencies, without delay compensation.

    With beta = 2 pi b ERB(f) / fs, theta = 2 pi f / fs, p = exp(-beta - j theta) and g = 1 - exp(-beta), a channel is
    y = 2 Re(H x), H(z) = (g / (1 - p / z))**n; ERB as in `erb.bandwidth`. Its impulse response is
    h[k] = 2 g**n binomial(k + n - 1, n - 1) exp(-beta k) cos(theta k), a sampled gammatone with this polynomial
    instead of k**(n - 1). One-pole sections keep 1e-13 of accuracy where the expanded polynomial
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
        self._sections = _sections(poles, -np.expm1(-decays), order)
        self.reset()

    def reset(self) -> None:
        """Reset the state of all filters."""
        self._state = np.zeros((0, *self._sections.shape[:2]), np.complex128)  # of each ear
        self._position = 0  # samples since the start of the span

    def process(self, block: FloatArray, with_envelope: bool, output: FloatArray) -> FloatArray | None:
        """Filter (ears, N) into `output` (ears, C, N) with evenly strided rows.

        A change of the number of ears resets the filters. Returns the envelope 2 abs(H x), or None.
        """
        if len(self._state) != len(block):
            self._state = np.zeros((len(block), *self._sections.shape[:2]), np.complex128)
            self._position = 0
        envelope = buffer_pool.empty(output.shape) if with_envelope else None
        run = kernels.gammatone if kernels.compiled() else filter_by_scipy
        run(block, self._sections, self._state, self._position, output, envelope)
        self._position = (self._position + block.shape[-1]) % TURN_SPAN
        return envelope


def _sections(poles: NDArray[np.complex128], gains: FloatArray, order: int) -> NDArray[np.complex128]:
    """Return a one-pole section (b0, 0, 0, 1, -p, 0) for each channel and pole, (C, order, 6).

    The gain of four poles is in the first of them, which saves time and avoids underflow in filters of many poles.
    """
    sections = np.zeros((len(poles), order, 6), np.complex128)
    sections[..., 0] = sections[..., 3] = 1
    sections[..., 4] = -poles[:, np.newaxis]
    for first in range(0, order, POLES_PER_SECTION):
        sections[:, first, 0] = gains ** min(POLES_PER_SECTION, order - first)
    sections[:, 0, 0] *= 2  # y = 2 Re(H x): a real signal has half of its amplitude at each of ±f
    return sections


def filter_by_scipy(
    block: FloatArray,
    sections: NDArray[np.complex128],
    state: NDArray[np.complex128],
    position: int,
    output: FloatArray,
    envelope: FloatArray | None,
) -> None:
    """Filter (ears, N) into `output` (ears, C, N), and the modulus into `envelope`, as `kernels.gammatone` does.

    `state` (ears, C, order) is updated: the last output of each pole, turned to frequency 0 by the angle of the pole
    for each of the `position` samples since the start of the span of `TURN_SPAN` samples.
    """
    block = clamp(block)
    poles = -sections[..., 4]
    lengths = modulus(poles)
    turns = np.divide(poles, lengths, out=np.ones_like(poles), where=lengths > 0)
    state *= lengths * turns**position  # the state of direct form II transposed, p y[n]
    for first in range(0, block.shape[-1], FLUSH_INTERVAL):
        span = slice(first, first + FLUSH_INTERVAL)
        for channel, poles_of_channel in enumerate(sections):
            before = np.zeros((len(poles_of_channel), len(block), 2), np.complex128)
            before[..., 0] = state[:, channel].T
            analytic, after = scipy.signal.sosfilt(poles_of_channel, block[:, span], zi=before)
            state[:, channel] = after[..., 0].T
            output[:, channel, span] = analytic.real
            if envelope is not None:
                envelope[:, channel, span] = modulus(analytic)
        flush_denormals(state)
    back = lengths * turns ** ((position + block.shape[-1]) % TURN_SPAN)
    np.divide(state, back, out=state, where=lengths > 0)
