"""Whether the cues of ordinary sound belong to a head: from level and time differences, whatever the directions are.

A head between the microphones makes level differences at high frequencies that grow with the time difference; without
one they are 0 for all directions (J. Blauert (1997), Spatial Hearing, MIT Press, chapter 2). Reverberation reduces
them, but not to zero: at a direct-to-reverberant ratio of 0 dB, 3 to 4 dB per ms of time difference remain of 6 to 8.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import cues
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.localizer import find_model
from rosafe.localization.pair import PREFIX
from rosafe.localization.sphere import SPEED_OF_SOUND
from rosafe.processing.signals import ears_view
from rosafe.processing.stream import Stream

MAX_GAIN_DB = 1.5  # measured heads have up to 1.1 dB
MEMORY_SECONDS = 60.0  # of sound
MIN_BLOCKS = 8  # of sound with a time difference
HEAD_SLOPE = 1.7  # dB per ms: between that of microphones without a head (below 0.7) and of heads in rooms (from 3)
MIN_LEVEL_DIFFERENCE = 4.0  # dB, which a model of a head expects from a direction at high frequencies
_BLOCK_SECONDS = 0.1  # of frames with one direction
_ORDER_BLOCKS = 5  # of whose median the side is that of a sound
_STEP_SECONDS = 10.0  # of a recording, at a time
_LOW, _MIDDLE, _HIGH = 150.0, 2500.0, 2000.0  # Hz: time differences from _LOW to _MIDDLE, level differences from _HIGH
_TIME_COHERENCE, _LEVEL_COHERENCE = 0.95, 0.8  # of frames whose time or level differences count, at least
_TOP_DB = 12.0  # below the loudest frame of a block, of frames that count
_MIN_UNITS = 10  # of channels and frames that count in a block
_LAGS = np.linspace(-1.1, 1.1, 221)  # ms, at which the density of time differences is estimated
_WIDTH = 0.05  # ms, of the estimate
_MIN_PART = 0.3  # of the time differences of a block that agree
_MIN_SPAN = 0.1  # ms, of the time differences: in those of one direction, only the spectrum of the sound varies
_BIN = 0.05  # ms: blocks with equal time differences count as one measurement
_SPREAD_DB = 0.2  # of the level difference of a block without a head
_MIN_SAME = 2  # blocks of a bin
_MAX_SAME = 4  # blocks of a bin that count: more of one direction add no evidence
_GAIN_DB, _SLOPE = 1.5, 50.0  # standard deviations of gain and slope (dB/ms) before the sound is known
_ITERATIONS = 4  # until the spread of the regression is known
_MIN_PAIRS, _MIN_PAIRED = 8, 0.2  # blocks with another at the opposite side: number, and part of all
_DELAY_QUANTILE, _DELAY_TOLERANCE, _DELAY_SLACK = 0.9, 1.05, 0.04  # of the largest delay; slack in ms


class _Block(NamedTuple):
    """The differences in 0.1 s of sound from one direction."""

    lag: float  # ms, positive if the left ear hears later
    high: float  # dB, positive if the right ear is louder; at high frequencies
    low: float  # the same at low frequencies


class HeadReport(NamedTuple):
    """The result; values that the sound does not determine are NaN.

    Attributes
    ----------
    slope : float
        Level difference at high frequencies per time difference, dB/ms.
    slope_error : float
        Standard error of the slope.
    gain_db : float
        Gain of the left channel above that of the right one.
    max_lag : float
        The largest time difference of many blocks, ms.
    first_side : str
        `left` or `right` if the sound came from there first, and later from the other side; empty otherwise.
    problem : str
        One line, or empty.
    """

    slope: float
    slope_error: float
    gain_db: float
    max_lag: float
    first_side: str
    problem: str

    @property
    def lines(self) -> tuple[str, ...]:
        """The lines for a terminal, without the problem."""
        found = [f"time differences up to {self.max_lag:.2f} ms"]
        if not np.isnan(self.slope):
            found.append(
                f"level differences at high frequencies: {self.slope:.1f} dB per ms of time difference (standard error "
                f"{self.slope_error:.1f}; heads have 3 or more)"
            )
        if not np.isnan(self.gain_db):
            found.append(
                f"gain: the {'left' if self.gain_db > 0 else 'right'} ear is {abs(self.gain_db):.1f} dB louder"
            )
        if self.first_side:
            other = "right" if self.first_side == "left" else "left"
            found.append(
                f"the sound came from the {self.first_side} first, then from the {other}: if it was the other way "
                "round, the ears are swapped: exchange the channels (--channels 2,1)"
            )
        return tuple(found)


class HeadCheck:
    """Compares the cues of successive frames with a model.

    Parameters
    ----------
    model : DirectionModel
        Of the head that is to be checked.
    """

    def __init__(self, model: DirectionModel) -> None:
        described = cues.describe(model.sample_rate, model.parameters)
        centers = np.asarray(described["fb_cfHz"])
        self._time_channels = (centers > _LOW) & (centers < _MIDDLE)
        self._level_channels = centers > _HIGH
        self._minimum = cues.MIN_LEVEL + cues.scaling_db(model.parameters)
        self._frames = max(1, round(_BLOCK_SECONDS * described["itd_frameRate"]))
        self._blocks: deque[_Block] = deque(maxlen=round(MEMORY_SECONDS / _BLOCK_SECONDS))
        self._rest: dict[str, FloatArray] = {}
        self._model_lag, self._model_has_head = _expected(model, self._time_channels, self._level_channels)

    def update(self, features: Mapping[str, Any]) -> None:
        """Add frames, as of `Localizer.update`."""
        joined = {
            kind: np.concatenate((self._rest[kind], features[kind]), axis=-1) if self._rest else features[kind]
            for kind in cues.KINDS
        }
        whole = joined["itd"].shape[-1] // self._frames * self._frames
        for begin in range(0, whole, self._frames):
            frames = slice(begin, begin + self._frames)
            block = self._measured({kind: array[..., frames] for kind, array in joined.items()})
            if block is not None:
                self._blocks.append(block)
        self._rest = {kind: np.array(array[..., whole:]) for kind, array in joined.items()}

    def _measured(self, features: Mapping[str, FloatArray]) -> _Block | None:
        """Return the differences in a block; None without sound from one direction."""
        level = 10 * np.log10(np.maximum(features["ratemap"].sum(axis=0), 1e-300))
        loud = level > np.maximum(level.max(axis=1, keepdims=True) - _TOP_DB, self._minimum)
        clear = loud & (features["ic"] > _TIME_COHERENCE) & self._time_channels[:, np.newaxis]
        lags = 1000 * features["itd"][clear]
        leveled = loud & (features["ic"] > _LEVEL_COHERENCE)
        high = features["ild"][leveled & self._level_channels[:, np.newaxis]]
        low = features["ild"][leveled & ~self._level_channels[:, np.newaxis]]
        if min(len(lags), len(high), len(low)) < _MIN_UNITS:
            return None
        density = np.exp(-0.5 * ((_LAGS[:, np.newaxis] - lags) / _WIDTH) ** 2).sum(axis=1)
        if density.max() < _MIN_PART * len(lags):
            return None
        return _Block(float(_LAGS[density.argmax()]), float(np.median(high)), float(np.median(low)))

    def report(self, least: int = MIN_BLOCKS) -> HeadReport | None:
        """Return the result for the last minute of sound; None as long as there are less than `least` blocks."""
        if len(self._blocks) < least:
            return None
        lags, high, low = np.array(self._blocks).T
        bins = np.rint(lags / _BIN).astype(int)
        early, late = np.quantile(lags, (1 - _DELAY_QUANTILE, _DELAY_QUANTILE))
        slope, error = _slope(high, bins) if late - early > _MIN_SPAN else (np.nan, np.nan)
        both_sides = min(-early, late) > _MIN_SPAN / 2
        gain = -_common(bins, (high + low) / 2)  # the ILD is positive if the right ear is louder
        longest = float(np.quantile(np.abs(lags), _DELAY_QUANTILE))
        problem = self._problem(slope, error, gain, longest, both_sides)
        return HeadReport(slope, error, gain, longest, _first_side(lags, longest), problem)

    def _problem(self, slope: float, error: float, gain: float, longest: float, both_sides: bool) -> str:
        without_head = (slope if both_sides else abs(slope)) + 2 * error < HEAD_SLOPE
        spacing = f"{PREFIX}{longest / 1000 * SPEED_OF_SOUND:.2g}"
        if both_sides and slope + 2 * error < -HEAD_SLOPE:
            return (
                "times and levels contradict each other: the ear that hears later is louder; check that each "
                "microphone is in its ear, and that both have the same polarity"
            )
        if self._model_has_head and without_head:
            return (
                "no level differences at high frequencies: these are microphones without a head; use "
                f"--head {PREFIX}SPACING with their distance in m (at least {spacing.removeprefix(PREFIX)})"
            )
        if not self._model_has_head and slope - 2 * error > HEAD_SLOPE:
            return (
                f"level differences of {slope:.0f} dB per ms at high frequencies, which microphones without a head do "
                "not have; use --head sphere, or --head FILE with a SOFA file or recordings of this head"
            )
        if longest > _DELAY_TOLERANCE * self._model_lag + _DELAY_SLACK:
            advice = (
                "--head FILE with a SOFA file or recordings of this head (rosafe head learn)"
                if self._model_has_head
                else f"--head {spacing}, or more"
            )
            return f"delays up to {longest:.2f} ms, but this head allows {self._model_lag:.2f} ms; use {advice}"
        if abs(gain) > MAX_GAIN_DB:
            louder, weaker = ("left", "right") if gain > 0 else ("right", "left")
            return (
                f"the gains differ by {abs(gain):.1f} dB: raise that of the {weaker} ear, or lower that of the "
                f"{louder} one"
            )
        return ""


def check_sound(
    sound: Any, sample_rate: float, head: Any = "sphere", parameters: Mapping[str, Any] | None = None
) -> HeadReport | None:
    """Check a recording of a walk around the head, or of ordinary sound; arguments as of `rosafe.localize`.

    Returns
    -------
    HeadReport or None
        Of the last minute with sound from one direction at a time; None if there are less than 0.8 s.

    Raises
    ------
    ValueError
        As `rosafe.localize`.
    """
    model = find_model(head, sample_rate, parameters)
    check, stream = HeadCheck(model), Stream(sample_rate, model.parameters, list(cues.KINDS))
    view = ears_view(sound)
    step = max(1, round(_STEP_SECONDS * sample_rate))
    for begin in range(0, view.shape[1], step):
        check.update(stream.process(np.ascontiguousarray(view[:, begin : begin + step])))
    return check.report()


def _first_side(lags: FloatArray, longest: float) -> str:
    """Return the side from which the sound came first, if it came from both."""
    smooth = median_filter(lags, _ORDER_BLOCKS, mode="nearest")
    sides = smooth[np.abs(smooth) > longest / 2]
    if longest < _MIN_SPAN / 2 or not len(sides) or abs(np.sign(sides).sum()) == len(sides):
        return ""
    return "right" if sides[0] > 0 else "left"


def _medians(bins: NDArray[np.intp], values: FloatArray) -> tuple[NDArray[np.intp], FloatArray, NDArray[np.intp]]:
    """Return the bins with enough blocks, the medians of the values in them, and the numbers of blocks."""
    places, counts = np.unique(bins, return_counts=True)
    places, counts = places[counts >= _MIN_SAME], counts[counts >= _MIN_SAME]
    return places, np.array([np.median(values[bins == place]) for place in places]), np.minimum(counts, _MAX_SAME)


def _slope(high: FloatArray, bins: NDArray[np.intp]) -> tuple[float, float]:
    """Return the slope of level over time differences in dB/ms, and its standard error.

    The regression is Bayesian: gains of the microphones are similar, so that also one direction at the side counts.
    """
    places, levels, counts = _medians(bins, high)
    terms = np.stack((np.ones(len(places)), _BIN * places), axis=1)
    prior = np.diag((_GAIN_DB**-2, _SLOPE**-2))
    spread, slope, error = _SPREAD_DB, 0.0, np.inf
    for _ in range(_ITERATIONS):
        covariance = np.linalg.inv(terms.T @ (terms * counts[:, np.newaxis]) / spread**2 + prior)
        fitted = covariance @ (terms.T @ (counts * levels)) / spread**2
        slope, error = float(fitted[1]), float(np.sqrt(covariance[1, 1]))
        residual = counts @ (levels - terms @ fitted) ** 2 / max(1, counts.sum())
        spread = max(_SPREAD_DB, float(np.sqrt(residual)))
    return slope, error


def _common(bins: NDArray[np.intp], levels: FloatArray) -> float:
    """Return the part of level differences that is equal for both sides in dB; NaN if the sides cannot be compared."""
    places, medians, counts = _medians(bins, levels)
    found = dict(zip(places.tolist(), zip(medians, counts, strict=True), strict=True))
    pairs = [(found[place], found[-place]) for place in found if place >= 0 and -place in found]
    weights = [min(left[1], right[1]) for left, right in pairs]
    if sum(weights) < max(_MIN_PAIRS, _MIN_PAIRED * counts.sum()):
        return np.nan
    return float(np.average([(left[0] + right[0]) / 2 for left, right in pairs], weights=weights))


def _expected(model: DirectionModel, low: NDArray[np.bool_], high: NDArray[np.bool_]) -> tuple[float, bool]:
    """Return the largest delay of a model in ms, and whether it expects level differences at high frequencies."""
    differences = []
    for table, bins, limit, channels in (
        (model.itd_table, cues.ITD_BINS, 1000 * model.max_itd, low),
        (model.ild_table, cues.ILD_BINS, cues.MAX_ILD, high),
    ):
        classes = table[:-1].reshape(model.channels, cues.COHERENCE_CLASSES, cues.LEVEL_CLASSES, bins, -1)
        evidence = np.maximum(classes[channels, 0, cues.LEVEL_CLASSES // 2 :].sum(axis=(0, 1)), 0.0)
        centers = ((np.arange(bins) + 0.5) / bins * 2 - 1) * limit
        differences.append(np.abs(centers @ evidence / np.maximum(evidence.sum(axis=0), 1e-9)).max())
    return float(differences[0]), bool(differences[1] > MIN_LEVEL_DIFFERENCE)
