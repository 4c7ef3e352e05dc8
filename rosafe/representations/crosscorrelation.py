"""The interaural cross-correlation stage.

The normalised cross-correlation of hair cell outputs, as in T. May, S. van de Par and A. Kohlrausch (2011), "A
probabilistic model for robust localization based on a binaural auditory front-end", IEEE Trans. Audio Speech Lang.
Process. 19, 1-13.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Derived, Representation
from rosafe.dsp import buffer_pool, kernels
from rosafe.dsp.framing import FramedStage, frame_parameters
from rosafe.dsp.numeric_limits import SQUARE_TINY, FloatArray, clamp
from rosafe.dsp.rounding import MAX_SAMPLES
from rosafe.dsp.signal_format import SignalFormat

EPSILON = 2.2204e-16  # the original's literal
BATCH = 2**18  # samples per ear that are transformed at a time, to bound memory and stay in the cache


class CrossCorrelation(FramedStage):
    """Normalised correlation of the ears over lags and frames, (2, C, N) to (C, L, F).

    c[m] = sum over n of l[n+m] r[n] / sqrt(sum l**2 sum r**2 + eps), l and r being windowed frames, no mean removed,
    for lags m from -M to M, M = ceil(cc_maxDelaySec fs). A positive lag means that the left ear hears it later. Lags
    of a window's length and beyond give 0, and so does silence.
    """

    REPRESENTATION = Representation(
        kind="crossCorrelation",
        doc="Interaural cross-correlation",
        parent="ihc",
        axes=("channel", "lag", "time"),
        parameters=(
            *frame_parameters("cc"),
            Parameter(
                "cc_maxDelaySec",
                "double",
                0.0011,
                "Maximum delay in cross-correlation computation (s)",
                0.0,
                10.0,
                open_minimum=True,
                unit="s",
            ),
        ),
        request_order=("cc_wSizeSec", "cc_hSizeSec", "cc_maxDelaySec", "cc_wname"),
        derived=(Derived("cc_lags", "sequence<double>", "The lags, ascending", unit="s"),),
        coordinates=("cc_lags",),
        centred="lag",
        name="crosscorrelation",
        name_doc="The name of this cross-correlation processor",
        request_aliases=("CrossCorrelation",),
        port_doc="Cross-correlations, [lag][channel][frame]",
        word="crosscorrelation",
    )
    prefix = "cc"
    CHANNEL_INDEPENDENT = True

    @property
    def derived(self) -> dict[str, Any]:
        return {"cc_lags": (np.arange(-self._max_lag, self._max_lag + 1) / self.sample_rate).tolist()}

    @cached_property
    def output_format(self) -> SignalFormat:
        return replace(super().output_format, lags=self._max_lag)

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return (rows[1], 2 * self._max_lag + 1)

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        samples = self._as_valid_block(block)
        reach = min(self._max_lag, len(self._framing.window) - 1)  # beyond, frames do not overlap
        if kernels.compiled() and 2 * reach + 1 <= kernels.MAX_LAGS:
            return self._by_kernel(samples, reach)
        frames = self._framing.frames(self._buffer.append(clamp(samples, SQUARE_TINY)))  # (2, C, F, w)
        result = np.zeros((samples.shape[1], 2 * self._max_lag + 1, frames.shape[2]))
        correlate_by_fft(frames, self._framing.window, reach, result)
        self._buffer.drop(frames.shape[2] * self._framing.hop)
        return result

    def _by_kernel(self, samples: FloatArray, reach: int) -> FloatArray:
        frames = self._frames(samples, self._framing.pinned)
        shape = (samples.shape[1], 2 * self._max_lag + 1, frames.number)
        result = buffer_pool.empty(shape) if reach == self._max_lag else np.zeros(shape)
        kernels.correlations(frames, reach, EPSILON, result)
        return result

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        lag = values["cc_maxDelaySec"] * self.sample_rate
        if lag > MAX_SAMPLES:
            raise ValueError(f"cc_maxDelaySec: too long, {lag:.6g} samples")
        super().build(values, changed)
        self._max_lag = math.ceil(lag)


def correlate_by_fft(frames: FloatArray, window: FloatArray, reach: int, result: FloatArray) -> None:
    """Frames (2, C, F, w) of both ears to the middle 2 reach + 1 lags of `result` (C, L, F)."""
    channel_count, frame_count, size = frames.shape[1:]
    middle = result.shape[1] // 2
    inner = slice(middle - reach, middle + reach + 1)
    transform = scipy.fft.next_fast_len(size + reach, real=True)
    at_once = max(1, BATCH // transform)  # frames of one channel, or of as many channels as go with them
    channels_at_once = max(1, at_once // max(1, frame_count))
    for first in range(0, channel_count, channels_at_once):
        channels = slice(first, first + channels_at_once)
        for begin in range(0, frame_count, at_once):
            part = slice(begin, begin + at_once)
            # in one order of memory, whatever blocks are: the order of sums follows that
            windowed = np.multiply(frames[:, channels, part], window, order="C")
            correlations = _correlate(windowed, reach, transform)
            result[channels, inner, part] = correlations.swapaxes(1, 2)


def _correlate(frames: FloatArray, reach: int, transform: int) -> FloatArray:
    """Windowed frames (2, C, F, w) to (C, F, 2 reach + 1)."""
    left, right = frames
    energies = np.square(left).sum(axis=-1) * np.square(right).sum(axis=-1)
    # With a name, or numpy multiplies large ones in place, which rounds otherwise.
    of_left, of_right = scipy.fft.rfft(left, transform), np.conj(scipy.fft.rfft(right, transform))
    circular = scipy.fft.irfft(of_left * of_right, transform)
    lags = np.concatenate((circular[..., transform - reach :], circular[..., : reach + 1]), axis=-1)
    return lags / np.sqrt(energies + EPSILON)[..., np.newaxis]
