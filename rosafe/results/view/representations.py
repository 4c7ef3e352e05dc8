"""Ratemap, level difference and cross-correlation on one time axis, from the ports of a node."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Representations:
    """Ratemap, level difference and cross-correlation of one binaural signal, frame by frame.

    Attributes
    ----------
    times : ndarray, (F,)
        Centres of the frames in seconds, evenly spaced.
    center_frequencies : ndarray, (C,)
        Hz, in the order of the channels.
    lags : ndarray, (L,)
        Seconds; positive if the sound reaches the left ear later.
    ratemap : ndarray, (2, C, F)
        Power, left and right ear.
    ild : ndarray, (C, F)
        dB, positive if the right ear is louder.
    correlation : ndarray, (L, F)
        Cross-correlation, averaged over the channels.
    """

    times: np.ndarray
    center_frequencies: np.ndarray
    lags: np.ndarray
    ratemap: np.ndarray
    ild: np.ndarray
    correlation: np.ndarray

    @classmethod
    def aligned(
        cls,
        center_frequencies: np.ndarray,
        lags: np.ndarray,
        ratemap: tuple[np.ndarray, np.ndarray],
        ild: tuple[np.ndarray, np.ndarray],
        correlation: tuple[np.ndarray, np.ndarray],
    ) -> Representations:
        """Align three series, each (times, data), to the times of `ild`: the nearest frame of each series is used.

        Times that are not covered by all series are omitted.
        """
        series = (ratemap, ild, correlation)
        if any(len(times) == 0 for times, _ in series):
            times = np.zeros(0)
        else:
            slack = 0.5 * max((t[-1] - t[0]) / max(1, len(t) - 1) for t, _ in series) + 1e-9
            first = max(t[0] for t, _ in series) - slack
            last = min(t[-1] for t, _ in series) + slack
            times = ild[0][(ild[0] >= first) & (ild[0] <= last)]
        at_times = [data[..., _nearest(own, times)] for own, data in series]
        return cls(times, np.asarray(center_frequencies), np.asarray(lags), *at_times)


def _nearest(sorted_values: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the index of the nearest value for each target."""
    if len(sorted_values) == 0 or len(targets) == 0:
        return np.zeros(0, int)
    right = np.clip(np.searchsorted(sorted_values, targets), 1, max(1, len(sorted_values) - 1))
    right = np.minimum(right, len(sorted_values) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(targets - sorted_values[left] <= sorted_values[right] - targets, left, right)
