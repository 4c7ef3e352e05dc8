"""Measurements of the horizontal plane: one for each direction, and whether their labels agree with the sound."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from typing import NamedTuple

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray

MAX_ELEVATION = 3.0  # degrees; measurements up to here belong to the horizontal plane
DISTANCE_TOLERANCE = 0.05  # relative; measurements whose distances differ by less belong together
MAX_GAP = 30.0  # degrees between neighbouring directions
EDGE = 2.5  # degrees by which the front half may be missed or exceeded
_SAME = 0.4  # degrees; measurements that are closer have the same direction
MIN_SHADOW_DB = 3.0  # level difference from which the nearer ear is known


class ChosenDirections(NamedTuple):
    """Rows of the measurements, one for each direction."""

    rows: np.ndarray  # (A,) in the order of the azimuths
    azimuths: FloatArray  # (A,) degrees, ascending in (-180, 180]
    front_only: bool  # the directions do not surround the head, but cover its front half
    left_out: int  # directions near the horizontal plane without a measurement within the tolerances


def choose_directions(azimuths: FloatArray, elevations: FloatArray, distances: FloatArray) -> ChosenDirections:
    """Choose the measurement nearest to the horizontal plane for each direction.

    Parameters
    ----------
    azimuths, elevations : ndarray, (M,)
        Degrees relative to the head; azimuths in (-180, 180].
    distances : ndarray, (M,)
        In m. Of several distances the one with most directions is used, of equals the largest.

    Raises
    ------
    ValueError
        The directions do not cover the front half: `expected ..., got ...`.
    """
    height = np.round(np.abs(elevations), 2)
    near = height <= MAX_ELEVATION
    if not near.any():
        raise ValueError(
            f"expected directions within {MAX_ELEVATION:g} degrees of the horizontal plane, "
            f"got {height.min():g} degrees as the nearest elevation"
        )
    middle = _common_distance(azimuths[near], distances[near])
    usable = near & (np.abs(distances / middle - 1) <= DISTANCE_TOLERANCE + 1e-9)
    candidates = np.flatnonzero(usable)
    offsets = np.round(np.abs(distances[candidates] / middle - 1), 3)
    order = np.lexsort((offsets, elevations[candidates] < 0, height[candidates]))
    rows = candidates[order]
    rows = rows[_distinct(azimuths[rows], _SAME)]
    rows = rows[np.argsort(azimuths[rows])]
    found = azimuths[rows]
    gap = float(np.max(np.diff(found, append=found[0] + 360.0)))
    front_only = len(rows) < 2 or gap > MAX_GAP + 1e-6
    if front_only:
        inside = np.abs(found) <= 90 + EDGE
        rows, found = rows[inside], found[inside]
        _check_front(found, gap, middle)
    others = np.flatnonzero(height <= 2 * MAX_ELEVATION)
    step = float(np.median(np.diff(found))) / 2
    beside = np.abs((azimuths[others, np.newaxis] - found + 180.0) % 360.0 - 180.0).min(axis=1) > step
    left_out = len(_distinct(azimuths[others][beside], step))
    return ChosenDirections(rows, found, front_only, left_out)


def _check_front(azimuths: FloatArray, gap: float, distance: float) -> None:
    covered = len(azimuths) > 1 and azimuths[0] <= -90 + EDGE and azimuths[-1] >= 90 - EDGE
    if covered and float(np.diff(azimuths).max()) <= MAX_GAP + 1e-6:
        return
    raise ValueError(
        f"expected directions all around the head or from -90 to 90 degrees, at most {MAX_GAP:g} degrees apart, within "
        f"{MAX_ELEVATION:g} degrees of the horizontal plane and {100 * DISTANCE_TOLERANCE:g} % of one distance, "
        f"got a gap of {gap:g} degrees at {distance:.3g} m"
    )


def _common_distance(azimuths: FloatArray, distances: FloatArray) -> float:
    """Return the median of the range of distances that has most directions."""
    order = np.argsort(distances)[::-1]
    values, bins = distances[order], np.round(azimuths[order] / _SAME + 0.25).astype(int)
    inside: Counter[int] = Counter()
    best, low, first = 0, float(values[0]), 0
    for value, place in zip(values, bins.tolist(), strict=True):
        inside[place] += 1
        while values[first] > value * (1 + 2 * DISTANCE_TOLERANCE) + 1e-9:
            inside[bins[first]] -= 1
            if not inside[bins[first]]:
                del inside[bins[first]]
            first += 1
        if len(inside) > best:
            best, low = len(inside), float(value)
    inside_range = (values >= low) & (values <= low * (1 + 2 * DISTANCE_TOLERANCE) + 1e-9)
    return float(np.median(values[inside_range]))


def _distinct(azimuths: FloatArray, spacing: float) -> list[int]:
    """Return the indices of azimuths, in their order, that are at least `spacing` degrees from those before."""
    taken: list[float] = []
    chosen = []
    for index, azimuth in enumerate(azimuths.tolist()):
        place = bisect_left(taken, azimuth)
        beside = (taken[place - 1], taken[place % len(taken)]) if taken else ()
        if all(abs((azimuth - other + 180.0) % 360.0 - 180.0) >= spacing for other in beside):
            taken.insert(place, azimuth)
            chosen.append(index)
    return chosen


def near_ear_gain(azimuths: FloatArray, responses: FloatArray, sample_rate: float) -> float:
    """Return by how many dB the ear that the labels call nearer is louder, for sources at the sides.

    Parameters
    ----------
    azimuths : ndarray, (A,)
        Degrees, left positive.
    responses : ndarray, (A, 2, N)
        Left and right ear.
    sample_rate : float
        In Hz. The level is that from 4 to 8 kHz, or in the highest octave below half of a lower sample rate.
    """
    top = min(8000.0, sample_rate / 2)
    frequencies = np.fft.rfftfreq(responses.shape[2], 1 / sample_rate)
    band = (frequencies >= top / 2) & (frequencies <= top)
    side = np.abs(np.sin(np.radians(azimuths))) > 0.7
    power = np.array([[np.sum(np.abs(np.fft.rfft(ear)[band]) ** 2) for ear in pair] for pair in responses[side]])
    power = np.maximum(power, 1e-12 * power.max(initial=1e-30))
    level, left = 10 * np.log10(power[:, 0] / power[:, 1]), azimuths[side] > 0
    return float(level[left].mean() - level[~left].mean()) / 2 if left.any() and not left.all() else 0.0
