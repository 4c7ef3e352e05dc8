"""The Gabor features stage: correlation of the level with many spectro-temporal patterns."""

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
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Derived, Representation
from rosafe.dsp import kernels
from rosafe.dsp.framing import FrameBuffer
from rosafe.dsp.numeric_limits import EPSILON, FloatArray, modulus
from rosafe.dsp.rounding import round_half_away
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage

NORMALISATION_SECONDS = 5.0  # levels and features are normalised over this time
CONTEXT_FRAMES = 19  # frames before and after a frame that affect its features
WAVES = 3.5  # half periods within a filter
LENGTH = 40  # frames of the longest filter
TIME_STEP, CHANNEL_STEP = 0.2, 0.3  # spacing of the modulation frequencies of the filters
MAX_FREQUENCY = math.pi / 2  # highest modulation frequency, rad per frame or channel
MIN_RELATIVE_DEVIATION = 1e-9  # relative to 1 + |mean|; features with a lower standard deviation are 0


class GaborState:
    """The data of past frames that later frames need.

    Attributes
    ----------
    levels : FrameBuffer
        S of the last 2 * 19 frames, (2, C, n), initially with 19 copies of the first.
    maxima : FrameBuffer
        The largest rate of each frame of the last 5 s, (2, n).
    deviations : RunningZScore
        The normalisation of the features.
    channels : int
        The number of channels; -1 before the first block.
    """

    def __init__(self) -> None:
        self.begin(-1, 0)

    def begin(self, channels: int, features: int) -> None:
        """Reset for this number of channels, and of features of all ears."""
        self.levels, self.maxima = FrameBuffer(), FrameBuffer()
        self.deviations = RunningZScore(1, np.empty((0, features)))
        self.channels = channels


class Gabor(Stage):
    """Spectro-temporal modulation of the level in both ears, (2, C, F) to (2, G, F - 19), normalised by the last 5 s.

    1. Filters: products of a modulation along time and one along the channels, g = e exp(i (w n + k c)); `filters`.
    2. Weights W of `patterns`: the real parts of the filters around some channels each, which depend on the number of
       channels alone and give G features, `gb_nFeatures`.
    3. S = 10 log10(R + 10**(-gb_maxDynamicRangeDB / 10) Rmax + eps), Rmax being the largest rate of all channels in
       the last 5 s; negative rates count as 0.
    4. y[k] = sum over channels and u = -19...19 of W[c, u] S[c, k - u], with copies of the first frame before it. The
       output is therefore 19 frames late.
    5. z[k] = (y[k] - mean) / sigma over the y of the last 5 s, 0 if sigma <= 1e-9 (1 + abs(mean)).

    A change of the channels resets the state; any other change keeps it.
    """

    REPRESENTATION = Representation(
        kind="gabor",
        doc="Gabor features of spectro-temporal modulation",
        parent="ratemap",
        axes=("ear", "feature", "time"),
        parameters=(
            Parameter.positive(
                "gb_maxDynamicRangeDB",
                80.0,
                "Dynamic range (dB): levels below the maximum minus this value are raised to it",
                1000.0,
                unit="dB",
            ),
        ),
        derived=(Derived("gb_nFeatures", "unsigned long", "Number of features"),),
        port_doc="Gabor features",
        references=(
            cite("schadler2012"),
            cite("qiu2003", "receptive fields as Gabor functions"),
        ),
    )

    def __init__(self, input_format: SignalFormat | float, **parameters: Any) -> None:
        self._state = GaborState()
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
        # features of the last 5 s, their sums and sums of squares; levels, in an array of up to twice their size
        return 3 * self._remembered * 2 * features + weights + 4 * 2 * CONTEXT_FRAMES * math.prod(rows)

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        rates = np.maximum(self._as_valid_block(block), 0.0)
        state, bank = self._state, patterns(rates.shape[1])
        if rates.shape[1] != state.channels:
            state.begin(rates.shape[1], len(rates) * len(bank.places))
        if rates.size == 0:
            return np.empty((len(rates), len(bank.places), 0))
        levels = self._levels(rates)
        if state.levels.held == 0:
            levels = np.concatenate((np.repeat(levels[..., :1], CONTEXT_FRAMES, axis=-1), levels), axis=-1)
        levels = state.levels.append(levels)
        count = max(0, levels.shape[-1] - 2 * CONTEXT_FRAMES)
        features = filter_responses(levels, count, bank)
        state.levels.drop(count)
        if state.deviations.length != self._remembered:
            state.deviations = state.deviations.resized(self._remembered)
        deviations = state.deviations.process(features.reshape(len(rates) * len(bank.places), count).T)
        return np.ascontiguousarray(deviations.T).reshape(features.shape)

    def _levels(self, rates: FloatArray) -> FloatArray:
        """Compute S (2, C, F) of rates >= 0."""
        maxima = self._state.maxima.append(rates.max(axis=1))
        held, count = maxima.shape[-1], rates.shape[-1]
        largest = np.empty((len(rates), 1, count))
        for frame, end in enumerate(range(held - count + 1, held + 1)):
            maxima[:, max(0, end - self._remembered) : end].max(axis=1, keepdims=True, out=largest[..., frame])
        self._state.maxima.drop(max(0, held - (self._remembered - 1)))
        levels: FloatArray = np.log10(rates + (self._floor * largest + EPSILON))
        return np.multiply(levels, 10.0, out=levels)

    def reset(self) -> None:
        self._state = GaborState()

    def input_format_changed(self, before: SignalFormat) -> None:
        if self.input_format.center_frequencies != before.center_frequencies:
            self._state = GaborState()
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
        The first channel, the number of channels, the number of frames on either side, and the offset of the weights.
    weights : ndarray
        The weights of all features in succession, each (channels, frames) with the earliest frame first.
    """

    places: NDArray[np.int64]
    weights: FloatArray


class Count(NamedTuple):
    """The number of features and weights of `patterns`."""

    features: int
    weights: int


@functools.lru_cache(maxsize=16)
def count_features(channels: int) -> Count:
    """Count the features and weights for this number of channels without creating them."""
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
    """Create the features for this number of channels.

    A filter of K channels is placed on every max(1, K // 4)-th channel, counted from the middle one, and truncated at
    the first and the last channel. If a filter has negative real parts, its mean is removed in proportion to its
    magnitude m: W - m sum(W) / sum(m).
    """
    places, weights, begin = [], [np.empty(0)], 0
    for g in filters(channels):
        half, reach = g.shape[0] // 2, g.shape[1] // 2
        step = max(1, g.shape[0] // 4)
        mirrored = g[::-1, ::-1]  # channel c', frame k - u: the order in memory
        for channel in range(channels // 2 % step, channels, step):
            first, stop = max(0, channel - half), min(channels, channel + half + 1)
            cut = mirrored[first - channel + half : stop - channel + half]
            weight, size = cut.real, modulus(cut)
            if (g.real < 0).any():
                weight = weight - size * (weight.sum() / size.sum())
            places.append((first, stop - first, reach, begin))
            weights.append(weight.ravel())
            begin += weight.size
    return Patterns(np.array(places, np.int64).reshape(-1, 4), np.concatenate(weights))


def filters(channels: int) -> Iterator[NDArray[np.complex128]]:
    """Yield all filters (channels, frames), both odd, ordered by frequency along time, then along the channels."""
    return (_filter(time, channel) for time, channel in extents(channels))


def extents(channels: int) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
    """Yield the length and the frequency of each filter along time, and along the channels."""
    if channels == 0:
        return
    along = frequencies(3 * channels, CHANNEL_STEP)
    for omega in (0.0, *reversed(frequencies(LENGTH, TIME_STEP))):
        for kappa in (*(-f for f in along), 0.0, *reversed(along)):
            if omega > 0 or kappa >= 0:
                yield _extent(omega, LENGTH), _extent(kappa, 3 * channels)


def frequencies(longest: int, step: float) -> list[float]:
    """Return the frequencies along an axis on which filters have at most length `longest`, in descending order."""
    width = 8 * step / WAVES
    found = [MAX_FREQUENCY]
    while (lower := found[-1] * (1 - width / 2) / (1 + width / 2)) > WAVES * math.pi / longest:
        found.append(lower)
    return found


def _extent(frequency: float, longest: int) -> tuple[float, float]:
    """Return the length and the frequency of a filter along an axis; frequency 0 if it would be too long."""
    length = WAVES * math.pi / abs(frequency) if frequency else math.inf
    return (longest, 0.0) if length > longest else (length, frequency)


def _filter(time: tuple[float, float], channel: tuple[float, float]) -> NDArray[np.complex128]:
    """Return a wave with a Hann envelope, zero mean and a maximum gain of 1."""
    envelopes, phases = [], []
    for length, frequency in (channel, time):
        half = math.ceil(length / 2) - 1
        place = np.arange(-half, half + 1)
        envelopes.append(0.5 + 0.5 * np.cos(2 * np.pi * place / length))
        phases.append(frequency * place)
    envelope = np.outer(*envelopes)
    g: NDArray[np.complex128] = envelope * np.exp(1j * np.add.outer(*phases))
    g = g - envelope * (g.mean() / envelope.mean()) if time[1] or channel[1] else g * (1 + 1j)
    return g / modulus(scipy.fft.fft2(g)).max()


# --- features of frames -----------------------------------------------------------------------------------------


def filter_responses(levels: FloatArray, count: int, bank: Patterns) -> FloatArray:
    """Compute the features (2, G, count) of levels (2, C, count + 38)."""
    if count == 0:
        return np.empty((len(levels), len(bank.places), 0))
    if not kernels.compiled():
        return respond_by_scipy(levels, count, bank)
    return kernels.gabor_responses(levels, count, CONTEXT_FRAMES, bank.places, bank.weights)


def respond_by_scipy(levels: FloatArray, count: int, bank: Patterns) -> FloatArray:
    """Compute `filter_responses` without kernels."""
    matrix = _matrix(levels.shape[1])
    result = np.empty((len(levels), len(bank.places), count))
    for ear in range(len(levels)):  # sparse: OpenBLAS would start threads for a dense product, see `FrameGrid.means`
        frames = sliding_window_view(levels[ear], 2 * CONTEXT_FRAMES + 1, axis=-1)[:, :count]  # (C, F, 39)
        result[ear] = matrix @ frames.swapaxes(1, 2).reshape(-1, count)
    return result


@functools.lru_cache(maxsize=4)
def _matrix(channels: int) -> Any:
    """Return the weights as a sparse matrix (G, C * 39)."""
    bank = patterns(channels)
    columns = [
        (
            (first + np.arange(number))[:, np.newaxis] * (2 * CONTEXT_FRAMES + 1)
            + CONTEXT_FRAMES
            + np.arange(-reach, reach + 1)
        ).ravel()
        for first, number, reach, _ in bank.places.tolist()
    ]
    begins = np.append(bank.places[:, 3], len(bank.weights))
    shape = (len(bank.places), channels * (2 * CONTEXT_FRAMES + 1))
    return scipy.sparse.csr_matrix((bank.weights, np.concatenate([np.empty(0, int), *columns]), begins), shape)


class RunningZScore:
    """The deviation of each value from the mean of a sliding window that ends with it, in standard deviations.

    The values are divided into segments as long as the window. A window is the end of one segment and the beginning of
    the next. Means and sums of squares of all ends are computed when a segment is complete, those of the beginning are
    updated with each value. Values are only added, never subtracted, so that rounding errors do not accumulate.
    (B. P. Welford (1962), Technometrics 4, 419-420; T. F. Chan, G. H. Golub and R. J. LeVeque (1983), Am. Stat. 37,
    242-247: combination of two sets)

    Parameters
    ----------
    length : int
        Length of the window, in values of each row.
    values : ndarray (n, R)
        Previous values of R rows, of which the last `length` are used.
    """

    _mean: FloatArray  # (R,), of the current segment
    _squares: FloatArray  # sum of squared deviations from it

    def __init__(self, length: int, values: FloatArray) -> None:
        rows = values.shape[1]
        self.length = length
        self._values = np.empty((length, rows))  # up to _position of this segment, then of the previous one
        # mean and sum of squared deviations from each value of the previous segment to its end
        self._ends = np.empty((2, length, rows))
        self._before = min(length, len(values))  # number of values at the end of the previous segment
        self._values[length - self._before :] = values[len(values) - self._before :]
        self._begin()

    def resized(self, length: int) -> RunningZScore:
        """Return a copy with another window length."""
        rest = self._values[max(self._position, self.length - self._before) :]
        return RunningZScore(length, np.concatenate((rest, self._values[: self._position])))

    def process(self, values: FloatArray) -> FloatArray:
        """Compute the deviations (n, R) of the next values (n, R); 0 if the standard deviation is almost 0."""
        result = np.zeros(values.shape)
        for value, deviation in zip(values, result, strict=True):
            if self._position == self.length:
                self._before = self.length
                self._begin()
            self._values[self._position] = value
            self._position += 1
            self._mean, self._squares = _added(self._mean, self._squares, value, self._position)
            mean, squares, count = self._mean, self._squares, self._position
            if older := min(self._before, self.length - self._position):
                end_mean, end_squares = self._ends[:, self.length - older]
                count, difference = self._position + older, end_mean - mean
                mean = mean + difference * (older / count)
                squares = squares + end_squares + np.square(difference) * (self._position * older / count)
            sigma = np.sqrt(squares / count)
            np.divide(value - mean, sigma, out=deviation, where=sigma > MIN_RELATIVE_DEVIATION * (1 + np.abs(mean)))
        return result

    def _begin(self) -> None:
        """Start a segment after the previous one is complete."""
        mean = squares = np.zeros(self._values.shape[1])
        for count in range(1, self._before + 1):
            mean, squares = _added(mean, squares, self._values[-count], count)
            self._ends[:, -count] = mean, squares
        self._position = 0
        self._mean = self._squares = np.zeros(self._values.shape[1])


def _added(mean: FloatArray, squares: FloatArray, value: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the mean and the sum of squared deviations after adding the `count`-th value."""
    difference = value - mean
    mean = mean + difference / count
    return mean, squares + difference * (value - mean)
