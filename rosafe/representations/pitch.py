"""The pitch stage: the period common to all channels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.rounding import round_half_away
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage

CONFIDENCE_SECONDS = 5.0  # time over which the greatest confidence is determined
MAX_ORDER = 99  # of the median
HALF_TOLERANCE = 0.03  # part of the lag, about 50 cents, for twice the shorter lag; at least one sample
MIN_PERIODS = 3.0  # of the lowest pitch in the window of the autocorrelation


def short_window(values: Mapping[str, Any]) -> str:
    """Return a warning if the window of the autocorrelation is too short for the pitch range; otherwise ''."""
    lowest, seconds = min(values["pi_rangeHz"]), values["ac_wSizeSec"]
    if lowest * seconds >= MIN_PERIODS - 1e-9:
        return ""
    return (
        f"pi_rangeHz, ac_wSizeSec: a window of {seconds:g} s contains fewer than {MIN_PERIODS:g} periods of "
        f"{lowest:g} Hz, the lowest pitch of the range; pitches below {MIN_PERIODS / seconds:.0f} Hz are unreliable "
        'and may be reported as higher ones; for voices use rosafe.PRESETS["speech"] (--preset speech)'
    )


class Pitch(Stage):
    """Fundamental frequency, (2, C, L, F) to (2, 3, F): rows pitch (Hz or NaN), rawPitch (Hz or 0), confidence.

    1. s[l] = mean over channels of the autocorrelation, for 1 / pi_rangeHz[1] <= l / fs <= 1 / pi_rangeHz[0]
    2. rawPitch = fs / l and confidence = s[l] at the highest peak of s within that range, or at a peak at half of its
       lag (within HALF_TOLERANCE) that is at least pi_peakRatio times as high; the peak of a plateau is at its middle;
       both are 0 if no peak is above 0
    3. q[k] = rawPitch[k], or 0 if confidence[k] is below pi_confThres times the greatest confidence of the last 5 s
    4. pitch[k] = median of q[k - floor(n/2)] to q[k + ceil(n/2) - 1], n = pi_medianOrder; q is 0 before the first frame

    A frame is output when the following ceil(n/2) - 1 frames have arrived. A change of a parameter keeps q and rawPitch
    of past frames, and the next output frame follows the previous one. A change of the channels resets the state and
    drops pending frames.

    A range with fewer than 3 lags is a ValueError.
    """

    REPRESENTATION = Representation(
        kind="pitch",
        doc="Pitch",
        parent="autocorrelation",
        axes=("ear", "feature", "time"),
        features=("pitch", "rawPitch", "confidence"),
        background="ratemap",
        advice=short_window,
        allow_nan=True,
        parameters=(
            Parameter(
                "pi_rangeHz",
                "sequence<double>",
                (80.0, 400.0),
                "Lowest and highest plausible pitch (Hz)",
                0.0,
                open_minimum=True,
                aliases=("p_pitchRangeHz",),
                least=2,
                most=2,
                ascending=True,
                unit="Hz",
            ),
            Parameter.real(
                "pi_confThres",
                0.7,
                "Minimum confidence, relative to the greatest of the last 5 s",
                0.0,
                1.0,
                aliases=("p_confThresPerc",),
            ),
            Parameter.count("pi_medianOrder", 3, "Frames of the median", 1, MAX_ORDER, aliases=("p_orderMedFilt",)),
            Parameter.positive(
                "pi_peakRatio",
                1.0,
                "Least height of a peak at half the lag of the highest, relative to it, that is used in its place",
                1.0,
            ),
        ),
        port_doc="pitch (Hz), rawPitch (Hz) and confidence as channels",
        references=(
            cite("meddis1997", "sum of the autocorrelations of all channels"),
            cite("slaney1990", "peak of the sum"),
            cite("mcleod2005", "peak at a shorter lag, from a part of the height of the highest"),
        ),
    )
    INPUT = ("ear", "channel", "lag", "time")

    _channels: int  # of the last block; 0 before the first
    _confidences: FloatArray  # (ears, n), of the last 5 s
    _frames: FloatArray  # (ears, 3, n): q, rawPitch and confidence of the last output frames, then of the pending ones
    _pending_frames: int

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
            raise ValueError(f"block: expected {self.input_format.lags + 1} lags, got {lags}")
        if channels != self._channels:
            self._begin(len(correlations), channels)
        summary = correlations[:, :, self._range].sum(axis=1) / channels
        arriving = np.zeros((len(summary), 3, summary.shape[-1]))
        chosen, raw, confidence = arriving[:, 0], arriving[:, 1], arriving[:, 2]
        curves = np.ascontiguousarray(summary.swapaxes(1, 2))
        lag, confidence[:] = period_peak(curves, self._range.start, self.values["pi_peakRatio"])
        np.divide(self.sample_rate, lag, out=raw, where=confidence > 0)
        self._confidences, greatest = running_maximum(self._confidences, confidence, self._reach)
        np.copyto(chosen, raw, where=confidence >= self.values["pi_confThres"] * greatest)
        return self._emit(arriving)

    def _emit(self, arriving: FloatArray) -> FloatArray:
        """Return the frames to output after new frames (2, 3, F) of q, rawPitch and confidence."""
        frames = np.concatenate((self._frames, arriving), axis=-1)
        held = self._pending_frames + arriving.shape[-1]
        count, order = max(0, held - self.look_ahead), self.values["pi_medianOrder"]
        first = frames.shape[-1] - held
        output = frames[..., first : first + count].copy()
        if count:
            begin = first - order // 2
            windows = frames[:, 0, begin + np.arange(count)[:, np.newaxis] + np.arange(order)]
            windows.sort()
            median = (windows[..., (order - 1) // 2] + windows[..., order // 2]) / 2
            output[:, 0] = np.where(median > 0, median, np.nan)
        self._pending_frames = held - count
        self._frames = frames[..., frames.shape[-1] - self._pending_frames - MAX_ORDER // 2 :].copy()
        return output

    def reset(self) -> None:
        self._begin(0, 0)

    def _begin(self, ears: int, channels: int) -> None:
        """Reset for blocks of this leading shape."""
        self._channels = channels
        self._confidences = np.empty((ears, 0))
        self._frames = np.zeros((ears, 3, MAX_ORDER // 2))  # enough for the longest median
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
        low, high = values["pi_rangeHz"]
        seconds = np.arange(self.input_format.lags + 1) / self.sample_rate
        within = np.flatnonzero((seconds >= 1 / high) & (seconds <= 1 / low))
        if len(within) < 3:
            raise ValueError(
                f"pi_rangeHz: expected at least 3 lags of the autocorrelation, got {len(within)} from "
                f"{low:.12g} to {high:.12g} Hz"
            )
        self._range = slice(int(within[0]), int(within[-1]) + 1)
        self._reach = max(1, round_half_away(CONFIDENCE_SECONDS * self.input_format.rate))  # frames


def period_peak(curves: FloatArray, first_lag: int, ratio: float) -> tuple[NDArray[np.int64], FloatArray]:
    """Return lag and height of a peak of each of curves (..., n), n >= 3; the height is 0 without a peak.

    It is the highest one, the first of equals, or the highest at half of its lag if that is at least `ratio` times as
    high. A plateau is one peak at its middle, rounded down. The ends and values below 0 do not count as peaks. The
    curves begin at `first_lag`.
    """
    heights, lags = _peaks(curves)
    lags = lags + first_lag
    highest = heights.argmax(axis=-1)[..., np.newaxis]
    top, lag = np.take_along_axis(heights, highest, axis=-1), np.take_along_axis(lags, highest, axis=-1)
    if ratio < 1:
        usable = (heights >= ratio * top) & (np.abs(2 * lags - lag) <= np.maximum(1, HALF_TOLERANCE * lag))
        halves = np.where(usable, heights, -np.inf)
        half = halves.argmax(axis=-1)[..., np.newaxis]
        found = np.take_along_axis(usable, half, axis=-1)
        lag = np.where(found, np.take_along_axis(lags, half, axis=-1), lag)
        top = np.where(found, np.take_along_axis(heights, half, axis=-1), top)
    return lag[..., 0], np.maximum(top[..., 0], 0.0)


def _peaks(curves: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the heights of the peaks of curves (..., n), (..., n - 2) and -inf elsewhere, and the index of each."""
    inner, after = curves[..., 1:-1], curves[..., 2:]
    tops = (inner > curves[..., :-2]) & (inner >= after)
    if (tops & (inner == after)).any():
        return _peaks_and_plateaus(curves)
    heights = np.where(tops, inner, -np.inf)
    return heights, np.broadcast_to(np.arange(1, curves.shape[-1] - 1), heights.shape)


def _peaks_and_plateaus(curves: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Compute `_peaks` of curves that may have plateaus."""
    here, following = curves[..., :-1], curves[..., 1:]
    rises = following > here
    number = 2 * np.arange(curves.shape[-1])
    # twice the index of each step, plus 1 if it falls; level steps get the value of the next step that is not level
    steps = np.where(rises, number[:-1], np.where(following < here, number[:-1] + 1, number[-1]))
    steps = np.minimum.accumulate(steps[..., ::-1], axis=-1)[..., ::-1][..., 1:]
    peaks = rises[..., :-1] & (steps & 1 == 1)
    heights = np.where(peaks, following[..., :-1], -np.inf)
    return heights, (number[1:-1] // 2 + steps // 2) // 2


def running_maximum(before: FloatArray, values: FloatArray, reach: int) -> tuple[FloatArray, FloatArray]:
    """Return the last `reach` values, and the maximum of each of `values` (2, F) and the reach - 1 values before it.

    No value is below 0. `before` (2, n) are the values before the first.
    """
    joined = np.concatenate((before, values), axis=1)
    # the window of each value ends with it
    greatest = scipy.ndimage.maximum_filter1d(joined, reach, axis=1, mode="constant", origin=(reach - 1) // 2)
    return joined[:, -reach:], greatest[:, before.shape[1] :]
