"""Where the source is: azimuth from level differences and, apart from them, from the cross-correlation's peak.

Both compare what was measured with what a rigid sphere with two ears would give, the head model of Brown and Duda, "A
structural model for binaural sound synthesis", IEEE Trans. Speech Audio Process. 6(5), 1998. A sphere cannot tell
front from back, so azimuths go from -90 (left) over 0 (ahead) to 90 degrees (right).
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from rosafe.sound.head import HEAD_RADIUS, SPEED_OF_SOUND, ear_delay, shadow_gain
from rosafe.view.representations import Representations

AZIMUTHS = np.arange(-90.0, 90.5, 1.0)  # degrees; what the estimates choose from
SMOOTHING = 0.1  # s; both estimates look at so much sound at a time
RANGE_DB = 35.0  # frames this far below the loudest hold no source
FLOOR = 1e-14  # power per channel below which level differences are biased by 0.1 dB; see EPSILON in ild.py


def sphere_ild(center_frequencies: np.ndarray, azimuths: np.ndarray = AZIMUTHS) -> np.ndarray:
    """Level of the right ear over the left (dB) that the sphere gives, (C, A)."""
    left, right = (20 * np.log10(np.abs(h)) for h in _shadows(center_frequencies, azimuths))
    return right - left


def sphere_itd(center_frequencies: np.ndarray, azimuths: np.ndarray = AZIMUTHS) -> np.ndarray:
    """How much later (s) the sphere's left ear hears, (C, A): Woodworth's delay and the shadow's phase delay."""
    angles = np.radians(np.asarray(azimuths))
    around = ear_delay(np.pi / 2 + angles) - ear_delay(np.pi / 2 - angles)
    left, right = (np.angle(h) for h in _shadows(center_frequencies, azimuths))
    return around + (right - left) / (2 * np.pi * np.asarray(center_frequencies)[:, np.newaxis])


def _shadows(center_frequencies: np.ndarray, azimuths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transfer of the head's shadow to the left and the right ear, complex (C, A) each (Brown and Duda, eq. 3)."""
    angles = np.radians(np.asarray(azimuths))
    corner = 2 * SPEED_OF_SOUND / HEAD_RADIUS  # rad/s
    relative = 2j * np.pi * np.asarray(center_frequencies)[:, np.newaxis] / corner
    left, right = (shadow_gain(np.pi / 2 + side * angles) for side in (1, -1))
    return (1 + left * relative) / (1 + relative), (1 + right * relative) / (1 + relative)


def azimuth_from_ild(shown: Representations) -> np.ndarray:
    """The azimuth at which the sphere's level differences come closest to the measured ones.

    Closest in the least squares sense over the channels, which count by their magnitude.

    Returns
    -------
    ndarray, (F,)
        Degrees, positive to the right; NaN where there is no source (see `active`).
    """
    power = shown.ratemap.max(axis=0)
    energy = _smooth(power, shown)
    measured = _smooth(shown.ild * power, shown) / np.maximum(energy, np.finfo(float).tiny)
    weights = np.sqrt(energy)
    model = sphere_ild(shown.center_frequencies)
    # sum over c of w (measured - model)**2 without its part that is the same for all azimuths
    misfit = (model**2).T @ weights - 2 * model.T @ (weights * measured)
    return np.where(active(shown), AZIMUTHS[misfit.argmin(axis=0)], np.nan)


def time_difference(shown: Representations) -> np.ndarray:
    """The lag (s) of the highest point of the cross-correlation, (F,): a parabola through the peak and its neighbours.

    NaN where there is no source.
    """
    curves = _smooth(shown.correlation, shown)
    frames = np.arange(curves.shape[1])
    if len(shown.lags) < 3 or not len(frames):
        return np.full(len(frames), np.nan)
    peak = np.clip(curves.argmax(axis=0), 1, len(shown.lags) - 2)
    before, at, after = (curves[peak + k, frames] for k in (-1, 0, 1))
    bend = before - 2 * at + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
    step = shown.lags[1] - shown.lags[0]
    return np.where(active(shown), shown.lags[peak] + np.clip(shift, -1.0, 1.0) * step, np.nan)


def azimuth_from_correlation(shown: Representations) -> np.ndarray:
    """The azimuth at which the sphere's mean delay over the channels is the cross-correlation's `time_difference`.

    Returns
    -------
    ndarray, (F,)
        Degrees, positive to the right, at most 90; NaN where there is no source.
    """
    return np.interp(time_difference(shown), sphere_itd(shown.center_frequencies).mean(axis=0), AZIMUTHS)


def lag_of_azimuth(center_frequencies: np.ndarray, azimuths: np.ndarray) -> np.ndarray:
    """The lag (s) at which `azimuth_from_correlation` finds a source at `azimuths` (degrees); NaN stays NaN."""
    return np.interp(azimuths, AZIMUTHS, sphere_itd(center_frequencies).mean(axis=0))


def active(shown: Representations) -> np.ndarray:
    """Which frames (F,) are loud enough to hold a source."""
    level = _smooth(shown.ratemap.sum(axis=(0, 1))[np.newaxis], shown)[0]
    if not len(level):
        return np.zeros(0, bool)
    floor = FLOOR * len(shown.center_frequencies)
    return level > max(floor, level.max() * 10 ** (-RANGE_DB / 10))


def agreement(first: np.ndarray, second: np.ndarray, least: float = 5.0) -> float:
    """How often two series of azimuths (F,) agree on the side, from 0 to 1; NaN where there is nothing to compare.

    Frames in which both are within `least` degrees of straight ahead have no side and do not count.
    """
    compared = np.isfinite(first) & np.isfinite(second)
    compared &= np.maximum(np.abs(first), np.abs(second), where=compared, out=np.zeros_like(first)) > least
    return float(np.mean(np.sign(first[compared]) == np.sign(second[compared]))) if compared.any() else float("nan")


def _smooth(values: np.ndarray, shown: Representations) -> np.ndarray:
    """Means over `SMOOTHING` seconds around each frame, along the last axis; over what is there at the ends."""
    frames = values.shape[-1]
    if frames < 2:
        return values
    hop = (shown.times[-1] - shown.times[0]) / (frames - 1)
    window = np.ones(2 * round(SMOOTHING / hop / 2) + 1)
    sums, counts = (ndimage.convolve1d(v, window, axis=-1, mode="constant") for v in (values, np.ones(frames)))
    return sums / counts
