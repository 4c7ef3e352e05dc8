"""Interaural time difference and coherence: where the peak of the cross-correlation is, and how high.

* T. May, S. van de Par and A. Kohlrausch (2011), "A probabilistic model for robust localization based on a binaural
  auditory front-end", IEEE Trans. Audio Speech Lang. Process. 19, 1-13
* C. Faller and J. Merimaa (2004), "Source localization in complex listening situations: selection of binaural cues
  based on interaural coherence", J. Acoust. Soc. Am. 116, 3075-3089
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rosafe.declarations.representation import Representation
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage


class ParabolicPeaks(NamedTuple):
    """Of the correlations of each channel and frame; all arrays are (C, F)."""

    place: NDArray[np.intp]  # of the largest value, the first of equals
    value: FloatArray
    offset: FloatArray  # from there to the top of the parabola through it and its neighbours, -0.5 to 0.5
    slope: FloatArray  # the value before it less the one after it
    flat: NDArray[np.bool_]  # where all lags are equal

    @classmethod
    def find(cls, correlations: FloatArray) -> ParabolicPeaks:
        """Those of (C, L, F). At the ends of the lags there is no parabola: offset and slope are 0."""
        channels, lags, frames = correlations.shape
        peak = correlations.argmax(axis=1)
        values = correlations.reshape(-1)
        place = peak * frames + np.arange(frames)
        place += np.arange(channels)[:, np.newaxis] * (lags * frames)
        value = values[place]
        inside = (peak > 0) & (peak < lags - 1)
        step = np.where(inside, frames, 0)
        before, after = values[place - step], values[place + step]
        # before < value, as it is the first maximum: in this form no rounding makes the sum 0
        bend = (before - value) + (after - value)
        slope = before - after
        offset = np.divide(0.5 * slope, bend, out=np.zeros(peak.shape), where=inside)
        flat = peak == 0
        if flat.any():  # few are, but in silence; the least of all lags everywhere takes longer than all the rest
            at = flat.nonzero()
            flat[at] = correlations[at[0], :, at[1]].min(axis=-1) == value[at]
        return cls(peak, value, offset, slope, flat)


class _PeakStage(Stage):
    """A stage that takes one number from the peak of each channel and frame, (C, L, F) to (C, F); it has no state."""

    INPUT = ("channel", "lag", "time")

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return rows[:1]

    @cached_property
    def output_format(self) -> SignalFormat:
        return replace(self.input_format, lags=0)


class Itd(_PeakStage):
    """Interaural time difference in s; positive where the left ear hears later, that is, for sources on the right.

    (i - M + d) / fs, with i the place of the first largest of the correlations c[0] to c[2M], and d = (c[i-1] -
    c[i+1]) / (c[i-1] - 2 c[i] + c[i+1]) / 2 the top of the parabola through it and its neighbours, 0 at both ends. 0
    where all correlations are equal, as in silence.
    """

    REPRESENTATION = Representation(
        kind="itd",
        doc="Interaural time difference",
        parent="crossCorrelation",
        axes=("channel", "time"),
        unit="s",
        port_doc="Interaural time differences (s), in `left`",
    )

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        correlations = self._as_valid_block(block)
        peaks = ParabolicPeaks.find(correlations)
        lags = peaks.place - correlations.shape[1] // 2 + peaks.offset
        lags[peaks.flat] = 0.0
        lags /= self.sample_rate
        return lags


class Ic(_PeakStage):
    """Interaural coherence: the height of the correlation's peak.

    c[i] - (c[i-1] - c[i+1]) d / 4, with i and d as for `Itd`; at the ends of the lags c[i]. The top of a parabola may
    be slightly above 1. Silence gives 0.
    """

    REPRESENTATION = Representation(
        kind="ic",
        doc="Interaural coherence",
        parent="crossCorrelation",
        axes=("channel", "time"),
        port_doc="Interaural coherences, in `left`",
    )

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        peaks = ParabolicPeaks.find(self._as_valid_block(block))
        coherence: FloatArray = peaks.value - 0.25 * peaks.slope * peaks.offset
        return coherence
