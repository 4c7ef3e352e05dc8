"""`rosafe.localize`: directions in a whole sound."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from rosafe.localization.head import Head
from rosafe.localization.localizer import Localizer
from rosafe.processing.signals import ears_view

_BLOCK_SECONDS = 10.0
_FULL_SCALE = 1 - 2.0**-15  # from here on a sample may be clipped


def localize(
    sound: Any,
    sample_rate: float,
    head: Head | str | os.PathLike[str] = "sphere",
    seconds: float = 0.5,
    parameters: Mapping[str, Any] | None = None,
    head_yaw: Any = 0.0,
) -> dict[str, Any]:
    """Localize the sources in a binaural sound.

    Parameters
    ----------
    sound : array_like, (2, N) or (N, 2)
        Left and right ear; float, or int32 or int16, whose full scale becomes 1.
    sample_rate : float
        In Hz.
    head : Head or str or Path
        `"sphere"`, a head, or the path of a SOFA file or of a model that `rosafe head learn` has written. A model is
        learned at the first use of a head, sample rate and parameters; this takes up to 30 s.
    seconds : float
        Length of the window of integration.
    parameters : mapping, optional
        Of the representations, as of `rosafe.process`.
    head_yaw : float or sequence of [time, degrees]
        Direction of the head in world coordinates, left positive; times in s.

    Returns
    -------
    dict
        `time` (T,) in s, every 10 ms: the end of each window; `azimuth` (T,) in degrees, left positive, in world
        coordinates, NaN if no frame of the window has enough level and coherence; `confidence` (T,) from 0 to 1, the
        estimated probability that `azimuth` is right to within 5 degrees; `azimuths` (A,), the grid; `posterior`
        (T, A); `level_db` (T,), mean level in the window in dB full scale; `tracks`, a list of mappings with `id`,
        `first_time`, `last_time` in s and the arrays `time`, `azimuth`, `azimuth_std` and `probability`.

    Raises
    ------
    ValueError
        The sound is mono or of the wrong shape or type, the sample rate is not positive and finite, the head file is
        unsuitable, or a parameter is out of range: one line.

    Warns
    -----
    UserWarning
        If samples are clipped, with their number, and if floats are in the range of integer samples.

    Notes
    -----
    The method is in docs/localization.md.

    Examples
    --------
    >>> import numpy as np, rosafe
    >>> noise = 0.1 * np.random.default_rng(1).standard_normal(22050)
    >>> ears = rosafe.Head.sphere().render(noise, 44100, azimuth=40)
    >>> found = rosafe.localize(ears, 44100)
    >>> float(found["azimuth"][-1])
    40.0
    """
    try:
        view = ears_view(sound)
        if view.shape[0] != 2:
            raise ValueError(f"sound: expected two ears, (2, N) or (N, 2), got shape {np.shape(sound)}")
        localizer = Localizer(sample_rate, head, seconds, parameters)
        clipped = clipped_samples(view)
        block = max(2, round(_BLOCK_SECONDS * sample_rate))
        parts = [
            localizer.process(np.ascontiguousarray(view[:, begin : begin + block]), head_yaw)
            for begin in range(0, max(1, view.shape[1]), block)
        ]
    except ValueError as problem:
        raise problem.with_traceback(None) from None
    if clipped:
        warnings.warn(f"sound: {clipped} samples are clipped; directions may be wrong", UserWarning, stacklevel=2)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name != "azimuths"}
    return {**joined, "azimuths": localizer.azimuths, "tracks": localizer.tracks}


def clipped_samples(ears: np.ndarray) -> int:
    """Return the number of samples (2, N) at full scale; 0 if no ear has two in succession."""
    full = np.iinfo(ears.dtype).max * _FULL_SCALE if ears.dtype.kind == "i" else _FULL_SCALE
    at_limit = (ears >= full) | (ears <= -full)
    return int(at_limit.sum()) if (at_limit[:, 1:] & at_limit[:, :-1]).any() else 0
