"""The hot loops as compiled kernels; each has a twin in numpy and scipy, with the stage that uses it.

A stage calls its kernel where `compiled()` says so, and the twin elsewhere: where there is no compiler, on other
processors, and where the environment variable ROSAFE_KERNELS is 0. Both work on the same states and agree to 1e-11 of the
largest number. Tests hold each kernel to its twin, which is the reference. Kernels release the interpreter lock.

All arrays are of float64 or complex128 and C-contiguous, but for histories and tails, of which only rows are.
"""

from __future__ import annotations

import math
from typing import Any

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


def frame_sums(
    history: FloatArray, block: FloatArray, skip: int, weights: FloatArray, hop: int, frames: int, squared: bool
) -> FloatArray:
    """Weighted sums of the samples, or of their squares, in each of so many frames: (*rows, F).

    The samples are those of `history` (*rows, T) and of `block` (*rows, N) behind it; the first frame starts at sample
    `skip`, each next one `hop` later. The twin is `rosafe.dsp.framing.Framing.means`.
    """
    return _frame_sums(history, block, skip, weights, hop, frames, squared, 0.0, None, None)


def integrated_frame_sums(
    history: FloatArray,
    block: FloatArray,
    skip: int,
    weights: FloatArray,
    hop: int,
    frames: int,
    squared: bool,
    integrator: FloatArray,
    state: FloatArray,
    tail: FloatArray,
) -> FloatArray:
    """As `frame_sums`, of a block that goes through a leaky integrator first, as the history has already.

    `integrator` (1, 6) is a section as of `rosafe.dsp.cascade.leaky_integrator`, `state` (1, *rows, 2) as in scipy; the
    last integrated samples fill `tail` (*rows, n), which may lie where `history` does.
    """
    retention = -float(integrator[0, 4])
    return _frame_sums(history, block, skip, weights, hop, frames, squared, retention, state, tail)


def _frame_sums(
    history: FloatArray,
    block: FloatArray,
    skip: int,
    weights: FloatArray,
    hop: int,
    frames: int,
    squared: bool,
    retention: float,
    state: FloatArray | None,
    tail: FloatArray | None,
) -> FloatArray:
    sums = np.empty((*block.shape[:-1], frames))
    kept: tuple[int | None, int, int] = (None, 0, 0)
    if tail is not None:
        kept = (_address(tail), _row_distance(tail), history.shape[-1] + block.shape[-1] - tail.shape[-1])
    _function("rosafe_frame_sums")(
        *_samples(history, block),
        math.prod(block.shape[:-1]),
        skip,
        _address(weights),
        len(weights),
        hop,
        frames,
        squared,
        retention,
        None if state is None else _address(state),
        *kept,
        _address(sums),
    )
    return sums


def correlations(
    history: FloatArray,
    block: FloatArray,
    skip: int,
    window: FloatArray,
    hop: int,
    reach: int,
    epsilon: float,
    output: FloatArray,
) -> None:
    """Correlate the ears' frames in `history` (2, C, T) and `block` (2, C, N) behind it, over the lags up to `reach`.

    They go to the middle lags of `output` (C, L, F); its first frame starts at sample `skip`. 2 reach + 1 is at most
    `MOST_LAGS`. The twin is `rosafe.dsp.crosscorrelation.correlate_by_fft`.
    """
    channels, lags, frames = output.shape
    outside = lags // 2 - reach
    _function("rosafe_correlations")(
        *_samples(history, block),
        channels,
        skip,
        _address(window),
        len(window),
        hop,
        frames,
        reach,
        epsilon,
        _address(output) + outside * frames * output.itemsize,
        lags * frames,
    )


def _function(name: str) -> Any:
    library = loaded()[0]
    if library is None:
        raise RuntimeError(f"no kernels: {status().detail}")
    return getattr(library, name)


def _address(array: NDArray[Any]) -> int:
    address: int = array.__array_interface__["data"][0]  # several times as fast as array.ctypes
    return address


def _row_distance(array: FloatArray) -> int:
    """From one row to the next, in samples."""
    return array.strides[-2] // array.itemsize


def _samples(history: FloatArray, block: FloatArray) -> tuple[int, ...]:
    return _address(history), _row_distance(history), history.shape[-1], _address(block), block.shape[-1]
