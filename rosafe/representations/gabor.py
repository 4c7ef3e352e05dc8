"""The Gabor features stage: how much of each of many patterns of time and frequency there is.

* M. R. Schädler, B. T. Meyer and B. Kollmeier (2012), "Spectro-temporal modulation subspace-spanning filter bank
  features for robust automatic speech recognition", J. Acoust. Soc. Am. 131, 4134-4151
* A. Qiu, C. E. Schreiner and M. A. Escabí (2003), "Gabor analysis of auditory midbrain receptive fields:
  spectro-temporal and binaural composition", J. Neurophysiol. 90, 456-476
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Derived, Representation
from rosafe.dsp import kernels
from rosafe.dsp.framing import FrameBuffer
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.rounding import round_half_away
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage

NORMALISATION_SECONDS = 5.0  # s, that levels and features are normalised by
CONTEXT_FRAMES = 19  # frames before and after one that its features take in
WAVES = 3.5  # half periods in the length of a filter
LENGTH = 40  # of the longest filter, in frames
TIME_STEP, CHANNEL_STEP = 0.2, 0.3  # how far apart the frequencies of the filters are
HIGHEST = math.pi / 2  # of these, per frame or channel
EPSILON = 2.2204e-16  # the original's literal
MIN_RELATIVE_DEVIATION = 1e-9  # of 1 + |mean|: features that deviate by less are 0


class GaborState:
    """What frames still to come depend on.

    Attributes
    ----------
    levels : FrameBuffer
        S of the last 2 * 19 frames, (2, C, n), beginning with 19 times the first.
    maxima : FrameBuffer
        The largest rate of each frame of the last 5 s, (2, n).
    deviations : Deviations
        Of the features.
    channels : int
        How many there are; -1 before the first block.
    """

    def __init__(self) -> None:
        self.begin(-1, 0)

    def begin(self, channels: int, features: int) -> None:
        """Nothing has come yet."""
        self.levels, self.maxima = FrameBuffer(), FrameBuffer()
        self.deviations = RunningZScore(1, np.empty((0, 2 * features)))
        self.channels = channels


class Gabor(Stage):
    """Spectro-temporal modulation of the level in both ears, (2, C, F) to (2, G, F - 19), normalised by the last 5 s.

    1. Filters: products of a modulation in time and one along the channels, g = e exp(i (w n + k c)); `filters`.
    2. Weights W of `patterns`: the real parts of the filters around some channels each, which depend on the number of
       channels alone and give G features, `gb_nFeatures`.
    3. S = 10 log10(R + 10**(-gb_maxDynamicRangeDB / 10) Rmax + eps), Rmax being the largest rate of all channels in
       the last 5 s; negative rates count as 0.
    4. y[k] = sum over channels and u = -19...19 of W[c, u] S[c, k - u], where the first frame also stands for those
       before it. So 19 frames are held back.
    5. z[k] = (y[k] - mean) / sigma over the y of the last 5 s, 0 where sigma <= 1e-9 (1 + abs(mean)).

    Other channels than before mean a new beginning; any other change goes on with what is remembered.
    """

    REPRESENTATION = Representation(
        kind="gabor",
        doc="Gabor features of spectro-temporal modulation",
        parent="ratemap",
        axes=("ear", "feature", "time"),
        parameters=(
            Parameter(
                "gb_maxDynamicRangeDB",
                "double",
                80.0,
                "Dynamic range (dB): everything below the maximum less this is levelled",
                0.0,
                1000.0,
                open_minimum=True,
                unit="dB",
            ),
        ),
        derived=(Derived("gb_nFeatures", "unsigned long", "Number of features"),),
        port_doc="Gabor features",
    )

    def __init__(self, input_format: SignalFormat | float, **parameters: Any) -> None:
        self._memory = GaborState()
        super().__init__(input_format, **parameters)

    @property
    def derived(self) -> dict[str, Any]:
        return {"gb_nFeatures": count_features(len(self.input_format.center_frequencies)).features}

    @property
    def look_ahead(self) -> int:
        return CONTEXT_FRAMES

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return (rows[0], count_features(rows[1]).features)

    def state_size(self, rows: tuple[int, ...]) -> int:
        features, weights = count_features(rows[1])
        # of the last 5 s the features, their sums and their squares' sums; levels, in a store of up to twice as many
        return 3 * self._remembered * 2 * features + weights + 4 * 2 * CONTEXT_FRAMES * math.prod(rows)

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        rates = np.maximum(self._as_valid_block(block), 0.0)
        memory, made = self._memory, patterns(rates.shape[1])
        if rates.shape[1] != memory.channels:
            memory.begin(rates.shape[1], len(made.places))
        if rates.size == 0:
            return np.empty((2, len(made.places), 0))
        levels = self._levels(rates)
        if memory.levels.held == 0:
            levels = np.concatenate((np.repeat(levels[..., :1], CONTEXT_FRAMES, axis=-1), levels), axis=-1)
        levels = memory.levels.append(levels)
        count = max(0, levels.shape[-1] - 2 * CONTEXT_FRAMES)
        features = filter_responses(levels, count, made)
        memory.levels.drop(count)
        if memory.deviations.length != self._remembered:
            memory.deviations = memory.deviations.resized(self._remembered)
        deviations = memory.deviations.process(features.reshape(2 * len(made.places), count).T)
        return np.ascontiguousarray(deviations.T).reshape(features.shape)

    def _levels(self, rates: FloatArray) -> FloatArray:
        """S (2, C, F) of rates that are not negative."""
        maxima = self._memory.maxima.append(rates.max(axis=1))
        held, count = maxima.shape[-1], rates.shape[-1]
        largest = np.empty((2, 1, count))
        for frame, end in enumerate(range(held - count + 1, held + 1)):
            maxima[:, max(0, end - self._remembered) : end].max(axis=1, keepdims=True, out=largest[..., frame])
        self._memory.maxima.drop(max(0, held - (self._remembered - 1)))
        levels: FloatArray = np.log10(rates + (self._floor * largest + EPSILON))
        return np.multiply(levels, 10.0, out=levels)

    def reset(self) -> None:
        self._memory = GaborState()

    def input_format_changed(self, before: SignalFormat) -> None:
        if self.input_format.center_frequencies != before.center_frequencies:
            self._memory = GaborState()
        self.build(self.values, frozenset())

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        self._floor = 10 ** (-values["gb_maxDynamicRangeDB"] / 10)
        self._remembered = max(1, round_half_away(NORMALISATION_SECONDS * self.input_format.rate))


# --- filters ----------------------------------------------------------------------------------------------------


class Patterns(NamedTuple):
    """The weights of G features.

    Attributes
    ----------
    places : ndarray (G, 4) of int64
        The first channel that counts, how many do, how many frames do on either side, and where its weights begin.
    weights : ndarray
        Of one feature after the other, each (channels, frames) with the frames from the earliest on.
    """

    places: NDArray[np.int64]
    weights: FloatArray


class Count(NamedTuple):
    """How many features and weights `patterns` has."""

    features: int
    weights: int


@functools.lru_cache(maxsize=16)
def count_features(channels: int) -> Count:
    """Those of so many channels, told without making them."""
    features = weights = 0
    for (length, _), (extent, _) in extents(channels):
        half, reach = math.ceil(extent / 2) - 1, math.ceil(length / 2) - 1
        step = max(1, (2 * half + 1) // 4)
        for channel in range(channels // 2 % step, channels, step):
            features += 1
            weights += (min(channels, channel + half + 1) - max(0, channel - half)) * (2 * reach + 1)
    return Count(features, weights)


@functools.lru_cache(maxsize=4)
def patterns(channels: int) -> Patterns:
    """The features of so many channels.

    A filter of K channels is put on every max(1, K // 4)-th channel, counted from the middle one. What lies outside of
    the channels is cut off; where a filter has negative real parts, the rest is balanced by its magnitude m:
    W - m sum(W) / sum(m).
    """
    places, weights, begin = [], [np.empty(0)], 0
    for g in filters(channels):
        half, reach = g.shape[0] // 2, g.shape[1] // 2
        step = max(1, g.shape[0] // 4)
        mirrored = g[::-1, ::-1]  # channel c', frame k - u: as they lie in memory
        for channel in range(channels // 2 % step, channels, step):
            first, stop = max(0, channel - half), min(channels, channel + half + 1)
            cut = mirrored[first - channel + half : stop - channel + half]
            weight, size = cut.real, np.abs(cut)
            if (g.real < 0).any():
                weight = weight - size * (weight.sum() / size.sum())
            places.append((first, stop - first, reach, begin))
            weights.append(weight.ravel())
            begin += weight.size
    return Patterns(np.array(places, np.int64).reshape(-1, 4), np.concatenate(weights))


def filters(channels: int) -> Iterator[NDArray[np.complex128]]:
    """All filters for so many channels, (channels, frames), both odd: by frequency in time, then along the channels."""
    return (_filter(time, channel) for time, channel in extents(channels))


def extents(channels: int) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
    """Length and frequency of each filter in time, and along the channels."""
    if channels == 0:
        return
    along = frequencies(3 * channels, CHANNEL_STEP)
    for omega in (0.0, *reversed(frequencies(LENGTH, TIME_STEP))):
        for kappa in (*(-f for f in along), 0.0, *reversed(along)):
            if omega > 0 or kappa >= 0:
                yield _extent(omega, LENGTH), _extent(kappa, 3 * channels)


def frequencies(longest: int, step: float) -> list[float]:
    """Frequencies along an axis on which filters are at most so long, from the highest down."""
    width = 8 * step / WAVES
    found = [HIGHEST]
    while (lower := found[-1] * (1 - width / 2) / (1 + width / 2)) > WAVES * math.pi / longest:
        found.append(lower)
    return found


def _extent(frequency: float, longest: int) -> tuple[float, float]:
    """Length and frequency of a filter along an axis; those that would be longer have no frequency."""
    length = WAVES * math.pi / abs(frequency) if frequency else math.inf
    return (longest, 0.0) if length > longest else (length, frequency)


def _filter(time: tuple[float, float], channel: tuple[float, float]) -> NDArray[np.complex128]:
    """A wave under a Hann envelope, without a mean, with a largest gain of 1."""
    envelopes, phases = [], []
    for length, frequency in (channel, time):
        half = math.ceil(length / 2) - 1
        place = np.arange(-half, half + 1)
        envelopes.append(0.5 + 0.5 * np.cos(2 * np.pi * place / length))
        phases.append(frequency * place)
    envelope = np.outer(*envelopes)
    g: NDArray[np.complex128] = envelope * np.exp(1j * np.add.outer(*phases))
    g = g - envelope * (g.mean() / envelope.mean()) if time[1] or channel[1] else g * (1 + 1j)
    return g / np.abs(scipy.fft.fft2(g)).max()


# --- features of frames -----------------------------------------------------------------------------------------


def filter_responses(levels: FloatArray, count: int, made: Patterns) -> FloatArray:
    """The features (2, G, count) of levels (2, C, count + 38)."""
    if count == 0:
        return np.empty((2, len(made.places), 0))
    if not kernels.compiled():
        return respond_by_scipy(levels, count, made)
    return kernels.gabor_responses(levels, count, CONTEXT_FRAMES, made.places, made.weights)


def respond_by_scipy(levels: FloatArray, count: int, made: Patterns) -> FloatArray:
    """As `filter_responses`."""
    matrix = _matrix(levels.shape[1])
    result = np.empty((2, len(made.places), count))
    for ear in range(2):  # not a dense product: OpenBLAS would start threads for it, see `FrameGrid.means`
        frames = sliding_window_view(levels[ear], 2 * CONTEXT_FRAMES + 1, axis=-1)[:, :count]  # (C, F, 39)
        result[ear] = matrix @ frames.swapaxes(1, 2).reshape(-1, count)
    return result


@functools.lru_cache(maxsize=4)
def _matrix(channels: int) -> Any:
    """The weights as a sparse matrix (G, C * 39)."""
    made = patterns(channels)
    columns = [
        (
            (first + np.arange(number))[:, np.newaxis] * (2 * CONTEXT_FRAMES + 1)
            + CONTEXT_FRAMES
            + np.arange(-reach, reach + 1)
        ).ravel()
        for first, number, reach, _ in made.places.tolist()
    ]
    begins = np.append(made.places[:, 3], len(made.weights))
    shape = (len(made.places), channels * (2 * CONTEXT_FRAMES + 1))
    return scipy.sparse.csr_matrix((made.weights, np.concatenate([np.empty(0, int), *columns]), begins), shape)


class RunningZScore:
    """How many standard deviations each value of some rows is above the mean of the last ones, itself included.

    The values are in stretches as long as the window. A window is the end of one stretch and the beginning of the next:
    means and squares of all ends are made when a stretch is complete, those of the beginning as it goes. Each value is
    added once to either, and none is ever subtracted again, so that nothing drifts. (B. P. Welford (1962),
    Technometrics 4, 419-420; T. F. Chan, G. H. Golub and R. J. LeVeque (1983), Am. Stat. 37, 242-247: two sets
    together)

    Parameters
    ----------
    length : int
        Of the window, in values of each row.
    values : ndarray (n, R)
        Of R rows that have come already, of which the last `length` count.
    """

    _mean: FloatArray  # (R,), of what has come of this stretch
    _squares: FloatArray  # of the deviations from it, summed

    def __init__(self, length: int, values: FloatArray) -> None:
        rows = values.shape[1]
        self.length = length
        self._values = np.empty((length, rows))  # up to _here of this stretch, then of the one before it
        self._ends = np.empty(
            (2, length, rows)
        )  # mean and sum of squared deviations of the stretch before, from each on
        self._before = min(length, len(values))  # how many values at the end of that stretch there are
        self._values[length - self._before :] = values[len(values) - self._before :]
        self._begin()

    def resized(self, length: int) -> RunningZScore:
        """The same with another window."""
        rest = self._values[max(self._here, self.length - self._before) :]
        return RunningZScore(length, np.concatenate((rest, self._values[: self._here])))

    def process(self, values: FloatArray) -> FloatArray:
        """The deviations (n, R) of the next values (n, R); 0 where the standard deviation is next to nothing."""
        result = np.zeros(values.shape)
        for value, deviation in zip(values, result, strict=True):
            if self._here == self.length:
                self._before = self.length
                self._begin()
            self._values[self._here] = value
            self._here += 1
            self._mean, self._squares = _added(self._mean, self._squares, value, self._here)
            mean, squares, count = self._mean, self._squares, self._here
            if older := min(self._before, self.length - self._here):
                end_mean, end_squares = self._ends[:, self.length - older]
                count, difference = self._here + older, end_mean - mean
                mean = mean + difference * (older / count)
                squares = squares + end_squares + np.square(difference) * (self._here * older / count)
            sigma = np.sqrt(squares / count)
            np.divide(value - mean, sigma, out=deviation, where=sigma > MIN_RELATIVE_DEVIATION * (1 + np.abs(mean)))
        return result

    def _begin(self) -> None:
        """A stretch is complete, and another one begins."""
        mean = squares = np.zeros(self._values.shape[1])
        for count in range(1, self._before + 1):
            mean, squares = _added(mean, squares, self._values[-count], count)
            self._ends[:, -count] = mean, squares
        self._here = 0
        self._mean = self._squares = np.zeros(self._values.shape[1])


def _added(mean: FloatArray, squares: FloatArray, value: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Mean and sum of squared deviations with one more value, the `count`-th."""
    difference = value - mean
    mean = mean + difference / count
    return mean, squares + difference * (value - mean)
