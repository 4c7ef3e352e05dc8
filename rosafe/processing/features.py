"""Features from results: levels in dB and deltas; and several sounds in one call."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.signal

from rosafe.declarations.checks import is_number
from rosafe.declarations.text import join_names, short_repr
from rosafe.dsp.numeric_limits import as_numbers
from rosafe.interface.remarks import unknown_argument
from rosafe.processing.process import ProcessCall, process
from rosafe.results.result import Result
from rosafe.tree.workers import workers_to_use

_TINY = float(np.finfo(np.float64).tiny)
_MAX_VALUE = 1e200  # sums of larger ones can overflow


def to_db(
    values: npt.ArrayLike, reference: float | str = 1.0, floor: float | None = -80.0, power: bool = False
) -> npt.NDArray[Any]:
    """Convert amplitudes or powers to levels in dB.

    Parameters
    ----------
    values : array_like
        Not negative, for example a ratemap.
    reference : float or "max", optional
        The value of 0 dB; "max" is the largest of `values`.
    floor : float or None, optional
        The lowest level in dB, relative to the reference. None for no limit: 0 becomes -inf.
    power : bool, optional
        Whether `values` are powers: 10 log10 instead of 20 log10. A ratemap is a power if `rm_scaling` is ``power``.

    Returns
    -------
    ndarray
        Levels in dB, of the shape and floating type of `values`.

    Raises
    ------
    ValueError
        For values that are negative or not real numbers, a reference that is not positive and finite, and a floor that
        is not a finite number.

    Examples
    --------
    >>> import rosafe
    >>> rosafe.to_db([1.0, 0.1, 0.0])
    array([  0., -20., -80.])
    """
    array = np.asarray(values)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"values: expected real numbers, got {array.dtype}")
    array = array if array.dtype.kind == "f" else array.astype(np.float64)
    if np.any(array < 0):
        raise ValueError(f"values: expected no negative numbers, got {np.nanmin(array):g}")
    one = 0.0
    if isinstance(reference, str) and reference == "max":
        one = max(float(np.nanmax(array, initial=0.0)), _TINY)
    elif is_number(reference):
        one = float(reference)
    if not 0 < one < np.inf:
        raise ValueError(f'reference: expected a positive finite number or "max", got {short_repr(reference)}')
    if floor is not None and not is_number(floor):
        raise ValueError(f"floor: expected a finite number of dB or None, got {short_repr(floor)}")
    with np.errstate(divide="ignore"):
        # A difference of logarithms, of at least double precision: a ratio can be out of range.
        logarithms = np.log10(array, dtype=np.promote_types(array.dtype, np.float64))
    levels = (10.0 if power else 20.0) * (logarithms - np.log10(one))
    return np.asarray(levels if floor is None else np.maximum(levels, floor), array.dtype)


def deltas(values: npt.ArrayLike, width: int = 9, order: int = 1, axis: int = -1) -> npt.NDArray[np.float64]:
    """Return the slope of values over frames: the first (or higher) derivative of a local polynomial fit.

    The fit is that of Savitzky and Golay (Anal. Chem. 36, 1964, 1627-1639) with a polynomial of degree `order`, as in
    `librosa.feature.delta`. At both ends, the polynomial of the first and last `width` frames is used.

    Parameters
    ----------
    values : array_like
        For example a ratemap, (2, C, F).
    width : int, optional
        Number of frames of the fit: odd, at least 3, more than `order`, at most the number of frames.
    order : int, optional
        1 for deltas, 2 for delta-deltas.
    axis : int, optional
        The axis of the frames.

    Returns
    -------
    ndarray
        Change per frame**order, with the shape of `values`.

    Raises
    ------
    ValueError
        For an unsuitable width, order or axis, and for values that are not numbers up to 1e200, such as the pitch of
        unvoiced frames.

    Examples
    --------
    >>> import numpy as np, rosafe
    >>> rosafe.deltas(2.0 * np.arange(10)).round(9)
    array([2., 2., 2., 2., 2., 2., 2., 2., 2., 2.])
    """
    array = as_numbers("values", values)
    for name, number in (("width", width), ("order", order), ("axis", axis)):
        if not isinstance(number, (int, np.integer)) or isinstance(number, bool):
            raise ValueError(f"{name}: expected an integer, got {short_repr(number)}")
    if not -array.ndim <= axis < array.ndim:
        raise ValueError(f"axis: expected one of the {array.ndim} axes of values, got {axis}")
    if not (np.abs(array) <= _MAX_VALUE).all():
        expected = f"finite numbers up to {_MAX_VALUE:g}"
        raise ValueError(f"values: expected {expected}, got larger ones, NaN or infinity; replace them first")
    frames = array.shape[axis]
    if order < 1 or width % 2 != 1 or not max(3, order + 1) <= width <= frames:
        raise ValueError(
            f"width: expected an odd number of frames from {max(3, order + 1)} to {frames} and an order of at least 1, "
            f"got width {width} and order {order}"
        )
    slopes: npt.NDArray[np.float64] = scipy.signal.savgol_filter(
        array, width, order, deriv=order, axis=axis, mode="interp"
    )
    return slopes


def process_batch(signals: Iterable[Any], sample_rate: float, **options: Any) -> list[Result]:
    """Compute the representations of several sounds, concurrently on the available cores.

    Parameters
    ----------
    signals : iterable of array_like
        Sounds as for `rosafe.process`, which may differ in length. An array (B, 2, N) is a batch of B sounds.
    sample_rate : float
        In Hz, of all sounds.
    **options
        `parameters`, `outputs`, `pad` and further arguments of `rosafe.process`.

    Returns
    -------
    list of Result
        In the order of the sounds; each is equal to the result of `rosafe.process`.

    Raises
    ------
    ValueError
        As `rosafe.process`; the message begins with the number of the sound, from 0.

    Warns
    -----
    UserWarning
        As `rosafe.process`, once for each text; with the numbers of the sounds if it does not apply to all.
    """
    for name in options.keys() - inspect.signature(process).parameters.keys():
        raise unknown_argument(name, "process_batch")

    def compute(numbered: tuple[int, Any]) -> tuple[Result, Sequence[str]]:
        number, signal = numbered
        try:
            call = ProcessCall(signal, sample_rate, **options)
            return call.run(), call.warnings
        except ValueError as problem:
            raise ValueError(f"sound {number}: {problem}") from None

    with ThreadPoolExecutor(workers_to_use()) as pool:
        computed = list(pool.map(compute, enumerate(signals)))
    for text in dict.fromkeys(text for _, texts in computed for text in texts):
        sounds = [str(number) for number, (_, texts) in enumerate(computed) if text in texts]
        which = "" if len(sounds) == len(computed) else f"sounds {join_names(sounds)}: "
        warnings.warn(f"{which}{text}", UserWarning, 2)
    return [result for result, _ in computed]
