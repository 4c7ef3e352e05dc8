"""Interpolation of peaks by the parabola through the largest value and its neighbours, and stages based on it."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .numeric_limits import FloatArray
from .signal_format import SignalFormat
from .stage import Stage


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
