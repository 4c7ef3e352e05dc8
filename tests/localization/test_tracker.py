"""The tracker and the mixture: birth, death, crossing, images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.localization.mixture import Candidate, Units, candidates
from rosafe.localization.tracker import Tracker
from tests.localization.conftest import RATE, modulated


def evidence(*azimuths: float) -> np.ndarray:
    """Return evidence (100, A) for some azimuths."""
    units = np.zeros((100, 72), np.float32)
    units[:, [round((azimuth + 175) / 5) for azimuth in azimuths]] = 10.0
    return units


def units(evidence: np.ndarray, powers: Any = 0.02, salient: Any = True) -> Units:
    """Return units (U, A) of ten channels."""
    count = len(evidence)
    return Units(
        evidence, evidence, np.arange(count) % 10, np.broadcast_to(powers, count), np.broadcast_to(salient, count)
    )


def test_equal_directions_are_one_candidate_in_front_of_the_head() -> None:
    for yaw, azimuth in ((0.0, 40.0), (180.0, 140.0)):
        (found,) = candidates(units(evidence(40, 140)), yaw)
        assert found.azimuth == azimuth
        assert abs(found.share - 1) < 0.1 and abs(found.power - 2) < 0.1  # those of both
        assert abs(found.odds) < 1e-6


def test_a_candidate_has_the_power_of_its_units() -> None:
    both = np.concatenate((evidence(40), evidence(-60), evidence(-60)))
    source, noise = candidates(
        units(both, np.repeat([0.03, 0.01], [100, 200]), np.repeat([True, False], [100, 200])), 0
    )
    assert (round(source.azimuth), round(noise.azimuth)) == (40, -60)
    assert abs(source.power - 3) < 0.1 and abs(noise.power - 2) < 0.1
    assert source.salience > 0.9 and noise.salience < 0.1
    assert source.share > 0.8  # of the evidence without that of the noise


def test_a_candidate_has_odds_against_its_image() -> None:
    """Those of all units of both, with the weights for sums; the head is turned by 30 degrees."""
    parts = units(np.concatenate((evidence(40), evidence(-160), evidence(-160))))
    weighted = np.where(parts.evidence > 0, 0.2, 0).astype(np.float32)  # per channel: 10 and 20 units, times 0.1
    image, source = sorted(candidates(parts._replace(weighted=weighted), 30.0), key=lambda one: -one.azimuth)
    assert (round(source.azimuth), round(image.azimuth)) == (-160, 40)
    posterior = np.exp([0.2, 0.4, *[0] * 8]) / np.exp([0.2, 0.4, *[0] * 8]).sum()
    first, second = 10 * np.log(0.7 * posterior[:2] + 0.3 / 10)
    others = 10 * np.log(0.7 * posterior[2] + 0.3 / 10) + np.log(4)
    expected = np.logaddexp(second, others) - np.logaddexp(first, others)
    assert expected > 0.5 and abs(source.odds - expected) < 0.01 and abs(image.odds + expected) < 0.01


def run(azimuths: list[list[float]], share: float = 0.5) -> Tracker:
    """Return a tracker after updates every 0.1 s with candidates at these azimuths."""
    tracker = Tracker()
    for number, now in enumerate(azimuths):
        tracker.update([Candidate(azimuth, share) for azimuth in now], 0.1 * number)
    return tracker


def test_birth_and_death() -> None:
    tracker = run([[30.0]] * 20 + [[]] * 20)
    (track,) = tracker.histories()
    present = track["time"][track["probability"] > 0.5]
    assert present[0] <= 0.31 and 1.9 <= present[-1] <= 2.6
    assert track["last_time"] == 0.1 * 19 and np.allclose(track["azimuth"][:20], 30, atol=0.1)
    assert not tracker.tracks


def test_a_pause_does_not_end_a_source() -> None:
    tracker = run([[30.0]] * 10 + [[]] * 2 + [[30.0]] * 10)
    assert len(tracker.histories()) == 1 and len(tracker.present()) == 1


def test_single_candidates_are_not_present() -> None:
    assert not run([[30.0], [], [], [-60.0], [], [], [110.0], []], share=0.25).histories()


def test_a_moving_source_is_one_track() -> None:
    tracker = run([[-170.0 - 2 * k] for k in range(30)])  # across 180 degrees
    (track,) = tracker.histories()
    assert abs((track["azimuth"][-1] - 132 + 180) % 360 - 180) < 3


def test_crossing_sources_keep_their_numbers() -> None:
    first, second = np.linspace(-40, 40, 80), np.linspace(40, -40, 80)
    azimuths = [
        [a, b] if abs(a - b) > 15 else [(a + b) / 2] for a, b in zip(first.tolist(), second.tolist(), strict=True)
    ]
    tracks = run(azimuths).histories()
    assert len(tracks) == 2
    for track in tracks:
        assert np.sign(track["azimuth"][0]) != np.sign(track["azimuth"][-1])
        assert abs(track["azimuth"][-1]) > 30


def test_a_source_moves_on_while_its_candidate_is_that_of_a_louder_one() -> None:
    """It passes a source that stays, and is hidden by it for 1.8 s, in which it shifts its candidate."""
    moving = np.linspace(-40, 60, 60)
    azimuths = [[10.0, a] if abs(a - 10) > 15 else [10 + 3 * np.sign(a - 10)] for a in moving.tolist()]
    tracks = run(azimuths).histories()
    assert len(tracks) == 2
    moved, stayed = sorted(tracks, key=lambda track: -np.ptp(track["azimuth"]))
    assert abs(moved["azimuth"][0] + 40) < 3 and abs(moved["azimuth"][-1] - 60) < 3
    assert np.abs(stayed["azimuth"] - 10).max() < 2


def test_a_source_that_ends_near_another_one_is_no_longer_present() -> None:
    approach = [[10.0, a] for a in [*np.linspace(-40, -3, 25).tolist(), *[-3.0] * 20]]
    tracks = run([*approach, *[[10.0]] * 60]).histories()
    ends = sorted(float(track["time"][track["probability"] > 0.5][-1]) for track in tracks)
    assert len(ends) == 2 and ends[0] < 4.5 + 4.0 < 10.4 == pytest.approx(ends[1])


def present_at_end(candidates: Sequence[Mapping[float, Any]]) -> list[float]:
    """Return the azimuths of the sources that are present after updates with candidates.

    They are shares, or shares and odds, by azimuth.
    """
    tracker = Tracker()
    for number, now in enumerate(candidates):
        found = {azimuth: one if isinstance(one, tuple) else (one, 0.0) for azimuth, one in now.items()}
        tracker.update([Candidate(azimuth, one[0], odds=one[1]) for azimuth, one in found.items()], 0.1 * number)
    return sorted(round(track.azimuth) for track in tracker.present())


def test_an_image_that_appears_with_its_source_is_not_a_source() -> None:
    assert present_at_end([{30.0: (0.45, 1), 150.0: (0.5, -1)}] * 20) == [30]
    assert present_at_end([{-10.0: 0.45, -170.0: 0.4}] * 20) == [-10]
    assert present_at_end([{-150.0: (0.6, -1)}] * 5 + [{-150.0: (0.4, -6), -30.0: (0.4, 6)}] * 30) == [-30]
    assert present_at_end([{99.0: (0.5, -6), 84.0: (0.3, 6)}] * 20) == [84]


def test_mirrored_sources_are_both_found() -> None:
    """The cues are clearly those of one, and later those of the other: less than 2 s apart."""
    either: list[Any] = [{30.0: (0.5, 6), 150.0: (0.3, -6)}] * 8 + [{30.0: (0.3, -6), 150.0: (0.5, 6)}] * 8
    assert present_at_end(either * 3) == [30, 150]
    assert present_at_end(either + either[:8] * 4) == [30]  # the other one was last clear more than 2 s ago
    assert present_at_end([{80.0: 0.5, 108.0: 0.2}] * 20) == [80, 108]  # mirrored to 72: not the image of 80


def test_a_known_source_needs_less_evidence() -> None:
    weak = {30.0: 0.6, -20.0: 0.11}
    assert present_at_end([weak] * 40) == [30]
    assert present_at_end([{30.0: 0.5, -20.0: 0.3}] * 10 + [weak] * 40) == [-20, 30]
    assert present_at_end([{30.0: 0.5, -20.0: 0.3}] * 10 + [{30.0: 0.6}] * 20) == [30]


def test_a_talker_in_noise_has_no_image(kemar_model: Path, kemar: rosafe.Head) -> None:
    random = np.random.default_rng(7)
    noise = 0.01 * random.standard_normal((2, 4 * RATE))
    for azimuth in (-170, -50, 10, 110):
        sound = kemar.render(modulated(4.0, 3), RATE, azimuth)
        tracks = rosafe.localize(sound + noise * np.std(sound) / 0.03, RATE, kemar_model)["tracks"]
        azimuths = [float(np.median(track["azimuth"])) for track in tracks]
        assert len(azimuths) == 1 and abs(azimuths[0] - azimuth) < 10


def test_two_talkers(kemar_model: Path, kemar: rosafe.Head) -> None:
    sound = kemar.render(modulated(4.0, 1), RATE, 40) + kemar.render(modulated(4.0, 2), RATE, -20)
    tracks = rosafe.localize(sound, RATE, kemar_model)["tracks"]
    azimuths = sorted(float(np.median(track["azimuth"])) for track in tracks if len(track["time"]) > 20)
    assert len(azimuths) == 2 and np.allclose(azimuths, [-20, 40], atol=10)
