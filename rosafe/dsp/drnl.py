"""The dual resonance nonlinear filterbank: a linear and a compressive path per channel.

E. A. Lopez-Poveda and R. Meddis (2001), "A human nonlinear cochlear filterbank", J. Acoust. Soc. Am. 110, 3107-3118,
in the form of the CASP model: M. L. Jepsen, S. D. Ewert and T. Dau (2008), "A computational model of human auditory
signal processing and perception", J. Acoust. Soc. Am. 124, 422-438. Input: velocity of the stapes in m/s, from level
scaling and middle ear filter with pp_bUnityComp off. `fb_nGamma` and `fb_bwERBs` do not apply.
"""

from __future__ import annotations

import numpy as np
import scipy

from . import kernels
from .numeric_limits import FloatArray, clamp
from .sos_filter import SosFilter

COMPRESSION = 10**-0.60206
MAX_FITTED_FREQUENCY = 1000.0  # Hz; above it, the nonlinear path has the gains of CASP_GAIN_FREQUENCY
CASP_GAIN_FREQUENCY = 1500.0  # Hz
MIN_FREQUENCY = 1.0  # Hz; the power laws were fitted from 250 Hz on and are meaningless far below


class DrnlBank:
    """DRNL filters, linear plus nonlinear path.

    The output is real. Its envelope comes from a quadrature of two samples, q[n] = (x[n] cos t - x[n-1]) / sin t with
    t = 2 pi f / fs, which is exact for a sinusoid at the channel's frequency f: sqrt(x**2 + q**2).

    Parameters
    ----------
    sample_rate : float
        In Hz.
    frequencies : ndarray (C,)
        Characteristic frequencies (Hz).

    Raises
    ------
    ValueError
        If a frequency is below 1 Hz, or if a filter of a channel would be at or above half the sample rate.
    """

    def __init__(self, sample_rate: float, frequencies: FloatArray) -> None:
        self.channels = [_Channel(sample_rate, float(frequency)) for frequency in frequencies]
        angles = 2 * np.pi * frequencies / sample_rate
        self._cos, self._sin = np.cos(angles)[:, np.newaxis], np.sin(angles)[:, np.newaxis]
        self.reset()

    def reset(self) -> None:
        """Reset the state of all filters."""
        for channel in self.channels:
            channel.reset()
        self._last = np.zeros((0, len(self.channels), 1))  # output of each ear

    def process(self, block: FloatArray, with_envelope: bool, output: FloatArray) -> FloatArray | None:
        """Filter (ears, N) into `output` (ears, C, N). Return the envelope, or None."""
        block = clamp(block)
        if len(self._last) != len(block):
            self._last = np.zeros((len(block), len(self.channels), 1))
        with kernels.denormals_off():  # the tails of the many filters reach denormals within a block
            for index, channel in enumerate(self.channels):
                output[:, index] = channel.process(block)
        envelope = None
        if with_envelope:
            delayed = np.concatenate((self._last, output[..., :-1]), axis=-1)[..., : output.shape[-1]]
            envelope = np.hypot(output, (output * self._cos - delayed) / self._sin)
        if block.shape[-1]:
            self._last = output[..., -1:].copy()
        return envelope


class _Channel:
    """The filters of one characteristic frequency, with constants of table III of Lopez-Poveda and Meddis (CASP)."""

    def __init__(self, sample_rate: float, frequency: float) -> None:
        def power_law(intercept: float, slope: float, at: float = frequency) -> float:
            return float(10 ** (intercept + slope * np.log10(at)))

        def resonator(centre: float, width: float) -> FloatArray:
            return _resonator(centre / sample_rate, width / sample_rate)

        def lowpass(cutoff: float) -> FloatArray:
            sections: FloatArray = scipy.signal.butter(2, cutoff, fs=sample_rate, output="sos")
            return sections

        if frequency < MIN_FREQUENCY:
            raise ValueError(f"fb_cfHz: expected at least {MIN_FREQUENCY:.12g} Hz for drnl, got {frequency:.6g} Hz")
        linear_centre, linear_cutoff = power_law(-0.06762, 1.01679), power_law(-0.06762, 1.01)
        centre, cutoff = power_law(-0.05252, 1.01650), power_law(-0.05252, 1.01)
        highest = max(linear_centre, linear_cutoff, centre, cutoff)
        if highest >= sample_rate / 2:
            raise ValueError(
                f"fb_cfHz: expected channels with all filters below half the sample rate, got drnl at "
                f"{frequency:.12g} Hz, which has a filter at {highest:.6g} Hz"
            )
        linear = [resonator(linear_centre, power_law(0.03728, 0.75))] * 2 + [lowpass(linear_cutoff)] * 4
        linear_sections = np.vstack(linear)
        linear_sections[0, :3] *= power_law(4.20405, -0.47909)
        resonance = np.vstack([resonator(centre, power_law(-0.03193, 0.70))] * 2)
        self.linear = SosFilter(linear_sections)
        self.before = SosFilter(resonance)
        self.after = SosFilter(np.vstack([resonance, lowpass(cutoff)]))
        fitted = frequency if frequency <= MAX_FITTED_FREQUENCY else CASP_GAIN_FREQUENCY
        self.slope = power_law(1.40298, 0.81916, fitted)
        self.compressive_gain = power_law(1.61912, -0.81867, fitted)

    def reset(self) -> None:
        for section in (self.linear, self.before, self.after):
            section.reset()

    def process(self, block: FloatArray) -> FloatArray:
        compressed = self._broken_stick(self.before.process(block))
        output: FloatArray = self.linear.process(block) + self.after.process(compressed)
        return output

    def _broken_stick(self, samples: FloatArray) -> FloatArray:
        """Return sign(x) min(a abs(x), b abs(x)**c)."""
        size = np.abs(samples)
        return np.copysign(np.minimum(self.slope * size, self.compressive_gain * size**COMPRESSION), samples)


def _resonator(centre: float, width: float) -> FloatArray:
    """Return a real second-order gammatone section (1, 6) of unit gain at `centre`, both in cycles per sample."""
    decay = np.exp(-2 * np.pi * width)
    alpha = -decay * np.cos(2 * np.pi * centre)
    delay = np.exp(-2j * np.pi * centre)
    gain = abs((1 + 2 * alpha * delay + decay**2 * delay**2) / (1 + alpha * delay))
    return np.array([[gain, gain * alpha, 0.0, 1.0, 2 * alpha, decay**2]])
