"""The spatial filter: a source passes unchanged, another one does not, and spectra lead back to the sound."""

from __future__ import annotations

import numpy as np
import pytest

from rosafe.localization import spatial_filter
from rosafe.localization.spatial_filter import BINS, HOP, SIZE


def test_overlapping_frames_are_the_sound() -> None:
    sound = np.random.default_rng(1).standard_normal((2, 20 * HOP))
    found = np.zeros_like(sound)
    for begin in range(0, sound.shape[1] - SIZE + 1, HOP):
        frame = spatial_filter.spectrum(sound[:, begin : begin + SIZE])
        found[:, begin : begin + SIZE] += [spatial_filter.overlap(ear) for ear in frame]
    assert np.allclose(found[:, SIZE:-SIZE], sound[:, SIZE:-SIZE], atol=1e-12)


@pytest.mark.parametrize(("left", "ear"), [(1.0, 0), (0.0, 1)])
def test_a_source_passes_and_the_other_does_not(left: float, ear: int) -> None:
    random = np.random.default_rng(2)
    ways = random.standard_normal((2, 2, BINS)) + 1j * random.standard_normal((2, 2, BINS))  # source, ear
    wanted, other = (spatial_filter.covariance(way) for way in ways)
    total = wanted + other
    for scale in (1.0, 1e-20):
        wanted, total = np.multiply(scale, wanted), np.multiply(scale, total)
        found = [spatial_filter.separate(way, wanted, total, left) for way in ways]
        assert np.allclose(found[0], ways[0, ear], rtol=1e-6)
        assert np.median(np.abs(found[1]) ** 2 / np.abs(ways[1, ear]) ** 2) < 0.02


def test_the_ear_without_a_direction() -> None:
    frame = np.random.default_rng(3).standard_normal((2, BINS)) + 0j
    equal = np.repeat(np.eye(2)[..., np.newaxis], BINS, axis=2).astype(complex)
    nothing = np.zeros_like(equal)
    for wanted, total in ((equal, equal + equal), (nothing, nothing), (nothing, equal)):
        assert np.allclose(spatial_filter.separate(frame, wanted, total, 1.0), frame[0])


def test_weights_of_bins_are_interpolated_between_channels() -> None:
    weights = spatial_filter.bin_weights(np.array([500.0, 2000.0]), 16000)
    assert weights.shape == (2, BINS) and np.allclose(weights.sum(axis=0), 1)
    assert weights[0, : round(500 / 16000 * SIZE)] == pytest.approx(1) and weights[1, 60:] == pytest.approx(1)
