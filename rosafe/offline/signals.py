"""Sound as users of the library hand it over: one ear or two, along either axis, of floats or whole numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rosafe.dsp.signal_format import SignalFormat
from rosafe.interface import CORE_REPRESENTATIONS, KINDS
from rosafe.interface.arguments import check_outputs

_CHECKED_TOGETHER = 2**18  # frames; no large array is made for the check
_WANTED = "wanted is (N,) or (1, N) for one ear, (2, N) or (N, 2) for two"


def ears_view(signal: Any, upright: bool = False) -> np.ndarray:
    """Return a signal as (1, N) or (2, N) of its own number type, without a copy if it is an array.

    Parameters
    ----------
    signal : array_like
        (N,) or (1, N), one ear; (2, N) or (N, 2), two. Floats, int32 or int16.
    upright : bool
        Whether (2, 2) is (N, 2), as what came before it was.

    Raises
    ------
    ValueError
        For another shape or type, and for masked arrays.
    """
    try:
        array = np.asanyarray(signal)
    except ValueError as problem:
        raise ValueError(f"signal is no array: {problem}") from None
    rows = signal if not isinstance(signal, (np.ndarray, memoryview)) and isinstance(signal, Sequence) else ()
    if isinstance(array, np.ma.MaskedArray) or any(isinstance(row, np.ma.MaskedArray) for row in rows):
        raise ValueError("signal: expected an array without a mask, got a masked array; call its method filled(0)")
    array = np.asarray(array)
    if array.ndim == 0:  # such as the name of a file
        raise ValueError(f"signal is no array, but {type(signal).__name__}; {_WANTED}")
    if array.ndim == 1:
        array = array[np.newaxis]
    if array.ndim != 2 or not (array.shape[0] in (1, 2) or array.shape[1] == 2):
        raise ValueError(f"signal has shape {np.shape(signal)}; {_WANTED}")
    whole = array.dtype.kind == "i" and array.dtype.itemsize in (2, 4)
    if not whole and array.dtype.kind != "f":
        raise ValueError(f"signal is of type {array.dtype}, wanted is a float type, int32 or int16")
    return array.T if is_frames_first(array, upright) else array


def as_samples(ears: np.ndarray) -> np.ndarray:
    """Return the samples of `ears_view` as float64, or as int32 with full scale at 2**31."""
    if ears.dtype.kind == "f":
        with np.errstate(over="ignore"):  # a long double beyond the range of double becomes infinite
            return np.asarray(ears, np.float64)
    whole = np.asarray(ears, np.int32)
    return whole << 16 if ears.dtype.itemsize == 2 else whole  # as files of 16 bits, which fill the upper bits


def check_finite(ears: np.ndarray) -> None:
    """Raise ValueError if a signal as of `ears_view` holds NaN or infinite samples."""
    if ears.dtype.kind == "f":
        for first in range(0, ears.shape[1], _CHECKED_TOGETHER):
            if not np.isfinite(as_samples(ears[:, first : first + _CHECKED_TOGETHER])).all():
                raise ValueError("signal holds NaN or infinite samples")


def is_frames_first(signal: np.ndarray, upright: bool = False) -> bool:
    """Whether a signal of two axes is (N, 2), as `ears_view` takes it."""
    return signal.shape[1] == 2 and (signal.shape[0] > 2 or signal.shape[0] == 0 or (upright and len(signal) == 2))


def outputs_of(ears: int, outputs: Any) -> list[str]:
    """The outputs to keep of a signal of so many ears, as `check_outputs`; ValueError where one ear is not enough."""
    if outputs is None and ears == 1:
        return [kind for kind in CORE_REPRESENTATIONS if not KINDS[kind].binaural]
    wanted = check_outputs(outputs)
    both = [kind for kind in wanted if KINDS[kind].binaural]
    if ears == 1 and both:
        raise ValueError(f"outputs: {', '.join(both)} compare two ears, and the signal has one")
    return wanted


def of_ears(ears: int, axes: tuple[str, ...], data: np.ndarray) -> np.ndarray:
    """What is kept of an output, computed for two ears that heard the same where there is only one."""
    return data[:1] if ears == 1 and axes[0] == "ear" else data


def frame_times(signal: SignalFormat, first: int, count: int) -> np.ndarray:
    """Seconds from the first sample to the middle of each frame, of so many that begin `first` samples later.

    (first + k hop + window / 2) / fs for frame k, n / fs for sample n.
    """
    middle = signal.window / 2 if signal.framed else 0.0
    return (first + signal.hop * np.arange(count) + middle) / signal.sample_rate
