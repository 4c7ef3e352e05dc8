"""From evidence to a posterior, an azimuth and its confidence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles

FRAME_WEIGHT = 0.1  # of the evidence of a frame in its channel: neighbouring frames are not independent
UNRELIABLE = 0.3  # probability that the cues of a channel do not depend on the direction of the source
CHANNEL_WEIGHT = 0.2  # of the evidence of a channel: neighbouring channels are not independent
# Logistic regression of the correctness of 5,900 estimates (windows of 0.25, 0.5 and 1 s at 16 kHz; speech in diffuse
# noise at 60 to -5 dB, training sounds in statistical rooms, and noise without a direction; MIT KEMAR): constant,
# log-odds of the posterior, evidence, length; the mean evidence at which half remains, and its scale.
CALIBRATION = np.array([2.775, 2.189, -0.889, -1.573])
NO_DIRECTION, DIRECTION_SCALE = -0.105, 0.0435
TOLERANCE = 5.0  # degrees; the confidence is the probability that the azimuth is right to within this
_TIE = 1e-6  # directions whose scores differ by less are equal


class Estimate(NamedTuple):
    """The result for one window."""

    azimuth: float  # degrees; NaN without evidence
    confidence: float
    posterior: FloatArray  # (A,)


def fuse(sums: FloatArray) -> FloatArray:
    """Return the scores (A,) of directions from the evidence (C, A) of the channels.

    A channel counts by its posterior, mixed with a uniform one: no channel can outvote all others.
    """
    scaled = FRAME_WEIGHT * (sums - sums.max(axis=1, keepdims=True))
    posteriors = np.exp(scaled)
    posteriors /= posteriors.sum(axis=1, keepdims=True)
    return np.asarray(np.log((1 - UNRELIABLE) * posteriors + UNRELIABLE / sums.shape[1]).sum(axis=0))


class Estimator:
    """Turns scores of directions into a posterior, an azimuth and a confidence.

    Parameters
    ----------
    azimuths : ndarray, (A,)
        The grid in degrees.
    is_sphere : bool
        Whether front and back are equal.
    """

    def __init__(self, azimuths: FloatArray, is_sphere: bool) -> None:
        self._azimuths = azimuths
        self._is_sphere = is_sphere
        distance = np.abs(angles.difference(azimuths[:, np.newaxis], azimuths))
        self._near = distance <= TOLERANCE + 1e-9  # (A, A)

    def estimate(self, sums: FloatArray, units: int, yaw: float) -> Estimate:
        """Return the estimate for a window.

        Parameters
        ----------
        sums : ndarray, (C, A)
            Evidence of the channels in world coordinates.
        units : int
            Number of frames of all channels with cues in the window; without any, the azimuth is NaN.
        yaw : float
            Direction of the head at the end of the window in degrees.
        """
        if not units:
            return Estimate(np.nan, 0.0, np.full(sums.shape[1], 1 / sums.shape[1]))
        scores = fuse(sums)
        best = float(scores.max())
        posterior = np.exp(CHANNEL_WEIGHT * (scores - best))
        posterior /= posterior.sum()
        ties = np.flatnonzero(scores >= best - _TIE)
        relative = np.abs(angles.difference(self._azimuths[ties], yaw))
        index = int(ties[relative.argmin()])  # of equal directions the one in front
        near = self._near[index]
        if self._is_sphere or len(ties) > 1:
            lateral = angles.lateral(self._azimuths - yaw)
            near = np.abs(lateral - lateral[index]) <= TOLERANCE + 1e-9
        confidence = calibrate(float(posterior[near].sum()), float(sums.sum(axis=0).max()), units)
        return Estimate(float(self._azimuths[index]), confidence, posterior)


def calibrate(mass: float, evidence: float, units: int) -> float:
    """Return the probability that an azimuth is right.

    Parameters
    ----------
    mass : float
        Posterior probability within 5 degrees of the azimuth.
    evidence : float
        Largest sum of the evidence of all channels and frames. It is negative if no direction explains the cues better
        than the mean over all directions: noise that is independent at both ears, or diffuse.
    units : int
        Number of frames of all channels with cues.
    """
    mean = evidence / units
    odds = np.clip(np.log(max(mass, 1e-9) / max(1 - mass, 1e-9)), -5.0, 8.0)
    features = np.array([1.0, odds, np.arcsinh(max(mean, 0.0) / 0.03), np.log(units / 3100)])
    directional = 1 / (1 + np.exp(-(mean - NO_DIRECTION) / DIRECTION_SCALE))
    return float(directional / (1 + np.exp(-CALIBRATION @ features)))
