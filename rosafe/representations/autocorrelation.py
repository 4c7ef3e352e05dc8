"""The autocorrelation stage: the periodicity of each channel, for pitch and voicing."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Derived, Representation
from rosafe.dsp import kernels
from rosafe.dsp.framing import FrameBuffer, FramedStage, batches, frame_parameters
from rosafe.dsp.numeric_limits import FloatArray, clamp
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.windows import ALL_NAMES

MIN_DENOMINATOR = 1e-300  # replaces 0


class Autocorrelation(FramedStage):
    """Normalised autocorrelation of centre-clipped frames, (2, C, N) to (2, C, L, F); lag l is l / fs.

    With x = window * frame of w samples, x is clipped to y by thresholds, a fraction ac_clipAlpha of the largest and
    smallest value of the frame: T+ = alpha abs(max x) and T- = alpha abs(min x):

    === ======================= ========================= ===========
    .   if x >= T+              if x <= -T-               otherwise
    === ======================= ========================= ===========
    clp x                       x                         0
    clc x - T+                  x + T-                    0
    sgn 1, if x > 0             -1, if x < 0              0
    === ======================= ========================= ===========

    r = IFFT(abs(FFT(y))**ac_K) of N = 2**ceil(log2(2 w - 1)) points: the ordinary autocorrelation for ac_K = 2, a
    compressed one below. out[l] = r[l] / r[0] * w / (w - l), the number of products being w - l, for l < L = w - 1.
    Silence gives 0 at all lags. Long lags, with few products, may exceed ±1.
    """

    REPRESENTATION = Representation(
        kind="autocorrelation",
        doc="Autocorrelation",
        parent="ihc",
        axes=("ear", "channel", "lag", "time"),
        parameters=(
            *frame_parameters("ac", ALL_NAMES, fallback=""),
            Parameter.text(
                "ac_clipMethod",
                "clp",
                "Centre clipping: clp keeps samples beyond the threshold, clc subtracts it, sgn keeps their sign",
                kernels.CLIPPINGS,
            ),
            Parameter.real(
                "ac_clipAlpha",
                0.6,
                "Threshold of the clipping, as part of the frame's largest and smallest value",
                0.0,
                1.0,
            ),
            Parameter.positive("ac_K", 2.0, "Exponent of the magnitude spectrum; 2: ordinary autocorrelation", 10.0),
        ),
        derived=(Derived("ac_lags", "sequence<double>", "The lags, ascending from 0", unit="s"),),
        coordinates=("ac_lags",),
        port_doc="Autocorrelations, [lag][channel][frame]",
        references=(
            cite("licklider1951", "periodicity by autocorrelation"),
            cite("meddis1991", "autocorrelation of each channel"),
            cite("rabiner1977", "centre clipping"),
            cite("tolonen2000", "exponent of the magnitude spectrum"),
        ),
    )
    prefix = "ac"
    CHANNEL_INDEPENDENT = True

    @property
    def derived(self) -> dict[str, Any]:
        return {"ac_lags": (np.arange(self._lags) / self.sample_rate).tolist()}

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return (*rows, self._lags)

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        samples, values = self._as_valid_block(block), self.values
        clipping, alpha, exponent = values["ac_clipMethod"], values["ac_clipAlpha"], values["ac_K"]
        if kernels.compiled() and len(self.window) <= kernels.MAX_SIZE:
            frames = self._frames(samples, self._framing.pinned)
            return kernels.autocorrelations(frames, clipping, alpha, exponent, self._corrections)
        new = self._new_frames(clamp(samples))  # (2, C, F, w)
        return autocorrelate(new, self.window, clipping, alpha, exponent, self._corrections)

    @property
    def _lags(self) -> int:
        return len(self._corrections)

    @cached_property
    def output_format(self) -> SignalFormat:
        return replace(super().output_format, lags=self._lags - 1)

    def input_format_changed(self, before: SignalFormat) -> None:
        self._buffer = FrameBuffer()

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        super().build(values, changed)
        size = len(self.window)
        self._corrections = size / (size - np.arange(size - 1.0))


def autocorrelate(
    frames: FloatArray, window: FloatArray, clipping: str, alpha: float, exponent: float, corrections: FloatArray
) -> FloatArray:
    """Autocorrelate frames (2, C, F, w): (2, C, L, F), 1 at lag 0, with lag l multiplied by corrections[l]."""
    channel_count, frame_count, size = frames.shape[1:]
    lags = len(corrections)
    result = np.empty((len(frames), channel_count, lags, frame_count))
    points = 1 << (2 * size - 2).bit_length()
    for channels, part in batches(channel_count, frame_count, 2 * points):
        spectrum = scipy.fft.rfft(clipped(frames[:, channels, part] * window, clipping, alpha), points)
        power = np.square(spectrum.real) + np.square(spectrum.imag)
        if exponent != 2:
            power **= exponent / 2
        circular = scipy.fft.irfft(power, points)[..., :lags]
        normalised = circular / np.maximum(circular[..., :1], MIN_DENOMINATOR) * corrections
        result[:, channels, :, part] = normalised.swapaxes(2, 3)
    return result


def clipped(frames: FloatArray, clipping: str, alpha: float) -> FloatArray:
    """Return frames (..., w), centre-clipped and scaled so that no exponent causes overflow or underflow."""
    high, low = np.abs(frames.max(axis=-1, keepdims=True)), np.abs(frames.min(axis=-1, keepdims=True))
    above, below = frames >= alpha * high, frames <= -alpha * low
    if clipping == "sgn":
        return np.where(below & (frames < 0), -1.0, np.where(above & (frames > 0), 1.0, 0.0))
    if clipping == "clc":
        kept = np.where(below, frames + alpha * low, np.where(above, frames - alpha * high, 0.0))
    else:
        kept = np.where(above | below, frames, 0.0)
    return kept * (1 / np.maximum(np.maximum(high, low), MIN_DENOMINATOR))
