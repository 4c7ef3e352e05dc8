"""The inner loops as compiled kernels. Each has an equivalent in numpy and scipy, next to the stage that uses it.

A stage calls its kernel if `compiled()` is True, otherwise the equivalent: without a compiler, on other processors, and
if the environment variable ROSAFE_KERNELS is 0. Both use the same states and agree to 1e-11 of the largest number.
Tests compare each kernel with its equivalent, which is the reference. Kernels release the GIL.

All arrays are of float64 or complex128 (those of a mixture and tables of evidence of float32), and C-contiguous unless
stated otherwise.
"""

from __future__ import annotations

import ctypes
import functools
import math
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rosafe.dsp import buffer_pool

from .loader import CUES, FRAMES, Status, loaded

FloatArray = NDArray[np.float64]

MAX_POLES = 128  # of a gammatone filter
MAX_SECTIONS = 8  # of a low-pass
MAX_LAGS = 1024  # of a correlation; FFT is faster beyond
MAX_LOOPS = 32  # of adaptation
MAX_SIZE = 4096  # samples of a frame for autocorrelation
MAX_POINTS = 8192  # real points of a Fourier transform
TAPS = 6  # of a filter that removes an echo
INTERLEAVED_ROWS = 8  # rows that are interleaved in memory

REAL_SIZE = 8  # bytes of a float64
_pack = struct.Struct(FRAMES).pack
_pack_cues = struct.Struct(CUES).pack
DIRECTIONS = 72  # of a mixture and of evidence
MAX_LANES = 8  # float64 in a register

CLIPPINGS = ("clp", "clc", "sgn")
RECTIFICATIONS = ("none", "halfwave", "fullwave", "square", "compressed")


def compiled() -> bool:
    """Return whether kernels are available. The first call loads them, and builds them if necessary."""
    return loaded()[1].compiled


def status() -> Status:
    """Return the implementation in use, and the reason."""
    return loaded()[1]


def gammatone(
    block: FloatArray,
    sections: NDArray[np.complex128],
    state: NDArray[np.complex128],
    position: int,
    output: FloatArray,
    envelope: FloatArray | None,
) -> None:
    """Apply gammatone filters, as `rosafe.dsp.gammatone.filter_by_scipy`. `output` has evenly strided rows."""
    sizes = (*block.shape, *sections.shape[:2])
    _call("rosafe_gammatone", block, *sizes, sections, state, position, *_rows(output), envelope)


def rectify_and_filter(
    rectification: str,
    block: FloatArray,
    envelope: FloatArray | None,
    sections: FloatArray,
    state: FloatArray,
    output: FloatArray,
) -> None:
    """Rectify (*rows, N), then filter it by second-order sections (S, 6); `state` (S, *rows, 2) as in scipy.

    The envelope of the same shape is needed for `compressed`. `output` has evenly strided rows, or is `block`. The
    equivalent is `RECTIFIERS` or `compressed` of rosafe/representations/haircell.py with
    `rosafe.dsp.sos_filter.SosFilter`.
    """
    kind, rows = RECTIFICATIONS.index(rectification), math.prod(block.shape[:-1])
    filters = (sections, len(sections), state)
    _call("rosafe_biquads", kind, block, envelope, rows, block.shape[-1], *filters, *_rows(output))


def adaptation(
    block: FloatArray,
    factor: float,
    thresholds: FloatArray,
    offsets: FloatArray,
    gains: FloatArray,
    decay_factors: FloatArray,
    limits: FloatArray,
    state: FloatArray,
) -> FloatArray:
    """Apply adaptation loops with `state` (n, *rows), as `rosafe.representations.adaptation.adapt`.

    The other arguments are attributes of `Loops` in that module.
    """
    output = buffer_pool.empty(block.shape)
    constants = np.stack((thresholds, offsets, gains), axis=1)
    loops = np.stack((decay_factors, 1 - decay_factors, limits), axis=1)
    sizes = math.prod(block.shape[:-1]), block.shape[-1]
    tables = (constants, len(constants), loops, len(loops))
    _call("rosafe_adaptation", block, *sizes, factor, *tables, bool(limits.any()), state, output)
    return output


class PinnedArray(NamedTuple):
    """An array that is not moved, with its address, whose lookup takes longer than many operations on the array."""

    array: FloatArray
    address: int

    @classmethod
    def of(cls, array: FloatArray) -> PinnedArray:
        """Return `array`, which must not be resized, with its address."""
        return cls(array, _address(array))

    def __reduce__(self) -> tuple[Any, ...]:
        return PinnedArray.of, (self.array,)  # the array of a copy has another address


class SampleRange(NamedTuple):
    """Samples `start` to `stop` of each row of an array (*rows, T)."""

    store: PinnedArray
    start: int
    stop: int

    @property
    def length(self) -> int:
        """The number of samples of each row."""
        return self.stop - self.start

    @property
    def samples(self) -> FloatArray:
        """A view of the samples, (*rows, length)."""
        return self.store.array[..., self.start : self.stop]


class FrameReader(NamedTuple):
    """Frames over a history followed by a block, which are not copied into one array.

    Samples are counted from the first one of the history.
    """

    history: SampleRange
    block: FloatArray  # (*rows, N)
    tail: SampleRange  # destination of the last samples; may overlap the history
    skip: int  # start of the first frame
    weights: PinnedArray  # (w,), of the samples of a frame
    hop: int  # samples between the starts of two frames
    number: int  # of complete frames
    position: int  # of the first sample since the start of the signal

    def part(self, first: int, number: int) -> FrameReader:
        """Return some of the frames, for a kernel that does not write the tail."""
        return self._replace(skip=self.skip + first * self.hop, number=number)

    @property
    def packed(self) -> bytes:
        """The argument `framed` of kernels, see framed.h. It contains addresses of arrays, which must be kept."""
        (history, start, stop), block, (tail, tail_start, tail_stop), skip, weights, hop, number, position = self
        held, shape = stop - start, block.shape
        arriving = shape[-1]
        return _pack(
            history.address + start * REAL_SIZE,
            history.array.shape[-1],
            held,
            _address(block),
            arriving,
            tail.address + tail_start * REAL_SIZE,
            tail.array.shape[-1],
            held + arriving - (tail_stop - tail_start),
            math.prod(shape[:-1]),
            skip,
            weights.address,
            len(weights.array),
            hop,
            number,
            position,
        )

    def save_tail(self) -> None:
        """Write the tail, after kernels that do not."""
        length = self.tail.length
        self.tail.samples[...] = self.block[..., self.block.shape[-1] - length :]


def level_differences(frames: FrameReader, epsilon: float) -> FloatArray:
    """Return 10 log10((R + epsilon) / (L + epsilon)) of the energies of both ears in each frame, (2, C, N) to (C, F).

    Energies are weighted sums of squares. The equivalent is `rosafe.dsp.framing.FrameGrid.means` with
    `rosafe.representations.ild.Ild`.
    """
    channels = frames.block.shape[1]
    result, energies = np.empty((channels, frames.number)), np.empty((2 * channels, frames.number))
    _call("rosafe_level_differences", frames.packed, epsilon, energies, result)
    return result


def ratemap(frames: FrameReader, squared: bool, section: FloatArray, state: FloatArray) -> FloatArray:
    """Return weighted sums of the integrated samples of each frame, or of their squares, (*rows, F).

    The integrator is `section` (1, 6), from `rosafe.dsp.sos_filter.leaky_integrator`, with its `state` (1, *rows, 2).
    The history of `frames` is integrated already, the block is not. The equivalent is
    `rosafe.dsp.framing.FrameGrid.means` after `rosafe.dsp.sos_filter.SosFilter`.
    """
    rates = np.empty((*frames.block.shape[:-1], frames.number))
    _call("rosafe_ratemap", frames.packed, squared, -section[0, 4], state, rates)
    return rates


def modulation(frames: FrameReader, sections: FloatArray, state: FloatArray) -> FloatArray:
    """Return weighted sums of the magnitudes of samples (*rows, N) filtered by parallel sections (M, 6), (*rows, M, F).

    The state of the sections is (M, *rows, 2). The history of `frames` is (*rows, M) and filtered already, the block is
    not. The equivalent is `rosafe.dsp.framing.FrameGrid.means` of the magnitudes after
    `rosafe.dsp.sos_filter.SosFilterBank`.
    """
    means = np.empty((*frames.tail.store.array.shape[:-1], frames.number))
    _call("rosafe_modulation", frames.packed, len(sections), sections, state, means)
    return means


def correlations(frames: FrameReader, reach: int, epsilon: float, output: FloatArray) -> None:
    """Correlate the frames (2, C) of both ears over lags up to `reach`, into the middle of `output` (C, L, F).

    2 reach + 1 is at most `MAX_LAGS`. The equivalent is `rosafe.representations.crosscorrelation.correlate_by_fft`.
    """
    _, lags, number = output.shape
    middle = _address(output) + (lags // 2 - reach) * number * output.itemsize
    _call("rosafe_correlations", frames.packed, reach, epsilon, middle, lags * number)


def spectral_features(
    spectra: FloatArray, last: FloatArray, frequencies: FloatArray, bright: float, part: float, features: FloatArray
) -> None:
    """Compute all features of spectra (2, C, F), after the spectrum `last` (2, C), into `features` (2, 14, F).

    The equivalent is `FEATURES` of rosafe/representations/spectralfeatures.py.
    """
    work = np.empty((4, spectra.shape[1]))
    _call("rosafe_spectral_features", spectra, last, *spectra.shape, frequencies, bright, part, work, features)


def transient_map(
    strengths: FloatArray,
    levels: FloatArray,
    first: int,
    reach: int,
    thresholds: tuple[float, float],
    fuse: int,
    spread: int,
    output: FloatArray,
) -> None:
    """Compute the frames of a map from `first` on, `output` (2, C, F), of strengths and levels (2, C, n).

    Each depends on the frames up to `reach` frames from it; n is at least first + F + reach. `thresholds` are the
    minimum strength and the minimum level; a `fuse` of 0 keeps all peaks. The equivalent is `columns` of
    rosafe/representations/onset_offset_maps.py.
    """
    ears, channels, count = output.shape
    at_once = max(1, min(count, 2 * reach))  # frames that share a search for peaks
    capacity = at_once // 2 + reach + 1
    buffers = (
        np.empty((channels, capacity, 4)),
        np.empty(channels, np.int64),
        np.empty(2 * reach // fuse + 3 if fuse else 0, np.int64),
        np.zeros((2, channels, 2 * spread - 1), np.int64),
        np.empty(spread, np.int64),
    )
    peaks, *others = buffers
    sizes = (strengths.strides[1] // REAL_SIZE, ears * channels, channels, first, count, reach, at_once)
    rules = (*thresholds, fuse, spread)
    _call("rosafe_transient_map", strengths, levels, *sizes, *rules, peaks, capacity, *others, output)


def autocorrelations(
    frames: FrameReader, clipping: str, alpha: float, exponent: float, corrections: FloatArray
) -> FloatArray:
    """Return normalised autocorrelations of centre-clipped frames at the lags of `corrections` (L,), (*rows, L, F).

    A frame has an even number of samples, at most `MAX_SIZE`. The equivalent is
    `rosafe.representations.autocorrelation.autocorrelate`.
    """
    rows = frames.block.shape[:-1]
    output = buffer_pool.empty((*rows, len(corrections), frames.number))
    transform = Transform.of(2 * len(frames.weights.array) - 1)
    clipped = (CLIPPINGS.index(clipping), alpha, exponent / 2)
    _call("rosafe_autocorrelations", frames.packed, *clipped, *transform, corrections, len(corrections), output)
    return output


class Transform(NamedTuple):
    """Tables for the FFT of N real numbers as N / 2 complex ones, with radix 4, and 2 in the last step if necessary.

    Attributes
    ----------
    points : int
        N / 2.
    twiddles : ndarray, complex
        exp(-2 pi i j k / n), (n / 4, 3) for j from 1 to 3, for n = N / 2 points, then for n / 4...
    places : ndarray (N / 4 + 1, 2) of int64
        Positions of the points k and N / 2 - k in the output.
    turns : ndarray (N / 4 + 1,), complex
        exp(2 pi i k / N).
    """

    points: int
    twiddles: NDArray[np.complex128]
    places: NDArray[np.int64]
    turns: NDArray[np.complex128]

    @classmethod
    @functools.lru_cache(8)
    def of(cls, samples: int) -> Transform:
        """Return the tables for this number of samples, zero-padded to at least 3: N is the next power of 2."""
        points = 1 << (samples - 1).bit_length() - 1
        twiddles, index, place, n = [np.empty((0, 3))], np.arange(points), np.zeros(points, np.int64), points
        while n >= 4:
            twiddles.append(np.exp(-2j * np.pi / n * np.arange(n // 4)[:, np.newaxis] * (1, 2, 3)))
            place += index % 4 * (n // 4)
            index //= 4
            n //= 4
        place += index
        k = np.arange(points // 2 + 1)
        places = np.ascontiguousarray(np.stack((place[k], place[-k % points]), axis=1))
        return cls(points, np.concatenate(twiddles), places, np.exp(1j * np.pi / points * k))


def gabor_responses(
    levels: FloatArray, count: int, reach: int, places: NDArray[np.int64], weights: FloatArray
) -> FloatArray:
    """Compute the same as `rosafe.representations.gabor.respond_by_scipy`."""
    ears, channels, length = levels.shape
    frames = -(-count // MAX_LANES) * MAX_LANES
    padded = np.zeros((ears, channels, frames + 2 * reach))
    padded[:, :, :length] = levels
    sums = np.empty((ears, len(places), frames))
    _call("rosafe_gabor_responses", padded, ears, channels, frames, reach, places, len(places), weights, sums)
    return sums[:, :, :count]


def concatenate(blocks: Sequence[FloatArray], whole: FloatArray) -> None:
    """Concatenate blocks (*rows, N) into `whole`, as `numpy.concatenate`, which takes many times longer for small N.

    numpy is used without kernels and for other types than float64.
    """
    fits = whole.ndim > 1 and rows_evenly_strided(whole) and all(block.dtype == whole.dtype for block in blocks)
    if not fits or not compiled():
        np.concatenate(blocks, axis=-1, out=whole)
        return
    held = [np.ascontiguousarray(block) for block in blocks]
    table = np.array([[_address(block) for block in held], [block.shape[-1] for block in held]], np.int64)
    _call("rosafe_concatenate", len(held), *table, math.prod(whole.shape[:-1]), *_rows(whole))


def mixture(likelihood: NDArray[np.float32], iterations: int, weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute the same as `rosafe.localization.mixture.fit_by_numpy`, for `DIRECTIONS` directions."""
    inverse = np.empty(len(likelihood), np.float32)
    likelihood = np.ascontiguousarray(likelihood)
    _call("rosafe_mixture", len(likelihood), likelihood, iterations, weights, inverse)
    return inverse


class EvidenceTables(NamedTuple):
    """Look-up of cues, as `rosafe.localization.direction_model.DirectionModel` with its tables of `DIRECTIONS` columns.

    `late_itd`, `late_ild` (rows,) are those of reverberation. `itd_bins`, `ild_bins` rows of the tables belong to each
    of `classes` of levels, which are `step` dB apart.
    """

    itd: NDArray[np.float32]
    ild: NDArray[np.float32]
    late_itd: NDArray[np.float32]
    late_ild: NDArray[np.float32]
    itd_bins: int
    ild_bins: int
    classes: int
    step: float

    def _packed(self, cues: Sequence[NDArray[Any]], floor: FloatArray) -> bytes:
        """Return the argument `cues` of kernels: see `Cues` of rosafe/localization/cues.py; the floor is (C,)."""
        itd_row, ild_row, level, valid = cues
        arrays = map(_address, (itd_row, ild_row, level, valid, floor, *self[:4]))
        return _pack_cues(len(floor), *arrays, *self[4:7])

    def add(
        self,
        sums: FloatArray,
        cues: Sequence[NDArray[Any]],
        floor: FloatArray,
        frames: NDArray[np.int64],
        channels: NDArray[np.bool_],
        factor: float,
    ) -> None:
        """Add the evidence of frames (n,) for some channels (C,), times `factor`, to `sums` (C, A)."""
        packed = self._packed(cues, floor)
        _call("rosafe_add_evidence", packed, self.step, frames, len(frames), channels, factor, sums)

    def units(
        self,
        cues: Sequence[NDArray[Any]],
        floor: FloatArray,
        frames: NDArray[np.int64],
        number: int,
        factors: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Return the evidence (number, A) of each channel with cues of frames (n,), relative to reverberation.

        `factors` (2, C, K) are those of ITD and ILD in the classes of coherence of each channel.
        """
        evidence = np.empty((number, DIRECTIONS), np.float32)
        packed = self._packed(cues, floor)
        _call("rosafe_unit_evidence", packed, self.step, frames, len(frames), factors, factors[0].size, evidence)
        return evidence


# --- precedence: windowed frames, summed spectra, correlations of filtered frames ----------------------------------


class Windowed(NamedTuple):
    """Windowed frames of both ears with their sums, peaks and energies."""

    samples: FloatArray  # (F, 2, C, w)
    sums: FloatArray  # over channels, (F, 2, w)
    peaks: FloatArray  # the largest sample of each frame, (F, 2, C)
    energies: FloatArray  # the sum of squares of each frame, (F, 2, C)

    @classmethod
    def allocate(cls, frames: int, channels: int, size: int) -> Windowed:
        """Return uninitialised arrays."""
        each = (frames, 2, channels)
        return cls(np.empty((*each, size)), np.empty((frames, 2, size)), np.empty(each), np.empty(each))

    def first(self, frames: int) -> Windowed:
        """Return a view of the first frames."""
        return Windowed(*(array[:frames] for array in self))


class Taps(NamedTuple):
    """Filters y[t] = sum_i values[i] x[t - shifts[i]]; y starts with x and is shifts[-1] samples longer."""

    shifts: NDArray[np.int64]  # (..., TAPS), ascending
    values: FloatArray  # (..., TAPS)

    def of(self, *place: Any) -> Taps:
        """Return the filters at an index."""
        return Taps(self.shifts[place], self.values[place])


def windowed(frames: FrameReader, output: Windowed) -> None:
    """Write the frames of (2, C, N), multiplied by their weights, to `output`; the tail is not written.

    The equivalent is `rosafe.representations.precedence.windowed`.
    """
    _call("rosafe_windowed", frames.packed, *output)


def add_spectra(
    samples: FloatArray, points: int, gains: FloatArray, factors: FloatArray, power: FloatArray
) -> FloatArray:
    """Compute `rosafe.representations.precedence.add_spectra` with a power of 2 up to MAX_POINTS points; w is even."""
    count, ears, channels, size = samples.shape
    transform = Transform.of(points)
    sums, factors = np.empty((count, ears, power.shape[1])), np.ascontiguousarray(factors)
    sizes = (channels, count, size)
    _call("rosafe_add_spectra", samples, *sizes, gains, factors, *transform, power, sums)
    return sums


def correlate_filtered(
    left: FloatArray, left_taps: Taps, right: FloatArray, right_taps: Taps, reach: int
) -> tuple[FloatArray, FloatArray]:
    """Compute `rosafe.representations.precedence.correlate_filtered` for at most MAX_LAGS lags."""
    count, rows, size = left.shape
    correlations, energies = np.empty((count, rows, 2 * reach + 1)), np.empty((2, count, rows))
    longest = size + max(0, int(left_taps.shifts.max(initial=0)), int(right_taps.shifts.max(initial=0)))
    scratch = np.empty(2 * MAX_LANES * (size + reach) + 2 * longest)
    ears = [
        (ear, *(step // REAL_SIZE for step in ear.strides[:2]), *map(np.ascontiguousarray, taps))
        for ear, taps in ((left, left_taps), (right, right_taps))
    ]
    sizes = (count, rows, size, left_taps.shifts.shape[1] < rows, reach, longest)
    _call("rosafe_correlate_filtered", *ears[0], *ears[1], *sizes, scratch, correlations, energies)
    return correlations, energies


# --- calls ----------------------------------------------------------------------------------------------------------


@contextmanager
def denormals_off() -> Iterator[None]:
    """Make numpy and scipy treat denormal numbers as 0 on this thread, which is many times faster.

    Without kernels, it has no effect.
    """
    if not compiled():
        yield
        return
    before = _call("rosafe_denormals_off")
    try:
        yield
    finally:
        _call("rosafe_denormals_as", before)


def _call(name: str, *arguments: Any) -> Any:
    """Call a function of the library; it gets the addresses of arrays."""
    library = loaded()[0]
    if library is None:
        raise RuntimeError(f"kernels are not available: {status().detail}")
    return getattr(library, name)(*(_address(one) if isinstance(one, np.ndarray) else one for one in arguments))


_BUFFER = ctypes.c_char * 0


def _address(array: NDArray[Any]) -> int:
    try:  # five times as fast as the general way
        return ctypes.addressof(_BUFFER.from_buffer(array))  # type: ignore[arg-type]
    except TypeError:  # the array is read-only or not contiguous
        address: int = array.ctypes.data
        return address


def rows_evenly_strided(array: FloatArray) -> bool:
    """Return whether the rows of (*rows, N) are contiguous and evenly strided, as some kernels require."""
    strides, sizes = array.strides, array.shape
    even = all(strides[axis] == sizes[axis + 1] * strides[axis + 1] for axis in range(array.ndim - 2))
    return even and strides[-1] == REAL_SIZE


def _rows(array: FloatArray) -> tuple[int, int]:
    """Return the address of an array with evenly strided rows, and their distance."""
    return _address(array), array.strides[-2] // REAL_SIZE
