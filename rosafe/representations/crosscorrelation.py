"""The interaural cross-correlation stage."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Derived, Representation
from rosafe.dsp import buffer_pool, kernels
from rosafe.dsp.framing import FramedStage, batches, frame_parameters
from rosafe.dsp.numeric_limits import EPSILON, SQUARE_TINY, FloatArray, clamp
from rosafe.dsp.rounding import check_length
from rosafe.dsp.signal_format import SignalFormat


class CrossCorrelation(FramedStage):
    """Normalised correlation of the ears over lags and frames, (2, C, N) to (C, L, F).

    c[m] = sum over n of l[n+m] r[n] / sqrt(sum l**2 sum r**2 + eps), l and r being windowed frames, no mean removed,
    for lags m from -M to M, M = ceil(cc_maxDelaySec fs). A positive lag means that the left ear lags. The result is 0
    for lags from the window's length on, and in silence.
    """

    REPRESENTATION = Representation(
        kind="crossCorrelation",
        doc="Interaural cross-correlation",
        parent="ihc",
        axes=("channel", "lag", "time"),
        parameters=(
            *frame_parameters("cc"),
            Parameter.positive(
                "cc_maxDelaySec", 0.0011, "Maximum delay in cross-correlation computation (s)", 10.0, unit="s"
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
        references=(cite("may2011"),),
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
        reach = min(self._max_lag, len(self._framing.window) - 1)  # frames do not overlap at longer lags
        if kernels.compiled() and 2 * reach + 1 <= kernels.MAX_LAGS:
            return self._by_kernel(samples, reach)
        frames = self._new_frames(clamp(samples, SQUARE_TINY))  # (2, C, F, w)
        result = np.zeros((samples.shape[1], 2 * self._max_lag + 1, frames.shape[2]))
        correlate_by_fft(frames, self._framing.window, reach, result)
        return result

    def _by_kernel(self, samples: FloatArray, reach: int) -> FloatArray:
        frames = self._frames(samples, self._framing.pinned)
        shape = (samples.shape[1], 2 * self._max_lag + 1, frames.number)
        result = buffer_pool.empty(shape) if reach == self._max_lag else np.zeros(shape)
        kernels.correlations(frames, reach, EPSILON, result)
        return result

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        lag = check_length("cc_maxDelaySec", values["cc_maxDelaySec"] * self.sample_rate)
        super().build(values, changed)
        self._max_lag = math.ceil(lag)


def correlate_by_fft(frames: FloatArray, window: FloatArray, reach: int, result: FloatArray) -> None:
    """Correlate frames (2, C, F, w) of both ears, into the middle 2 reach + 1 lags of `result` (C, L, F)."""
    channel_count, frame_count, size = frames.shape[1:]
    middle = result.shape[1] // 2
    inner = slice(middle - reach, middle + reach + 1)
    transform = scipy.fft.next_fast_len(size + reach, real=True)
    for channels, part in batches(channel_count, frame_count, transform):
        # always in C order, on which the order of summation depends
        windowed = np.multiply(frames[:, channels, part], window, order="C")
        result[channels, inner, part] = _correlate(windowed, reach, transform).swapaxes(1, 2)


def _correlate(frames: FloatArray, reach: int, transform: int) -> FloatArray:
    """Correlate windowed frames (2, C, F, w): (C, F, 2 reach + 1)."""
    left, right = frames
    energies = np.square(left).sum(axis=-1) * np.square(right).sum(axis=-1)
    # Named arrays: numpy would multiply large temporary ones in place, with different rounding.
    of_left, of_right = scipy.fft.rfft(left, transform), np.conj(scipy.fft.rfft(right, transform))
    circular = scipy.fft.irfft(of_left * of_right, transform)
    lags = np.concatenate((circular[..., transform - reach :], circular[..., : reach + 1]), axis=-1)
    return lags / np.sqrt(energies + EPSILON)[..., np.newaxis]
