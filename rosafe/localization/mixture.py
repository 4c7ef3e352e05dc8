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

SHARPNESS = 1.0  # factor of the evidence: makes the weights sparse
ITERATIONS = 20
MIN_SHARE = 0.08  # of the evidence in a window, of a candidate
MIN_UNITS = 60  # frames and channels with cues in a window
MIN_SALIENCE = 0.19  # part of the evidence for a source that is above the noise, at least; less is noise
MIN_REST = 0.4  # of the evidence, with which that of a source is compared if the rest is noise
MAX_CANDIDATES = 6
SEPARATION = 15.0  # degrees between two candidates, at least
_LIMIT = 30.0  # of a scaled log-likelihood ratio
_EQUAL = 1e-3  # log-likelihood ratio; directions that differ by less have equal evidence


class Candidate(NamedTuple):
    """A direction that explains a share of the evidence."""

    azimuth: float  # degrees
    share: float  # 0 to 1
    power: float = 0.0  # of the units that it explains, as the ratemap has it, mean over the frames
    salience: float = 1.0  # part of its evidence that is above the noise


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
        return np.asarray((self.likelihood[:, few] @ self.weights[few]) * self.inverse)


def fit(evidence: FloatArray) -> Mixture:
    """Return the mixture for the evidence (U, A) of units."""
    likelihood = np.float32(SHARPNESS) * evidence.astype(np.float32, copy=False)
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


def candidates(
    evidence: FloatArray,
    yaw: float,
    powers: FloatArray | None = None,
    salient: NDArray[np.bool_] | None = None,
) -> list[Candidate]:
    """Return the directions of sources in the evidence (U, A) in world coordinates, the strongest first.

    If several directions have equal evidence, the one in front of a head with `yaw` (degrees) is returned. The power
    of a source is the sum of the `powers` (U,) of the units that it explains, and its salience the part of these units
    that are `salient` (U,).
    """
    if len(evidence) < MIN_UNITS:
        return []
    mixture = fit(evidence)
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
        power = 0.0 if powers is None else float(part @ powers)
        salience = 1.0 if salient is None else float(part @ salient / part.sum())
        found.append(
            Candidate(
                float(angles.wrap(grid[peak] + offset)), float(share[peak] / max(rest, MIN_REST)), power, salience
            )
        )
        if salience < MIN_SALIENCE:
            rest -= float(share[peak])
        weight = np.where(near, 0.0, weight)
    return _without_images(found, evidence, yaw)


def _without_images(found: list[Candidate], evidence: FloatArray, yaw: float) -> list[Candidate]:
    """Return the candidates; if two have equal evidence, the one in front gets the share of both."""
    kept: list[Candidate] = []
    for candidate in sorted(found, key=lambda item: abs(float(angles.difference(item.azimuth, yaw)))):
        for index, other in enumerate(kept):
            if _equal(evidence, candidate.azimuth, other.azimuth):
                share, power = other.share + candidate.share, other.power + candidate.power
                salience = (other.share * other.salience + candidate.share * candidate.salience) / share
                kept[index] = Candidate(other.azimuth, share, power, salience)
                break
        else:
            kept.append(candidate)
    return sorted(kept, key=lambda item: -item.share)


def _equal(evidence: FloatArray, first: float, second: float) -> bool:
    places = [round((azimuth + 175.0) / angles.SPACING) % evidence.shape[1] for azimuth in (first, second)]
    return bool(np.abs(evidence[:, places[0]] - evidence[:, places[1]]).max() < _EQUAL)
