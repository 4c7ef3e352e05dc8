"""Ratemap, level difference and cross-correlation on one time axis."""

from __future__ import annotations

import numpy as np

import rosafe
from rosafe.results.view.representations import Representations
from tests.results.view.conftest import aligned


def test_series_with_different_hops_are_aligned() -> None:
    signal = np.random.default_rng(2).normal(0, 0.1, (2, 32000))
    result = rosafe.process(
        signal, 16000, parameters={"cc_hSizeSec": 0.015, "cc_wSizeSec": 0.03, "rm_hSizeSec": 0.005, "rm_wSizeSec": 0.01}
    )
    shown = aligned(result)
    assert shown.ild.shape[-1] == shown.ratemap.shape[-1] == shown.correlation.shape[-1] == len(shown.times) > 150
    frame = 80
    nearest = np.abs((1 + np.arange(result["ratemap"].shape[-1])) / 200 - shown.times[frame]).argmin()
    np.testing.assert_array_equal(shown.ratemap[..., frame], result["ratemap"][..., nearest])
    own = np.searchsorted((1 + np.arange(result["ild"].shape[-1])) / 100, shown.times[frame] - 1e-9)
    np.testing.assert_array_equal(shown.ild[..., frame], result["ild"][..., own])


def test_series_that_do_not_overlap_give_no_frames() -> None:
    def series(start: float, *shape: int) -> tuple[np.ndarray, np.ndarray]:
        return start + np.arange(50) / 100, np.ones((*shape, 50))

    shown = Representations.aligned(np.array([100.0]), np.array([0.0]), series(0, 2, 1), series(10, 1), series(20, 1))
    assert len(shown.times) == 0 and shown.ild.shape == (1, 0)
