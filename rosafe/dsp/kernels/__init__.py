"""The hot loops as compiled kernels; each has a twin in numpy and scipy, with the stage that uses it.

A stage calls its kernel where `compiled()` says so, and the twin elsewhere: where there is no compiler, on other
processors, and where the environment variable ROSAFE_KERNELS is 0. Both work on the same states and agree to 1e-11 of
the largest number. Tests hold each kernel to its twin, which is the reference. Kernels release the interpreter lock.

All arrays are of float64 or complex128 and C-contiguous, but for histories and tails, of which only rows are.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .library import Status, loaded

FloatArray = NDArray[np.float64]

MOST_POLES = 64  # of a gammatone filter
MOST_SECTIONS = 8  # of a low-pass
MOST_LAGS = 1024  # of a correlation; FFT is faster beyond

RECTIFICATIONS = ("none", "halfwave", "fullwave", "square")


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
    output: FloatArray,
    envelope: FloatArray | None,
) -> None:
    """Gammatone filters: as `rosafe.dsp.gammatone.filter_by_scipy`."""
    channels, order = sections.shape[:2]
    ends = (None if array is None else _address(array) for array in (output, envelope))
    _function("rosafe_gammatone")(
        _address(block), block.shape[-1], channels, order, _address(sections), _address(state), *ends
    )


def rectify_and_filter(rectification: str, block: FloatArray, sections: FloatArray, state: FloatArray) -> FloatArray:
    """Rectify (*rows, N), then filter it by second-order sections (S, 6); `state` (S, *rows, 2) as in scipy.

    The twin is `rosafe.dsp.haircell.RECTIFIERS` and `rosafe.dsp.cascade.Cascade`.
    """
    output = np.empty(block.shape)
    _function("rosafe_biquads")(
        RECTIFICATIONS.index(rectification),
        _address(block),
        math.prod(block.shape[:-1]),
        block.shape[-1],
        _address(sections),
        len(sections),
        _address(state),
        _address(output),
    )
    return output


class Frames(NamedTuple):
    """Frames over samples that lie in a history and a block behind it, without the two being joined.

    Samples are counted from the first one of the history on.
    """

    history: FloatArray  # (*rows, T)
    block: FloatArray  # (*rows, N)
    tail: FloatArray  # (*rows, n), to be filled with the last samples; may lie where the history does
    skip: int  # where the first frame starts
    weights: FloatArray  # (w,), of the samples of a frame
    hop: int  # from a frame's start to that of the next one
    number: int  # of whole ones


def energies(frames: Frames) -> FloatArray:
    """The weighted sum of the squares of each frame's samples, (*rows, F).

    The twin is `rosafe.dsp.framing.Framing.means`.
    """
    sums = np.empty((*frames.block.shape[:-1], frames.number))
    _function("rosafe_energies")(*_arguments(frames), _address(sums))
    return sums


def ratemap(
    frames: Frames, squared: bool, section: FloatArray, state: FloatArray, begun: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Weighted sums of what a leaky integrator makes of each frame's samples, or of the squares of that, (*rows, F).

    The integrator is `section` (1, 6), as of `rosafe.dsp.cascade.leaky_integrator`, with its `state` (1, *rows, 2). The
    history of `frames` has been through it, the block goes now. Returned, too, are the sums of the frames that begin in
    the samples but do not end there, (*rows, B); given as `begun`, they save the next call the sums over its history.
    The twin is `rosafe.dsp.framing.Framing.means` after `rosafe.dsp.cascade.Cascade`.
    """
    rows = frames.block.shape[:-1]
    samples = frames.history.shape[-1] + frames.block.shape[-1]
    have_begun = -(-max(0, samples - frames.skip) // frames.hop) - frames.number
    sums, sums_begun = np.empty((*rows, frames.number)), np.empty((*rows, have_begun))
    _function("rosafe_ratemap")(
        *_arguments(frames),
        squared,
        -section[0, 4],
        _address(state),
        0 if begun is None else begun.shape[-1],
        None if begun is None else _address(begun),
        have_begun,
        _address(sums),
        _address(sums_begun),
    )
    return sums, sums_begun


def correlations(frames: Frames, reach: int, epsilon: float, output: FloatArray) -> None:
    """Correlate the frames (2, C) of the two ears over the lags up to `reach`, into the middle of `output` (C, L, F).

    2 reach + 1 is at most `MOST_LAGS`. The twin is `rosafe.dsp.crosscorrelation.correlate_by_fft`.
    """
    channels, lags, number = output.shape
    outside = lags // 2 - reach
    _function("rosafe_correlations")(
        *_arguments(frames, channels),
        reach,
        epsilon,
        _address(output) + outside * number * output.itemsize,
        lags * number,
    )


def _function(name: str) -> Any:
    library = loaded()[0]
    if library is None:
        raise RuntimeError(f"no kernels: {status().detail}")
    return getattr(library, name)


def _address(array: NDArray[Any]) -> int:
    address: int = array.ctypes.data
    return address


def _arguments(frames: Frames, rows: int | None = None) -> tuple[int, ...]:
    """The arguments that both kernels of frames begin with; by default, the number of rows is that of the samples."""
    history, block, tail, skip, weights, hop, number = frames
    held, arriving = history.shape[-1], block.shape[-1]
    return (
        _address(history),
        history.strides[-2] // history.itemsize,
        held,
        _address(block),
        arriving,
        _address(tail),
        tail.strides[-2] // tail.itemsize,
        held + arriving - tail.shape[-1],
        math.prod(block.shape[:-1]) if rows is None else rows,
        skip,
        _address(weights),
        len(weights),
        hop,
        number,
    )
