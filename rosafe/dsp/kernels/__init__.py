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
    channels, order = sections.shape[:2]
    _function("rosafe_gammatone")(
        _address(block),
        *block.shape,
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

    The envelope of the same shape is needed for `compressed`. `output` has evenly strided rows, or is `block`. The
    equivalent is `RECTIFIERS` or `compressed` of rosafe/representations/haircell.py with
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
    _function("rosafe_level_differences")(frames.packed, epsilon, _address(energies), _address(result))
    return result


def ratemap(frames: FrameReader, squared: bool, section: FloatArray, state: FloatArray) -> FloatArray:
    """Return weighted sums of the integrated samples of each frame, or of their squares, (*rows, F).

    The integrator is `section` (1, 6), from `rosafe.dsp.sos_filter.leaky_integrator`, with its `state` (1, *rows, 2).
    The history of `frames` is integrated already, the block is not. The equivalent is
    `rosafe.dsp.framing.FrameGrid.means` after `rosafe.dsp.sos_filter.SosFilter`.
    """
    rates = np.empty((*frames.block.shape[:-1], frames.number))
    _function("rosafe_ratemap")(frames.packed, squared, -section[0, 4], _address(state), _address(rates))
    return rates


def modulation(frames: FrameReader, sections: FloatArray, state: FloatArray) -> FloatArray:
    """Return weighted sums of the magnitudes of samples (*rows, N) filtered by parallel sections (M, 6), (*rows, M, F).

    The state of the sections is (M, *rows, 2). The history of `frames` is (*rows, M) and filtered already, the block is
    not. The equivalent is `rosafe.dsp.framing.FrameGrid.means` of the magnitudes after
    `rosafe.dsp.sos_filter.SosFilterBank`.
    """
    means = np.empty((*frames.tail.store.array.shape[:-1], frames.number))
    _function("rosafe_modulation")(frames.packed, len(sections), *map(_address, (sections, state, means)))
    return means


def correlations(frames: FrameReader, reach: int, epsilon: float, output: FloatArray) -> None:
    """Correlate the frames (2, C) of both ears over lags up to `reach`, into the middle of `output` (C, L, F).

    2 reach + 1 is at most `MAX_LAGS`. The equivalent is `rosafe.representations.crosscorrelation.correlate_by_fft`.
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
    """Compute all features of spectra (2, C, F), after the spectrum `last` (2, C), into `features` (2, 14, F).

    The equivalent is `FEATURES` of rosafe/representations/spectralfeatures.py.
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
    peaks, *others = map(_address, buffers)
    _function("rosafe_transient_map")(
        *(_address(strengths), _address(levels), strengths.strides[1] // REAL_SIZE, ears * channels, channels),
        *(first, count, reach, at_once, *thresholds, fuse, spread, peaks, capacity, *others, _address(output)),
    )


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
    _function("rosafe_gabor_responses")(
        _address(padded),
        ears,
        channels,
        frames,
        reach,
        _address(places),
        len(places),
        *map(_address, (weights, sums)),
    )
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
    _function("rosafe_concatenate")(len(held), *map(_address, table), math.prod(whole.shape[:-1]), *_rows(whole))


def mixture(likelihood: NDArray[np.float32], iterations: int, weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute the same as `rosafe.localization.mixture.fit_by_numpy`, for `DIRECTIONS` directions."""
    inverse = np.empty(len(likelihood), np.float32)
    likelihood = np.ascontiguousarray(likelihood)
    _function("rosafe_mixture")(len(likelihood), _address(likelihood), iterations, _address(weights), _address(inverse))
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
        _function("rosafe_add_evidence")(
            self._packed(cues, floor),
            self.step,
            _address(frames),
            len(frames),
            _address(channels),
            factor,
            _address(sums),
        )

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
        _function("rosafe_unit_evidence")(
            self._packed(cues, floor),
            self.step,
            _address(frames),
            len(frames),
            _address(factors),
            factors[0].size,
            _address(evidence),
        )
        return evidence


@contextmanager
def denormals_off() -> Iterator[None]:
    """Make numpy and scipy treat denormal numbers as 0 on this thread, which is many times faster.

    Without kernels, it has no effect.
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
        raise RuntimeError(f"kernels are not available: {status().detail}")
    return getattr(library, name)


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
