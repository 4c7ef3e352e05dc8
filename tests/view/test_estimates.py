"""Where the source is: against the scene's truth, real ears, mirrored ears and silence."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

import rosafe
from rosafe.bass.sources.scene import Scene, scene_azimuth
from rosafe.sound.head import HEAD_RADIUS, SPEED_OF_SOUND
from rosafe.view import estimates
from rosafe.view.representations import Representations
from tests.view.conftest import WALK, represented

Estimate = Callable[[Representations], np.ndarray]
Speech = tuple[str, np.ndarray, Representations]
ESTIMATES = pytest.mark.parametrize(
    "estimate, typical, largest",
    [(estimates.azimuth_from_ild, 3.0, 20.0), (estimates.azimuth_from_correlation, 2.0, 8.0)],
    ids=["ild", "correlation"],
)


def mirrored(shown: Representations) -> Representations:
    return dataclasses.replace(shown, ratemap=shown.ratemap[::-1], ild=-shown.ild, correlation=shown.correlation[::-1])


@ESTIMATES
def test_scene_is_found_where_it_is(walk: Representations, estimate: Estimate, typical: float, largest: float) -> None:
    error = estimate(walk) - scene_azimuth(walk.times, WALK)
    assert np.sqrt(np.mean(error**2)) < typical
    assert np.abs(error).max() < largest


def test_speech_comes_from_one_side_for_both_cues(speech: Speech) -> None:
    name, _, shown = speech
    ild, correlation = estimates.azimuth_from_ild(shown), estimates.azimuth_from_correlation(shown)
    assert np.nanmedian(ild) > 10 and np.nanmedian(correlation) > 10
    assert estimates.agreement(ild, correlation) > (0.99 if "anechoic" in name else 0.85)
    if "anechoic" in name:
        assert np.nanmedian(np.abs(ild - correlation)) < 5


def test_swapped_ears_swap_the_side(speech: Speech) -> None:
    _, samples, shown = speech
    swapped = represented(samples[::-1], 16000)
    for estimate in (estimates.azimuth_from_ild, estimates.azimuth_from_correlation):
        heard, other = estimate(shown), estimate(swapped)
        assert np.array_equal(np.isnan(heard), np.isnan(other))
        np.testing.assert_allclose(other, -heard, atol=1e-6)


def test_mirrored_representations_swap_the_side(walk: Representations) -> None:
    for estimate in (estimates.azimuth_from_ild, estimates.azimuth_from_correlation):
        np.testing.assert_allclose(estimate(mirrored(walk)), -estimate(walk), atol=1e-6)


@pytest.mark.parametrize("gain", [1e-2, 30.0])
def test_level_of_the_sound_does_not_matter(gain: float) -> None:
    signal = Scene(44100, seconds=1.0).frames(44100) / 2**31
    loud, soft = represented(signal, 44100), represented(gain * signal, 44100)
    np.testing.assert_allclose(estimates.azimuth_from_ild(soft), estimates.azimuth_from_ild(loud), atol=1.01)
    np.testing.assert_allclose(
        estimates.azimuth_from_correlation(soft), estimates.azimuth_from_correlation(loud), atol=3
    )


def test_silence_holds_no_source() -> None:
    shown = represented(np.zeros((2, 16000)), 16000)
    assert len(shown.times) > 90
    from_ild, from_correlation = estimates.azimuth_from_ild(shown), estimates.azimuth_from_correlation(shown)
    assert np.isnan(from_ild).all() and np.isnan(from_correlation).all()
    assert np.isnan(estimates.agreement(from_ild, from_correlation))


def test_pauses_hold_no_source() -> None:
    signal = np.random.default_rng(1).normal(0, 0.1, 16000)
    signal[6000:12000] = 0
    heard = estimates.azimuth_from_ild(represented(np.stack((signal, signal)), 16000))
    assert np.isfinite(heard[:30]).all()
    assert np.isnan(heard[50:65]).all()
    assert np.nanmax(np.abs(heard)) <= 1


def test_sphere_has_known_limits() -> None:
    """Delays of the rigid sphere: 3a/c sin at low frequencies (Kuhn 1977) within a tenth, Woodworth's at high ones."""
    around = HEAD_RADIUS / SPEED_OF_SOUND
    angle = np.radians(30.0)
    low, high = (float(estimates.sphere_itd(np.array([f]), np.array([30.0]))[0, 0]) for f in (20.0, 20000.0))
    assert low == pytest.approx(3 * around * np.sin(angle), rel=0.1)
    assert high == pytest.approx(around * (angle + np.sin(angle)), rel=0.02)
    levels = estimates.sphere_ild(np.array([50.0, 8000.0]), np.array([-50.0, 0.0, 50.0]))
    assert levels[:, 1] == pytest.approx(0.0, abs=1e-12)
    assert levels[:, 0] == pytest.approx(-levels[:, 2])
    assert levels[0, 2] < 0.5 and 10 < levels[1, 2] < 25


def test_no_frames_give_no_estimates() -> None:
    shown = Representations.from_process(rosafe.process(np.zeros((2, 100)), 16000))
    assert len(estimates.azimuth_from_ild(shown)) == len(estimates.azimuth_from_correlation(shown)) == 0


def test_series_with_other_hops_are_brought_to_one_axis() -> None:
    signal = np.random.default_rng(2).normal(0, 0.1, (2, 32000))
    result = rosafe.process(
        signal, 16000, parameters={"cc_hSizeSec": 0.015, "cc_wSizeSec": 0.03, "rm_hSizeSec": 0.005, "rm_wSizeSec": 0.01}
    )
    shown = Representations.from_process(result)
    assert shown.ild.shape[-1] == shown.ratemap.shape[-1] == shown.correlation.shape[-1] == len(shown.times) > 150
    frame = 80
    nearest = np.abs((1 + np.arange(result["ratemap"].shape[-1])) / 200 - shown.times[frame]).argmin()
    np.testing.assert_array_equal(shown.ratemap[..., frame], result["ratemap"][..., nearest])
    own = np.searchsorted((1 + np.arange(result["ild"].shape[-1])) / 100, shown.times[frame] - 1e-9)
    np.testing.assert_array_equal(shown.ild[..., frame], result["ild"][..., own])


def test_series_that_do_not_overlap_have_nothing_in_common() -> None:
    def series(start: float, *shape: int) -> tuple[np.ndarray, np.ndarray]:
        return start + np.arange(50) / 100, np.ones((*shape, 50))

    shown = Representations.aligned(np.array([100.0]), np.array([0.0]), series(0, 2, 1), series(10, 1), series(20, 1))
    assert len(shown.times) == 0 and shown.ild.shape == (1, 0)
