"""Several simultaneous sources: each frame of each channel belongs to one of several directions.

The weights of the directions are those of a mixture model, estimated by expectation maximization over all frames
and channels of a window, as in M. I. Mandel, R. J. Weiss and D. P. W. Ellis (2010), "Model-based
expectation-maximization source separation and localization", IEEE Trans. Audio Speech Lang. Process. 18, 382-394,
with the cues' likelihoods of a direction model.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rosafe.dsp import kernels
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization import angles
from rosafe.localization.posterior import fuse

DRY_SHARPNESS = 2.15  # factor of the evidence without a room: makes the weights sparse
ITERATIONS = 20
MIN_SHARE = 0.08  # of the evidence in a window, of a candidate
MIN_UNITS = 60  # frames and channels with cues in a window
MIN_SALIENCE = 0.19  # part of the evidence for a source that is above the noise, at least; less is noise
MIN_REST = 0.4  # of the evidence, with which that of a source is compared if the rest is noise
MAX_CANDIDATES = 6
SEPARATION = 15.0  # degrees between two candidates, at least
# Mean difference of the logarithmic likelihoods of units without a room and in rooms, relative to those in rooms, above
# which the sound comes without a room, and below which not any more. Talkers without a room have -0.02 to 0.05, those
# at a direct-to-reverberant ratio of 5 dB at most -0.13, sounds with few pauses there -0.16 to -0.01.
_DRY, _NOT_DRY = -0.02, -0.03
_ROOM = -0.06  # that ratio, below which sums of evidence have the tables for rooms; noise changes it little
_FIRST = -0.2  # of that ratio: a room is assumed for most of a second, as the first sound of a source is dry there, too
_RATE = 0.2  # of the mean ratio, for each update
_CLEAR = 0.7  # mean logarithmic likelihood of a unit; less is noise, in which the factor would make sources
DECISION_STEP = 4  # frames, one of which is used for that ratio
_LIMIT = 30.0  # of a scaled log-likelihood ratio
_EQUAL = 1e-3  # log-likelihood ratio; directions that differ by less have equal evidence


class Units(NamedTuple):
    """Channels with cues of the frames of a window, of which each belongs to one source.

    Attributes
    ----------
    evidence : ndarray of float32, (U, A)
        Log-likelihood ratios of the directions in world coordinates.
    weighted : ndarray of float32, (U, A)
        The same with the weights for sums over the units of one source.
    channels : ndarray of int, (U,)
        The channels.
    powers : ndarray, (U,)
        Powers, divided by the number of frames.
    salient : ndarray of bool, (U,)
        Whether the level exceeds that of the noise.
    """

    evidence: NDArray[np.float32]
    weighted: NDArray[np.float32]
    channels: NDArray[np.intp]
    powers: FloatArray
    salient: NDArray[np.bool_]


class Candidate(NamedTuple):
    """A direction that explains a share of the evidence."""

    azimuth: float  # degrees
    share: float  # 0 to 1
    power: float = 0.0  # of the units that it explains, as the ratemap has it, mean over the frames
    salience: float = 1.0  # part of its evidence that is above the noise
    odds: float = 0.0  # log-odds of the direction against its front-back image, from the units of both
    own_odds: float = 0.0  # the same from its own units


class Mixture(NamedTuple):
    """A mixture of directions for units, each a frame of a channel.

    Attributes
    ----------
    weights : ndarray, (A,)
        Of the directions.
    likelihood : ndarray, (U, A)
        Of each direction for each unit.
    inverse : ndarray, (U,)
        One over the likelihood of the mixture.
    """

    weights: FloatArray
    likelihood: NDArray[np.float32]
    inverse: NDArray[np.float32]

    def part_of(self, directions: NDArray[np.bool_]) -> FloatArray:
        """Return the part (U,) of each unit that these directions (A,) explain."""
        few = np.flatnonzero(directions)  # the likelihood of others is not converted to float64
        # Not a matrix product: OpenBLAS would start threads for it, whose waiting takes more time than the product.
        return np.asarray(np.einsum("ua,a->u", self.likelihood[:, few], self.weights[few]) * self.inverse)


class Surroundings:
    """Decides whether the sound comes from a room.

    Attributes
    ----------
    room : bool
        Whether the sound comes from a room; without one, or with little reverberation, it may still be noisy.
    dry : bool
        Whether it comes without a room, and its cues are clear.
    """

    def __init__(self) -> None:
        self.room, self.dry = True, False
        self._ratio, self._evidence = _FIRST, 0.0

    def update(self, rooms: NDArray[np.float32], dry: NDArray[np.float32]) -> None:
        """Take the evidence (U, A) of the same units, in rooms and without, both relative to reverberation."""
        if len(rooms) >= MIN_UNITS // DECISION_STEP:
            in_room, without = (-np.log(fit(evidence).inverse) for evidence in (rooms, dry))
            mean = max(float(np.mean(np.abs(in_room))), _EQUAL)
            self._ratio += _RATE * (float(np.mean(without - in_room)) / mean - self._ratio)
            self._evidence += _RATE * (mean - self._evidence)
            self.room = self._ratio < _ROOM
            self.dry = self._ratio > (_NOT_DRY if self.dry else _DRY) and self._evidence > _CLEAR


def fit(evidence: NDArray[np.float32], sharpness: float = 1.0) -> Mixture:
    """Return the mixture for the evidence (U, A) of units, times `sharpness`."""
    likelihood = np.float32(sharpness) * evidence
    np.minimum(likelihood, _LIMIT, out=likelihood)  # with the next line: several times as fast as np.clip
    np.maximum(likelihood, -_LIMIT, out=likelihood)
    np.exp(likelihood, out=likelihood)
    count = likelihood.shape[1]
    weight = np.full(count + 1, 0.9 / count, np.float32)
    weight[-1] = 0.1  # of units without a direction
    compiled = count == kernels.DIRECTIONS and kernels.compiled()
    inverse = (kernels.mixture if compiled else fit_by_numpy)(likelihood, ITERATIONS, weight)
    return Mixture(weight[:-1].astype(np.float64), likelihood, inverse)


def fit_by_numpy(likelihood: NDArray[np.float32], iterations: int, weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Improve the `weights` (A + 1,) of a mixture in place; the last one is that of units without a direction.

    Returns one over the likelihood (U,) of the mixture before the last iteration.
    """
    weight, outlier = weights[:-1].copy(), weights[-1]
    inverse = np.empty(len(likelihood), np.float32)
    for _ in range(iterations):
        inverse = 1 / (likelihood @ weight + outlier)
        weight = weight * (inverse @ likelihood)
        outlier = outlier * inverse.sum()
        total = weight.sum() + outlier
        weight, outlier = weight / total, outlier / total
    weights[:-1], weights[-1] = weight, outlier
    return inverse


def candidates(units: Units, yaw: float, sharpness: float = 1.0) -> list[Candidate]:
    """Return the directions of sources in the evidence of units, the strongest first.

    If several directions have equal evidence, the one in front of a head with `yaw` (degrees) is returned. The power
    of a source is the sum of the powers of the units that it explains, and its salience the part of these units that
    are salient.
    """
    if len(units.evidence) < MIN_UNITS:
        return []
    mixture = fit(units.evidence, sharpness)
    weight = mixture.weights
    grid = angles.grid()
    found = []
    rest = 1.0  # of the weights, without those of noise
    for _ in range(MAX_CANDIDATES):
        circle = np.concatenate((weight[-1:], weight, weight[:1]))
        share = weight + circle[:-2] + circle[2:]
        peak = int(share.argmax())
        if share[peak] <= MIN_SHARE * max(rest, MIN_REST):
            break
        near = np.abs(angles.difference(grid, grid[peak])) < SEPARATION
        close = np.array([peak - 1, peak, peak + 1]) % len(grid)
        offset = float(weight[close] @ np.array([-1.0, 0.0, 1.0]) / share[peak]) * angles.SPACING
        part = mixture.part_of(near & (weight > 0))
        salience = float(part @ units.salient / part.sum())
        found.append(
            Candidate(
                float(angles.wrap(grid[peak] + offset)),
                float(share[peak] / max(rest, MIN_REST)),
                float(part @ units.powers),
                salience,
                *_front_back_odds(units, mixture, near, peak, yaw),
            )
        )
        if salience < MIN_SALIENCE:
            rest -= float(share[peak])
        weight = np.where(near, 0.0, weight)
    return _without_images(found, units.evidence, yaw)


def _front_back_odds(units: Units, mixture: Mixture, near: NDArray[np.bool_], peak: int, yaw: float) -> list[float]:
    """Return the log-odds of directions `near` (A,) a peak against their front-back images.

    The first ones come from the units that both explain, the second ones from those that `near` explains. As in the
    estimate of a single direction, no channel can outvote all others.
    """
    grid = angles.grid()
    towards = np.flatnonzero(near & (angles.in_front(grid - yaw) == angles.in_front(grid[peak] - yaw)))
    behind = np.array([_place(180.0 - azimuth + 2 * yaw) for azimuth in grid[towards]])
    both = np.concatenate((towards, behind))
    odds = []
    for explained in (near | np.isin(np.arange(len(near)), behind), near):
        evidence = units.weighted[:, both] * mixture.part_of(explained)[:, np.newaxis]
        scores = fuse(np.stack([np.bincount(units.channels, column) for column in evidence.T], axis=1))
        odds.append(float(np.subtract(*np.logaddexp.reduce(scores.reshape(2, -1), axis=1))))
    return odds


def _without_images(found: list[Candidate], evidence: NDArray[np.float32], yaw: float) -> list[Candidate]:
    """Return the candidates; if two have equal evidence, the one in front gets the share of both."""
    kept: list[Candidate] = []
    for candidate in sorted(found, key=lambda item: abs(float(angles.difference(item.azimuth, yaw)))):
        for index, other in enumerate(kept):
            if _equal(evidence, candidate.azimuth, other.azimuth):
                share, power = other.share + candidate.share, other.power + candidate.power
                salience = (other.share * other.salience + candidate.share * candidate.salience) / share
                kept[index] = other._replace(share=share, power=power, salience=salience)
                break
        else:
            kept.append(candidate)
    return sorted(kept, key=lambda item: -item.share)


def _equal(evidence: NDArray[np.float32], first: float, second: float) -> bool:
    return bool(np.abs(evidence[:, _place(first)] - evidence[:, _place(second)]).max() < _EQUAL)


def _place(azimuth: float) -> int:
    """Return the index of the direction of the grid that is nearest to an azimuth."""
    return round((azimuth + 175.0) / angles.SPACING) % kernels.DIRECTIONS
