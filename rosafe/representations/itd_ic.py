"""The interaural time difference and coherence stages: lag and height of the peak of the cross-correlation."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage


def vertex_offset(before: FloatArray, value: FloatArray, after: FloatArray) -> FloatArray:
    """Return the distance, in samples, from `value` to the top of the parabola through three neighbours.

    It is 0 if the parabola has no maximum. The form of the curvature is never rounded to 0 at a peak.
    """
    curvature = (before - value) + (after - value)
    return np.divide(0.5 * (before - after), curvature, out=np.zeros(curvature.shape), where=curvature < 0)


class ParabolicPeaks(NamedTuple):
    """The peak over lags of each channel and frame. All arrays are (C, F)."""

    place: NDArray[np.intp]  # index of the largest value, the first of equals
    value: FloatArray
    offset: FloatArray  # from there to the top of the parabola, -0.5 to 0.5; 0 at the ends of the lags
    slope: FloatArray  # the value before the largest one minus the one after it
    flat: NDArray[np.bool_]  # whether the values at all lags are equal

    @classmethod
    def find(cls, correlations: FloatArray) -> ParabolicPeaks:
        """Find the peaks of (C, L, F)."""
        channels, lags, frames = correlations.shape
        peak = correlations.argmax(axis=1)
        values = correlations.reshape(-1)
        place = peak * frames + np.arange(frames)
        place += np.arange(channels)[:, np.newaxis] * (lags * frames)
        value = values[place]
        step = np.where((peak > 0) & (peak < lags - 1), frames, 0)
        before, after = values[place - step], values[place + step]
        offset = vertex_offset(before, value, after)
        flat = peak == 0
        if flat.any():  # rare except in silence; the minimum over all lags everywhere would take most of the time
            at = flat.nonzero()
            flat[at] = correlations[at[0], :, at[1]].min(axis=-1) == value[at]
        return cls(peak, value, offset, before - after, flat)

    @property
    def height(self) -> FloatArray:
        """The height of the top of the parabola."""
        height: FloatArray = self.value - 0.25 * self.slope * self.offset
        return height


class PeakStage(Stage):
    """A stage that derives one number from the peak of each channel and frame, (C, L, F) to (C, F); it has no state."""

    INPUT = ("channel", "lag", "time")

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return rows[:1]

    @cached_property
    def output_format(self) -> SignalFormat:
        return replace(self.input_format, lags=0)


class Itd(PeakStage):
    """Interaural time difference in s, (C, L, F) to (C, F); positive if the left ear lags, for sources on the right.

    (i - M + d) / fs, with i the index of the first maximum of the correlations c[0] to c[2M], and d = (c[i-1] -
    c[i+1]) / (c[i-1] - 2 c[i] + c[i+1]) / 2 the top of the parabola through it and its neighbours, 0 at both ends. The
    result is 0 if all correlations are equal, as in silence.
    """

    REPRESENTATION = Representation(
        kind="itd",
        doc="Interaural time difference",
        parent="crossCorrelation",
        axes=("channel", "time"),
        unit="s",
        port_doc="Interaural time differences (s), in `left`",
        references=(cite("may2011"),),
    )

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        correlations = self._as_valid_block(block)
        peaks = ParabolicPeaks.find(correlations)
        lags = peaks.place - correlations.shape[1] // 2 + peaks.offset
        lags[peaks.flat] = 0.0
        lags /= self.sample_rate
        return lags


class Ic(PeakStage):
    """Interaural coherence, (C, L, F) to (C, F): the height of the peak of the correlation.

    c[i] - (c[i-1] - c[i+1]) d / 4, with i and d as in `Itd`; c[i] at the ends of the lags.
    The top of a parabola may be slightly above 1. Silence gives 0.
    """

    REPRESENTATION = Representation(
        kind="ic",
        doc="Interaural coherence",
        parent="crossCorrelation",
        axes=("channel", "time"),
        port_doc="Interaural coherences, in `left`",
        references=(cite("faller2004"),),
    )

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        return ParabolicPeaks.find(self._as_valid_block(block)).height
