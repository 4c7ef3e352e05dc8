"""The hot loops as compiled kernels; each has a twin in numpy and scipy, with the stage that uses it.

A stage calls its kernel where `compiled()` says so, and the twin elsewhere: where there is no compiler, on other
processors, and where the environment variable ROSAFE_KERNELS is 0. Both work on the same states and agree to 1e-11 of
the largest number. Tests hold each kernel to its twin, which is the reference. Kernels release the interpreter lock.

All arrays are of float64 or complex128, and C-contiguous where nothing else is said.
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

from .loader import FRAMES, Status, loaded

FloatArray = NDArray[np.float64]

MAX_POLES = 128  # of a gammatone filter
MAX_SECTIONS = 8  # of a low-pass
MAX_LAGS = 1024  # of a correlation; FFT is faster beyond
MAX_LOOPS = 32  # of adaptation
MAX_SIZE = 4096  # samples of a frame whose autocorrelation is made
MAX_POINTS = 8192  # real ones of a Fourier transform

REAL_SIZE = 8  # bytes of a float64
_pack = struct.Struct(FRAMES).pack
MAX_LANES = 8  # float64 in a register

CLIPPINGS = ("clp", "clc", "sgn")
RECTIFICATIONS = ("none", "halfwave", "fullwave", "square", "compressed")


def compiled() -> bool:
    """Whether the kernels can be called. The first call loads them and, where that was never done, builds them."""
    return loaded()[1].compiled


def status() -> Status:
    """Which implementation runs, and why."""
    return loaded()[1]


def gammatone(
    block: FloatArray,
    sections: NDArray[np.complex128],
    state: NDArray[np.complex128],
    position: int,
    output: FloatArray,
    envelope: FloatArray | None,
) -> None:
    """Gammatone filters, as `rosafe.dsp.gammatone.filter_by_scipy`. `output` has evenly strided rows."""
    channels, order = sections.shape[:2]
    _function("rosafe_gammatone")(
        _address(block),
        block.shape[-1],
        channels,
        order,
        _address(sections),
        _address(state),
        position,
        *_rows(output),
        None if envelope is None else _address(envelope),
    )


def rectify_and_filter(
    rectification: str,
    block: FloatArray,
    envelope: FloatArray | None,
    sections: FloatArray,
    state: FloatArray,
    output: FloatArray,
) -> None:
    """Rectify (*rows, N), then filter it by second-order sections (S, 6); `state` (S, *rows, 2) as in scipy.

    The envelope of the same shape is for `compressed`. Rows of `output` may lie apart (`rows_evenly_strided`); or it is
    `block`. The twin is `RECTIFIERS` of rosafe/representations/haircell.py, or `compressed` there, and
    `rosafe.dsp.sos_filter.SosFilter`.
    """
    _function("rosafe_biquads")(
        RECTIFICATIONS.index(rectification),
        _address(block),
        None if envelope is None else _address(envelope),
        math.prod(block.shape[:-1]),
        block.shape[-1],
        _address(sections),
        len(sections),
        _address(state),
        *_rows(output),
    )


def adaptation(
    block: FloatArray,
    factor: float,
    thresholds: FloatArray,
    offsets: FloatArray,
    gains: FloatArray,
    retentions: FloatArray,
    limits: FloatArray,
    state: FloatArray,
) -> FloatArray:
    """Adaptation loops with their `state` (n, *rows): as `rosafe.representations.adaptation.adapt`.

    The other arguments are the attributes of `Loops` there.
    """
    output = buffer_pool.empty(block.shape)
    constants = np.stack((thresholds, offsets, gains), axis=1)
    loops = np.stack((retentions, 1 - retentions, limits), axis=1)
    _function("rosafe_adaptation")(
        _address(block),
        math.prod(block.shape[:-1]),
        block.shape[-1],
        factor,
        _address(constants),
        len(constants),
        _address(loops),
        len(loops),
        bool(limits.any()),
        _address(state),
        _address(output),
    )
    return output


class PinnedArray(NamedTuple):
    """An array that stays, and where: to look that up takes longer than much of what is done with it."""

    array: FloatArray
    address: int

    @classmethod
    def of(cls, array: FloatArray) -> PinnedArray:
        """`array`, which nobody resizes."""
        return cls(array, _address(array))


class SampleRange(NamedTuple):
    """Samples `start` to `stop` of each row of a store (*rows, T)."""

    store: PinnedArray
    start: int
    stop: int

    @property
    def length(self) -> int:
        """How many samples of each row."""
        return self.stop - self.start

    @property
    def samples(self) -> FloatArray:
        """A view of them, (*rows, length)."""
        return self.store.array[..., self.start : self.stop]


class FrameReader(NamedTuple):
    """Frames over samples that lie in a history and a block behind it, without the two being joined.

    Samples are counted from the first one of the history on.
    """

    history: SampleRange
    block: FloatArray  # (*rows, N)
    tail: SampleRange  # to be filled with the last samples; may lie where the history does
    skip: int  # where the first frame starts
    weights: PinnedArray  # (w,), of the samples of a frame
    hop: int  # from a frame's start to that of the next one
    number: int  # of whole ones
    position: int  # of the first sample, counted from where the signal began

    def part(self, first: int, number: int) -> FrameReader:
        """Some of them, for a kernel that leaves the tail alone."""
        return self._replace(skip=self.skip + first * self.hop, number=number)

    @property
    def packed(self) -> bytes:
        """`framed` of framed.h, which kernels take. It holds addresses: what they are of must stay meanwhile."""
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
        """Fill the tail, after such kernels."""
        length = self.tail.length
        self.tail.samples[...] = self.block[..., self.block.shape[-1] - length :]


def level_differences(frames: FrameReader, epsilon: float) -> FloatArray:
    """10 log10((R + epsilon) / (L + epsilon)) of the two ears' energies of each frame, (2, C, N) to (C, F).

    Energies are weighted sums of squares. The twin is `rosafe.dsp.framing.FrameGrid.means` with
    `rosafe.representations.ild.Ild`.
    """
    channels = frames.block.shape[1]
    result, energies = np.empty((channels, frames.number)), np.empty((2 * channels, frames.number))
    _function("rosafe_levels")(frames.packed, epsilon, _address(energies), _address(result))
    return result


def ratemap(frames: FrameReader, squared: bool, section: FloatArray, state: FloatArray) -> FloatArray:
    """Weighted sums of what a leaky integrator makes of each frame's samples, or of the squares of that, (*rows, F).

    The integrator is `section` (1, 6), as of `rosafe.dsp.sos_filter.leaky_integrator`, with its `state`
    (1, *rows, 2). The history
    of `frames` has been through it, the block goes now. The twin is `rosafe.dsp.framing.FrameGrid.means` after
    `rosafe.dsp.sos_filter.SosFilter`.
    """
    rates = np.empty((*frames.block.shape[:-1], frames.number))
    _function("rosafe_ratemap")(frames.packed, squared, -section[0, 4], _address(state), _address(rates))
    return rates


def modulation(frames: FrameReader, sections: FloatArray, state: FloatArray) -> FloatArray:
    """Weighted sums of the magnitudes of what parallel sections (M, 6) make of each frame's samples, (*rows, M, F).

    Of samples (*rows, N), with the sections' state (M, *rows, 2). The history of `frames` is (*rows, M), and what has
    come out already, the block goes in now. The twin is `rosafe.dsp.framing.FrameGrid.means` of the magnitudes of what
    `rosafe.dsp.sos_filter.SosFilterBank` makes.
    """
    means = np.empty((*frames.tail.store.array.shape[:-1], frames.number))
    _function("rosafe_modulation")(frames.packed, len(sections), *map(_address, (sections, state, means)))
    return means


def correlations(frames: FrameReader, reach: int, epsilon: float, output: FloatArray) -> None:
    """Correlate the frames (2, C) of the two ears over the lags up to `reach`, into the middle of `output` (C, L, F).

    2 reach + 1 is at most `MAX_LAGS`. The twin is `rosafe.representations.crosscorrelation.correlate_by_fft`.
    """
    _, lags, number = output.shape
    outside = lags // 2 - reach
    _function("rosafe_correlations")(
        frames.packed,
        reach,
        epsilon,
        _address(output) + outside * number * output.itemsize,
        lags * number,
    )


def spectral_features(
    spectra: FloatArray, last: FloatArray, frequencies: FloatArray, bright: float, part: float, features: FloatArray
) -> None:
    """All features of spectra (2, C, F), of which `last` (2, C) was the one before, into `features` (2, 14, F).

    The twin is `FEATURES` of rosafe/representations/spectralfeatures.py.
    """
    work = np.empty((4, spectra.shape[1]))
    arrays = map(_address, (work, features))
    _function("rosafe_spectral_features")(
        _address(spectra), _address(last), *spectra.shape, _address(frequencies), bright, part, *arrays
    )


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
    """The frames of a map from `first` on, `output` (2, C, F), of strengths and levels (2, C, n).

    Each is made from those that lie up to `reach` frames from it; n is at least first + F + reach. `thresholds` are the
    least strength and the least level. The twin is `columns` of
    rosafe/representations/onset_offset_maps.py, with a `fuse`
    of 0 where peaks are not fused.
    """
    ears, channels, count = output.shape
    at_once = max(1, min(count, 2 * reach))  # frames that share a search for peaks
    capacity = at_once // 2 + reach + 1
    room = (
        np.empty((channels, capacity, 4)),
        np.empty(channels, np.int64),
        np.empty(2 * reach // fuse + 3 if fuse else 0, np.int64),
        np.zeros((2, channels, 2 * spread - 1), np.int64),
        np.empty(spread, np.int64),
    )
    peaks, *others = map(_address, room)
    _function("rosafe_transient_map")(
        *(_address(strengths), _address(levels), strengths.strides[1] // REAL_SIZE, ears * channels, channels),
        *(first, count, reach, at_once, *thresholds, fuse, spread, peaks, capacity, *others, _address(output)),
    )


def autocorrelations(
    frames: FrameReader, clipping: str, alpha: float, exponent: float, corrections: FloatArray
) -> FloatArray:
    """Normalised autocorrelations of centre-clipped frames at the lags of `corrections` (L,), (*rows, L, F).

    A frame has an even number of samples up to `MAX_SIZE`. The twin is
    `rosafe.representations.autocorrelation.autocorrelate`.
    """
    rows = frames.block.shape[:-1]
    output = buffer_pool.empty((*rows, len(corrections), frames.number))
    transform = Transform.of(2 * len(frames.weights.array) - 1)
    _function("rosafe_autocorrelations")(
        frames.packed,
        CLIPPINGS.index(clipping),
        alpha,
        exponent / 2,
        transform.points,
        *map(_address, (transform.twiddles, transform.places, transform.turns, corrections)),
        len(corrections),
        _address(output),
    )
    return output


class Transform(NamedTuple):
    """Tables for the FFT of N real numbers as that of N / 2 complex ones, by radix 4 and last by 2 where need be.

    Attributes
    ----------
    points : int
        N / 2.
    twiddles : ndarray, complex
        exp(-2 pi i j k / n), (n / 4, 3) for j from 1 to 3, of n = N / 2 points, then of n / 4...
    places : ndarray (N / 4 + 1, 2) of int64
        Where the points k and N / 2 - k come out.
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
        """For so many samples and zeros behind, at least 3 together: N is the next power of 2."""
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
    """As `rosafe.representations.gabor.respond_by_scipy`."""
    frames = -(-count // MAX_LANES) * MAX_LANES
    padded = np.zeros((*levels.shape[:-1], frames + 2 * reach))
    padded[..., : levels.shape[-1]] = levels
    sums = np.empty((len(levels), len(places), frames))
    _function("rosafe_patterns")(
        _address(padded),
        levels.shape[1],
        frames,
        reach,
        _address(places),
        len(places),
        *map(_address, (weights, sums)),
    )
    return sums[..., :count]


def concatenate(blocks: Sequence[FloatArray], whole: FloatArray) -> None:
    """Blocks (*rows, N) one after the other into `whole`: as `numpy.concatenate`, which is the twin.

    That takes many times as long where N is small. It serves other types than float64, too, and without kernels.
    """
    fits = whole.ndim > 1 and rows_evenly_strided(whole) and all(block.dtype == whole.dtype for block in blocks)
    if not fits or not compiled():
        np.concatenate(blocks, axis=-1, out=whole)
        return
    held = [np.ascontiguousarray(block) for block in blocks]
    table = np.array([[_address(block) for block in held], [block.shape[-1] for block in held]], np.int64)
    _function("rosafe_join")(len(held), *map(_address, table), math.prod(whole.shape[:-1]), *_rows(whole))


@contextmanager
def denormals_off() -> Iterator[None]:
    """Within this, numpy and scipy take denormal numbers for 0 on this thread, which is many times faster.

    Without kernels, nothing happens.
    """
    if not compiled():
        yield
        return
    before = _function("rosafe_denormals_off")()
    try:
        yield
    finally:
        _function("rosafe_denormals_as")(before)


def _function(name: str) -> Any:
    library = loaded()[0]
    if library is None:
        raise RuntimeError(f"no kernels: {status().detail}")
    return getattr(library, name)


_ANYTHING = ctypes.c_char * 0


def _address(array: NDArray[Any]) -> int:
    try:  # takes a fifth of the time of the other way
        return ctypes.addressof(_ANYTHING.from_buffer(array))  # type: ignore[arg-type]
    except TypeError:  # it cannot be written to, or not in one piece
        address: int = array.ctypes.data
        return address


def rows_evenly_strided(array: FloatArray) -> bool:
    """Whether the rows of (*rows, N) lie evenly apart, each in one piece, as the outputs of some kernels may."""
    strides, sizes = array.strides, array.shape
    even = all(strides[axis] == sizes[axis + 1] * strides[axis + 1] for axis in range(array.ndim - 2))
    return even and strides[-1] == REAL_SIZE


def _rows(array: FloatArray) -> tuple[int, int]:
    """Address of an array whose rows may lie apart, and how far."""
    return _address(array), array.strides[-2] // REAL_SIZE
