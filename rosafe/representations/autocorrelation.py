"""The autocorrelation stage: the periodicity of each channel, for pitch and voicing.

* J. C. R. Licklider (1951), "A duplex theory of pitch perception", Experientia 7, 128-134
* R. Meddis and M. J. Hewitt (1991), "Virtual pitch and phase sensitivity of a computer model of the auditory periphery.
  I: Pitch identification", J. Acoust. Soc. Am. 89, 2866-2882
* L. R. Rabiner (1977), "On the use of autocorrelation analysis for pitch detection", IEEE Trans. Acoust. Speech Signal
  Process. 25, 24-33: centre clipping
* T. Tolonen and M. Karjalainen (2000), "A computationally efficient multipitch analysis model", IEEE Trans. Speech
  Audio Process. 8, 708-716: compression of the spectrum
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Derived, Representation
from rosafe.dsp import kernels
from rosafe.dsp.framing import FrameBuffer, FramedStage, frame_parameters
from rosafe.dsp.numeric_limits import FloatArray, clamp
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.windows import ALL_NAMES

BATCH = 2**18  # samples that are transformed at a time, to bound memory and stay in the cache
SMALLEST = 1e-300  # stands for 0 in denominators


class Autocorrelation(FramedStage):
    """Normalised autocorrelation of centre-clipped frames, (2, C, N) to (2, C, L, F); lag l is l / fs.

    With x = window * frame of w samples, x is clipped to y by the part ac_clipAlpha of the frame's largest and smallest
    value, T+ = alpha abs(max x) and T- = alpha abs(min x):

    === ======================= ========================= ===========
    .   where x >= T+           where x <= -T-            elsewhere
    === ======================= ========================= ===========
    clp x                       x                         0
    clc x - T+                  x + T-                    0
    sgn 1, where x > 0          -1, where x < 0           0
    === ======================= ========================= ===========

    r = IFFT(abs(FFT(y))**ac_K) of N = 2**ceil(log2(2 w - 1)) points: the ordinary autocorrelation for ac_K = 2, a
    compressed one below. out[l] = r[l] / r[0] * w / (w - l), the number of products being w - l, for l < L = w - 1.
    Silence gives 0 at all lags. Long lags, with few products, may go beyond ±1.
    """

    REPRESENTATION = Representation(
        kind="autocorrelation",
        doc="Autocorrelation",
        parent="ihc",
        axes=("ear", "channel", "lag", "time"),
        parameters=(
            *frame_parameters("ac", ALL_NAMES, fallback=""),
            Parameter(
                "ac_clipMethod",
                "string",
                "clp",
                "Centre clipping: clp keeps what is over the threshold, clc what is above it, sgn its sign",
                choices=kernels.CLIPPINGS,
            ),
            Parameter(
                "ac_clipAlpha",
                "double",
                0.6,
                "Threshold of the clipping, as part of the frame's largest and smallest value",
                0.0,
                1.0,
            ),
            Parameter(
                "ac_K",
                "double",
                2.0,
                "Exponent of the magnitude spectrum; 2: ordinary autocorrelation",
                0.0,
                10.0,
                open_minimum=True,
            ),
        ),
        derived=(Derived("ac_lags", "sequence<double>", "The lags, ascending from 0", unit="s"),),
        coordinates=("ac_lags",),
        port_doc="Autocorrelations, [lag][channel][frame]",
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
        whole = self._framing.frames(self._buffer.append(clamp(samples)))  # (2, C, F, w)
        result = autocorrelate(whole, self.window, clipping, alpha, exponent, self._corrections)
        self._buffer.drop(result.shape[-1] * self._framing.hop)
        return result

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
    """Frames (2, C, F, w) to (2, C, L, F), 1 at lag 0; what is at lag l is multiplied by corrections[l]."""
    channel_count, frame_count, size = frames.shape[1:]
    lags = len(corrections)
    result = np.empty((2, channel_count, lags, frame_count))
    points = 1 << (2 * size - 2).bit_length()
    at_once = max(1, BATCH // (2 * points))  # frames of one channel, or of as many channels as go with them
    channels_at_once = max(1, at_once // max(1, frame_count))
    for first in range(0, channel_count, channels_at_once):
        channels = slice(first, first + channels_at_once)
        for begin in range(0, frame_count, at_once):
            part = slice(begin, begin + at_once)
            spectrum = scipy.fft.rfft(clipped(frames[:, channels, part] * window, clipping, alpha), points)
            power = np.square(spectrum.real) + np.square(spectrum.imag)
            if exponent != 2:
                power **= exponent / 2
            circular = scipy.fft.irfft(power, points)[..., :lags]
            normalised = circular / np.maximum(circular[..., :1], SMALLEST) * corrections
            result[:, channels, :, part] = normalised.swapaxes(2, 3)
    return result


def clipped(frames: FloatArray, clipping: str, alpha: float) -> FloatArray:
    """Frames (..., w), centre-clipped and scaled so that no exponent leads beyond the range of numbers."""
    high, low = np.abs(frames.max(axis=-1, keepdims=True)), np.abs(frames.min(axis=-1, keepdims=True))
    above, below = frames >= alpha * high, frames <= -alpha * low
    if clipping == "sgn":
        return np.where(below & (frames < 0), -1.0, np.where(above & (frames > 0), 1.0, 0.0))
    if clipping == "clc":
        kept = np.where(below, frames + alpha * low, np.where(above, frames - alpha * high, 0.0))
    else:
        kept = np.where(above | below, frames, 0.0)
    return kept * (1 / np.maximum(np.maximum(high, low), SMALLEST))
