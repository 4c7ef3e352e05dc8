"""The kernels of precedence: windowed frames, summed spectra, correlations of filtered frames."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import MAX_LANES, REAL_SIZE, FloatArray, FrameReader, Transform, _address, _function

TAPS = 6  # of a filter that removes an echo
INTERLEAVED_ROWS = 8  # rows that are interleaved in memory


class Windowed(NamedTuple):
    """Windowed frames of both ears with their sums, peaks and energies."""

    samples: FloatArray  # (F, 2, C, w)
    sums: FloatArray  # over channels, (F, 2, w)
    peaks: FloatArray  # the largest sample of each frame, (F, 2, C)
    energies: FloatArray  # the sum of squares of each frame, (F, 2, C)

    @classmethod
    def allocate(cls, frames: int, channels: int, size: int) -> Windowed:
        """Return uninitialised arrays."""
        each = (frames, 2, channels)
        return cls(np.empty((*each, size)), np.empty((frames, 2, size)), np.empty(each), np.empty(each))

    def first(self, frames: int) -> Windowed:
        """Return a view of the first frames."""
        return Windowed(*(array[:frames] for array in self))


class Taps(NamedTuple):
    """Filters y[t] = sum_i values[i] x[t - shifts[i]]; y starts with x and is shifts[-1] samples longer."""

    shifts: NDArray[np.int64]  # (..., TAPS), ascending
    values: FloatArray  # (..., TAPS)

    def of(self, *place: Any) -> Taps:
        """Return the filters at an index."""
        return Taps(self.shifts[place], self.values[place])


def windowed(frames: FrameReader, output: Windowed) -> None:
    """Write the frames of (2, C, N), multiplied by their weights, to `output`; the tail is not written.

    The equivalent is `rosafe.representations.precedence.windowed`.
    """
    _function("rosafe_windowed")(frames.packed, *map(_address, output))


def add_spectra(
    samples: FloatArray, points: int, gains: FloatArray, factors: FloatArray, power: FloatArray
) -> FloatArray:
    """Compute `rosafe.representations.precedence.add_spectra` with a power of 2 up to MAX_POINTS points; w is even."""
    count, ears, channels, size = samples.shape
    transform = Transform.of(points)
    sums, factors = np.empty((count, ears, power.shape[1])), np.ascontiguousarray(factors)
    _function("rosafe_add_spectra")(
        _address(samples),
        channels,
        count,
        size,
        *map(_address, (gains, factors)),
        transform.points,
        *map(_address, (transform.twiddles, transform.places, transform.turns, power, sums)),
    )
    return sums


def correlate_filtered(
    left: FloatArray, left_taps: Taps, right: FloatArray, right_taps: Taps, reach: int
) -> tuple[FloatArray, FloatArray]:
    """Compute `rosafe.representations.precedence.correlate_filtered` for at most MAX_LAGS lags."""
    count, rows, size = left.shape
    correlations, energies = np.empty((count, rows, 2 * reach + 1)), np.empty((2, count, rows))
    longest = size + max(0, int(left_taps.shifts.max(initial=0)), int(right_taps.shifts.max(initial=0)))
    scratch = np.empty(2 * MAX_LANES * (size + reach) + 2 * longest)
    filters = [np.ascontiguousarray(array) for taps in (left_taps, right_taps) for array in taps]
    _function("rosafe_correlate_filtered")(
        _address(left),
        *(step // REAL_SIZE for step in left.strides[:2]),
        *map(_address, filters[:2]),
        _address(right),
        *(step // REAL_SIZE for step in right.strides[:2]),
        *map(_address, filters[2:]),
        count,
        rows,
        size,
        left_taps.shifts.shape[1] < rows,
        reach,
        longest,
        *map(_address, (scratch, correlations, energies)),
    )
    return correlations, energies
