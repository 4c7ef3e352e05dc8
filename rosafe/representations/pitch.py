"""The pitch stage: the period that the channels have in common.

* R. Meddis and L. O'Mard (1997), "A unitary model of pitch perception", J. Acoust. Soc. Am. 102, 1811-1820
* M. Slaney and R. F. Lyon (1990), "A perceptual pitch detector", Proc. ICASSP, 357-360
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Representation
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.rounding import round_half_away
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage

MEMORY_SECONDS = 5.0  # of confidences
MAX_ORDER = 99  # of the median


class Pitch(Stage):
    """Fundamental frequency, (2, C, L, F) to (2, 3, F): rows pitch (Hz, NaN for none), rawPitch (Hz, 0) and confidence.

    1. s[l] = mean over channels of the autocorrelation, for 1 / max(pi_rangeHz) <= l / fs <= 1 / min(pi_rangeHz)
    2. rawPitch = fs / l and confidence = s[l] at the highest peak of s inside that range, the first of equals, a
       plateau counting at its middle; both 0 where no peak is above 0
    3. q[k] = rawPitch[k], or 0 if confidence[k] is below pi_confThres times the greatest confidence of the last 5 s
    4. pitch[k] = median of q[k - floor(n/2)] to q[k + ceil(n/2) - 1], n = pi_medianOrder; q is 0 before the first frame

    A frame comes out when the ceil(n/2) - 1 frames behind it have come. A change begins nothing anew: q and rawPitch
    stay what they are for frames that have come, and the next frame that comes out is the first that has not.
    Where channels change, all begins anew, and frames that were held back are dropped.

    ValueError where there are fewer than 3 lags in the range.
    """

    REPRESENTATION = Representation(
        kind="pitch",
        doc="Pitch",
        parent="autocorrelation",
        axes=("ear", "feature", "time"),
        features=("pitch", "rawPitch", "confidence"),
        allow_nan=True,
        parameters=(
            Parameter(
                "pi_rangeHz",
                "sequence<double>",
                (80.0, 400.0),
                "Range of plausible pitches (Hz)",
                0.0,
                open_minimum=True,
                aliases=("p_pitchRangeHz",),
                least=2,
                most=2,
                unit="Hz",
            ),
            Parameter(
                "pi_confThres",
                "double",
                0.7,
                "Least confidence, relative to the greatest of the last 5 s",
                0.0,
                1.0,
                aliases=("p_confThresPerc",),
            ),
            Parameter(
                "pi_medianOrder",
                "unsigned long",
                3,
                "Frames of the median",
                1,
                MAX_ORDER,
                aliases=("p_orderMedFilt",),
            ),
        ),
        port_doc="pitch (Hz), rawPitch (Hz) and confidence as channels",
    )
    INPUT = ("ear", "channel", "lag", "time")

    _channels: int  # of the last block; 0 before the first
    _confidences: FloatArray  # (2, n), of the last 5 s of frames that have come
    _frames: FloatArray  # (2, 3, n): q, rawPitch and confidence of the last frames that have been put out, then of
    _pending_frames: int  # so many that have not

    def __init__(self, input_format: SignalFormat | float, **parameters: Any) -> None:
        self.reset()
        super().__init__(input_format, **parameters)

    @property
    def look_ahead(self) -> int:
        return (self.values["pi_medianOrder"] - 1) // 2

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return (rows[0], 3)

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        correlations = self._as_valid_block(block)
        channels, lags = correlations.shape[1:3]
        if lags != self.input_format.lags + 1:
            raise ValueError(f"block: {lags} lags, and not {self.input_format.lags + 1}")
        if channels != self._channels:
            self.reset()
            self._channels = channels
        summary = correlations[:, :, self._range].sum(axis=1) / channels
        lag, confidence = highest_peak(np.ascontiguousarray(summary.swapaxes(1, 2)))
        raw = np.divide(self.sample_rate, lag + self._range.start, out=np.zeros(lag.shape), where=confidence > 0)
        self._confidences, greatest = running_maximum(self._confidences, confidence, self._reach)
        chosen = np.where(confidence < self.values["pi_confThres"] * greatest, 0.0, raw)
        return self._emit(np.stack((chosen, raw, confidence), axis=1))

    def _emit(self, arriving: FloatArray) -> FloatArray:
        """What can be put out when frames (2, 3, F) of q, rawPitch and confidence have come."""
        frames = np.concatenate((self._frames, arriving), axis=-1)
        held = self._pending_frames + arriving.shape[-1]
        count, order = max(0, held - self.look_ahead), self.values["pi_medianOrder"]
        first = frames.shape[-1] - held
        output = frames[..., first : first + count].copy()
        if count:
            begin = first - order // 2
            windows = np.sort(sliding_window_view(frames[:, 0, begin : begin + count + order - 1], order, axis=-1))
            median = (windows[..., (order - 1) // 2] + windows[..., order // 2]) / 2
            output[:, 0] = np.where(median > 0, median, np.nan)
        self._pending_frames = held - count
        self._frames = frames[..., frames.shape[-1] - self._pending_frames - MAX_ORDER // 2 :].copy()
        return output

    def reset(self) -> None:
        self._channels = 0
        self._confidences = np.empty((2, 0))
        self._frames = np.zeros((2, 3, MAX_ORDER // 2))  # as many as the longest median wants
        self._pending_frames = 0

    @cached_property
    def output_format(self) -> SignalFormat:
        return replace(self.input_format, lags=0)

    def input_format_changed(self, before: SignalFormat) -> None:
        self.build(self.values, frozenset())
        channels = (self.input_format.center_frequencies, self.input_format.filterbank)
        if channels != (before.center_frequencies, before.filterbank):
            self.reset()

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        low, high = min(values["pi_rangeHz"]), max(values["pi_rangeHz"])
        seconds = np.arange(self.input_format.lags + 1) / self.sample_rate
        within = np.flatnonzero((seconds >= 1 / high) & (seconds <= 1 / low))
        if len(within) < 3:
            raise ValueError(
                f"pi_rangeHz: {low:.12g} to {high:.12g} Hz are {len(within)} lags of the autocorrelation, wanted are 3"
            )
        self._range = slice(int(within[0]), int(within[-1]) + 1)
        self._reach = max(1, round_half_away(MEMORY_SECONDS * self.input_format.rate))  # frames


def highest_peak(curves: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """Place and height of the highest peak of each of curves (..., n), n being 3 or more; without one, height 0.

    Of equally high ones, the first. A plateau is one peak, at its middle, rounded down. The ends are no peaks, and
    below 0 there are none.
    """
    inner = curves[..., 1:-1]
    tops = (inner > curves[..., :-2]) & (inner >= curves[..., 2:])
    heights = np.where(tops, inner, -np.inf)
    place = heights.argmax(axis=-1)[..., np.newaxis]
    height = np.take_along_axis(heights, place, axis=-1)
    if (height > np.take_along_axis(curves, place + 2, axis=-1)).all():  # no plateaus, as mostly
        return place[..., 0] + 1, np.maximum(height[..., 0], 0.0)
    return _highest_of_plateaus(curves)


def _highest_of_plateaus(curves: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """As `highest_peak`, where there may be plateaus, or no peak at all."""
    here, following = curves[..., :-1], curves[..., 1:]
    rises = following > here
    number = 2 * np.arange(curves.shape[-1])
    # of each step, twice its number, and one more where it falls; level ones are taken for the next one that is not
    steps = np.where(rises, number[:-1], np.where(following < here, number[:-1] + 1, number[-1]))
    steps = np.minimum.accumulate(steps[..., ::-1], axis=-1)[..., ::-1][..., 1:]
    peaks = rises[..., :-1] & (steps & 1 == 1)
    heights = np.where(peaks, following[..., :-1], -np.inf)
    begin = heights.argmax(axis=-1)[..., np.newaxis]
    end = np.take_along_axis(steps, begin, axis=-1) // 2
    return ((begin + 1 + end) // 2)[..., 0], np.maximum(heights.max(axis=-1), 0.0)


def running_maximum(before: FloatArray, values: FloatArray, reach: int) -> tuple[FloatArray, FloatArray]:
    """The last `reach` of all values, and the largest of each of `values` (2, F) and the reach - 1 in front of it.

    No value is below 0. `before` (2, n) are those in front of the first.
    """
    past = before[:, max(0, before.shape[1] - reach + 1) :]
    past = np.concatenate((np.zeros((2, reach - 1 - past.shape[1])), past, values), axis=1)
    greatest = np.empty(values.shape)
    for first in range(0, values.shape[1], reach):
        part = slice(first, first + reach)
        greatest[:, part] = np.maximum.accumulate(values[:, part], axis=1)
        # the largest from each of those before to their end
        ends = np.maximum.accumulate(past[:, first : first + reach - 1][:, ::-1], axis=1)[:, ::-1]
        both = greatest[:, part][:, : reach - 1]
        np.maximum(both, ends[:, : both.shape[1]], out=both)
    return np.concatenate((before, values), axis=1)[:, -reach:], greatest
