"""Signals as users of the library pass them: one ear or two, along either axis, as floats or integers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rosafe.dsp.signal_format import SignalFormat
from rosafe.interface import CORE_REPRESENTATIONS, KINDS
from rosafe.interface.arguments import check_outputs

_CHECK_FRAMES = 2**18  # checked at a time, so that no large array is allocated
_MAX_FLOAT = 256.0  # larger floats look like integer samples
_SHAPES = "shape (N,) or (1, N) for one ear, (2, N) or (N, 2) for two"


def ears_view(signal: Any, frames_first: bool = False) -> np.ndarray:
    """Return a signal as (1, N) or (2, N) of its own number type, without a copy if it is an array.

    Parameters
    ----------
    signal : array_like
        (N,) or (1, N), one ear; (2, N) or (N, 2), two. Floats, int32 or int16.
    frames_first : bool
        Whether (2, 2) is read as (N, 2).

    Raises
    ------
    ValueError
        For another shape or type, and for masked arrays.
    """
    array = _as_array(signal)
    if array.ndim == 1:
        array = array[np.newaxis]
    if array.ndim != 2 or not (array.shape[0] in (1, 2) or array.shape[1] == 2):
        raise ValueError(f"signal: expected {_SHAPES}, got shape {np.shape(signal)}")
    if array.dtype.kind != "f" and not (array.dtype.kind == "i" and array.dtype.itemsize in (2, 4)):
        raise ValueError(f"signal: expected a float type, int32 or int16, got {array.dtype}")
    return array.T if is_frames_first(array, frames_first) else array


def _as_array(signal: Any) -> np.ndarray:
    """Convert to an array of at least one axis; ValueError for masked arrays, scalars and ragged lists."""
    try:
        array = np.asanyarray(signal)
    except ValueError as problem:
        raise ValueError(f"signal: expected an array, got {type(signal).__name__}: {problem}") from None
    rows = signal if not isinstance(signal, (np.ndarray, memoryview)) and isinstance(signal, Sequence) else ()
    if isinstance(array, np.ma.MaskedArray) or any(isinstance(row, np.ma.MaskedArray) for row in rows):
        raise ValueError("signal: expected an array without a mask, got a masked array; call its method filled(0)")
    if array.ndim == 0:  # such as the name of a file
        raise ValueError(f"signal: expected an array of {_SHAPES}, got {type(signal).__name__}")
    return np.asarray(array)


def as_samples(ears: np.ndarray) -> np.ndarray:
    """Return the samples of `ears_view` as float64, or as int32 with full scale at 2**31."""
    if ears.dtype == np.float64:
        return ears
    if ears.dtype.kind == "f":
        with np.errstate(over="ignore"):  # a long double beyond the range of double becomes infinite
            return np.asarray(ears, np.float64)
    whole = np.asarray(ears, np.int32)
    return whole << 16 if ears.dtype.itemsize == 2 else whole  # as files of 16 bits, which fill the upper bits


def check_finite(ears: np.ndarray) -> None:
    """Raise ValueError if a signal as of `ears_view` contains NaN or infinite samples."""
    if ears.dtype.kind == "f":
        for first in range(0, ears.shape[1], _CHECK_FRAMES):
            if not np.isfinite(as_samples(ears[:, first : first + _CHECK_FRAMES])).all():
                raise ValueError("signal: expected finite samples, got NaN or infinite ones")


def range_warning(ears: np.ndarray) -> str:
    """Return a warning if a signal as of `ears_view` has floats in the range of integer samples; '' if not."""
    if ears.dtype.kind != "f" or not ears.size:
        return ""
    peak = max(float(ears.max()), -float(ears.min()))
    if not _MAX_FLOAT < peak <= 2.0**31:
        return ""
    return f"signal: floats up to {peak:g}, but their full scale is 1; divide samples of int16 by 32768"


def is_frames_first(signal: np.ndarray, frames_first: bool = False) -> bool:
    """Return whether `ears_view` reads a signal of two axes as (N, 2)."""
    return signal.shape[1] == 2 and (signal.shape[0] not in (1, 2) or (frames_first and len(signal) == 2))


class BlockReader:
    """Converts the blocks of a stream to samples. All blocks have the format of the first one.

    Attributes
    ----------
    ears : int
        1 or 2; 0 before the first block.
    whole : bool
        Whether the samples are integers.
    warning : str
        That of `range_warning` about the block that was accepted last, once; '' otherwise.
    """

    def __init__(self) -> None:
        self.warning = ""
        self._warned = False
        self.ears = 0
        self.whole = False
        self._frames_first = False

    def view(self, block: Any) -> np.ndarray:
        """Return a block as `ears_view` does; ValueError if its format differs from that of the first block."""
        shape = np.shape(block)
        view = ears_view(np.transpose(block) if self.ears == 2 and shape == (1, 2) else block, self._frames_first)
        if self.ears and len(view) != self.ears:
            earlier = ("one ear", "two ears")[self.ears - 1]
            raise ValueError(f"block: expected {earlier} as in the blocks before, got shape {shape}")
        if self.ears and (view.dtype.kind == "i") != self.whole:
            names = ("floats", "integers")
            raise ValueError(f"block: expected {names[self.whole]} as in the blocks before, got {view.dtype}")
        return view

    def accept(self, block: Any, view: np.ndarray) -> None:
        """Remember the format of a block that has been checked completely."""
        shape = np.shape(block)
        self.ears, self.whole = len(view), view.dtype.kind == "i"
        self.warning = "" if self._warned else range_warning(view)
        self._warned |= bool(self.warning)
        if len(shape) == 2 and shape != (2, 2):
            self._frames_first = is_frames_first(np.asarray(block)) or shape == (1, 2)


def outputs_of(ears: int, outputs: Any) -> list[str]:
    """Return the outputs as `check_outputs`; ValueError if a binaural output is requested for one ear.

    The default for one ear is that for two without the binaural outputs.
    """
    if outputs is None and ears == 1:
        return [kind for kind in CORE_REPRESENTATIONS if not KINDS[kind].binaural]
    checked = check_outputs(outputs)
    binaural = [kind for kind in checked if KINDS[kind].binaural]
    if ears == 1 and binaural:
        raise ValueError(
            f"outputs: expected representations of single ears for a signal with one ear, got {', '.join(binaural)}"
        )
    return checked


def of_ears(ears: int, axes: tuple[str, ...], data: np.ndarray) -> np.ndarray:
    """Return the part of an output to keep: for one ear, which may be computed as two equal ones, the first."""
    return data[:1] if ears == 1 and axes[0] == "ear" else data


def frame_times(signal: SignalFormat, first: int, count: int) -> np.ndarray:
    """Return the middle of each of `count` frames (s); the first frame begins at sample `first`.

    (first + k hop + window / 2) / fs for frame k, n / fs for sample n.
    """
    middle = signal.window / 2 if signal.framed else 0.0
    return (first + signal.hop * np.arange(count) + middle) / signal.sample_rate
