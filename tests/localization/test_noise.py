"""Steady noise is not a source; a moving source with a steady level is one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.localization import angles
from rosafe.localization.mixture import Candidate
from rosafe.localization.noise import MARGIN_DB, MEMORY, NoiseCalibration, SteadyNoise, measured_level
from rosafe.localization.tracker import PRESENT
from tests.localization.conftest import RATE, modulated

SECONDS = 9.0
NOISE = 120.0  # its direction; on a nearly symmetric head noise there may be reported at the image, 60 degrees


def white(seconds: float, seed: int) -> np.ndarray:
    """Return steady noise with the RMS of 0.1."""
    return 0.1 * np.random.default_rng(seed).standard_normal(round(seconds * RATE))


def talker(pause: tuple[float, float]) -> np.ndarray:
    """Return modulated noise with an RMS of 0.1, and a pause."""
    sound = modulated(SECONDS, 3)
    sound *= 0.1 / np.sqrt(np.mean(sound**2))
    sound[round(pause[0] * RATE) : round(pause[1] * RATE)] = 0.0
    return sound


def in_blocks(localizer: rosafe.Localizer, sound: np.ndarray, block: int = 4000) -> None:
    """Localize a whole sound, with enough blocks for a history."""
    for begin in range(0, sound.shape[1], block):
        localizer.process(sound[:, begin : begin + block])


def present(tracks: list[dict[str, Any]], azimuth: float) -> np.ndarray:
    """Return when a source was present within 15 degrees of a direction or of its front-back image, s."""
    image = float(np.sign(azimuth)) * 180 - azimuth
    times = [
        track["time"][
            (track["probability"] > PRESENT)
            & (
                np.minimum(
                    np.abs(angles.difference(track["azimuth"], azimuth)),
                    np.abs(angles.difference(track["azimuth"], image)),
                )
                < 15
            )
        ]
        for track in tracks
    ]
    return np.sort(np.concatenate([np.zeros(0), *times]))


@pytest.fixture(scope="module")
def noisy_talker(kemar: rosafe.Head) -> np.ndarray:
    """Return a talker at -30 degrees with a pause, and steady noise from 120 degrees, 10 dB below."""
    sound = kemar.render(talker((4.0, 6.0)), RATE, -30)
    return 0.5 * (sound + 10 ** (-10 / 20) * kemar.render(white(SECONDS, 1), RATE, NOISE))


def test_steady_noise_is_not_a_source_after_two_seconds(kemar_model: Path, noisy_talker: np.ndarray) -> None:
    tracks = rosafe.localize(noisy_talker, RATE, kemar_model)["tracks"]
    talking = present(tracks, -30)
    assert not np.any(present(tracks, NOISE) > 2.6)
    assert np.sum(talking < 4.0) >= 33 and np.sum(talking > 6.5) >= 20 and not np.any((talking > 5) & (talking < 6))


def test_sound_that_is_steady_from_its_start_is_noise_after_a_short_warm_up(
    kemar_model: Path, noisy_talker: np.ndarray
) -> None:
    localizer = rosafe.Localizer(RATE, kemar_model)
    localizer.noise.warm_up = 2
    in_blocks(localizer, noisy_talker)
    assert not len(present(localizer.tracks, NOISE)) and np.sum(present(localizer.tracks, -30) < 4.0) >= 33


def test_a_burst_of_noise_is_a_source(kemar_model: Path, kemar: rosafe.Head) -> None:
    sound = np.zeros((2, 4 * RATE))
    sound[:, RATE : 2 * RATE] = kemar.render(white(1.0, 2), RATE, 30)
    sound += 1e-4 * np.random.default_rng(5).standard_normal(sound.shape)
    found = rosafe.localize(sound, RATE, kemar_model)
    assert found["azimuth"][199] == pytest.approx(30, abs=5)
    assert len(present(found["tracks"], 30)) >= 8


def test_steady_noise_that_goes_on_is_a_source_for_two_seconds(kemar_model: Path, kemar: rosafe.Head) -> None:
    sound = kemar.render(np.concatenate((np.zeros(RATE), white(5.0, 2))), RATE, 30)
    times = present(rosafe.localize(sound, RATE, kemar_model)["tracks"], 30)
    assert 1.2 < times[0] < 1.6 and 2.8 < times[-1] < 3.8


def test_azimuths_and_posteriors_do_not_depend_on_the_noise_level(kemar_model: Path, noisy_talker: np.ndarray) -> None:
    plain, stored = (rosafe.Localizer(RATE, kemar_model) for _ in range(2))
    stored.noise.stored[:] = 200.0
    first, second = (localizer.process(noisy_talker[:, : 3 * RATE]) for localizer in (plain, stored))
    for name in ("azimuth", "confidence", "posterior", "level_db"):
        assert np.array_equal(first[name], second[name], equal_nan=True)
    assert plain.tracks and not stored.tracks


def test_tracks_do_not_depend_on_blocks(kemar_model: Path, noisy_talker: np.ndarray) -> None:
    sound = noisy_talker[:, : 6 * RATE]
    whole = rosafe.localize(sound, RATE, kemar_model)["tracks"]
    localizer = rosafe.Localizer(RATE, kemar_model)
    in_blocks(localizer, sound, 999)
    assert len(whole) == len(localizer.tracks)
    for expected, track in zip(whole, localizer.tracks, strict=True):
        assert np.allclose(expected["azimuth"], track["azimuth"]) and np.array_equal(expected["time"], track["time"])


def test_reset(kemar_model: Path, kemar: rosafe.Head) -> None:
    sound = kemar.render(white(3.0, 4), RATE, 40)
    localizer = rosafe.Localizer(RATE, kemar_model)
    in_blocks(localizer, sound)
    localizer.reset(keep_noise=True)  # as after the robot has spoken
    in_blocks(localizer, sound)
    assert not localizer.tracks
    localizer.reset()
    in_blocks(localizer, sound)
    assert localizer.tracks


def test_a_stored_level_is_known_at_once(kemar_model: Path, kemar: rosafe.Head) -> None:
    motor = np.concatenate([np.concatenate((white(1.0, seed), np.zeros(RATE // 2))) for seed in range(3)])
    sound = kemar.render(motor, RATE, 40) + 1e-4 * np.random.default_rng(5).standard_normal((2, len(motor)))
    localizer = rosafe.Localizer(RATE, kemar_model)
    in_blocks(localizer, sound)
    assert len(present(localizer.tracks, 40)) >= 20  # a motor that runs for a second is a source
    features = rosafe.process(
        kemar.render(white(2.0, 9), RATE, 40), RATE, parameters=localizer.model.parameters, outputs=["ratemap"]
    )
    calibrated = rosafe.Localizer(RATE, kemar_model)
    calibrated.noise.stored = measured_level(10 * np.log10(features["ratemap"].sum(axis=0)).T)
    in_blocks(calibrated, sound)
    assert not calibrated.tracks


def test_a_moving_source_with_a_steady_level(kemar_model: Path, kemar: rosafe.Head) -> None:
    course = np.linspace(-60, 60, 10 * RATE)
    tracks = rosafe.localize(kemar.render(white(10.0, 6), RATE, course), RATE, kemar_model)["tracks"]
    # at 10 degrees steady white noise is mirrored for some frames: a track of less than a second
    (track,) = (track for track in tracks if np.count_nonzero(track["probability"] > 0.5) > 10)
    errors = np.abs(track["azimuth"] - np.interp(track["time"], [0, 10], [-60, 60]))
    assert len(track["time"]) >= 90 and np.median(errors) < 6


def test_the_noise_level_is_the_minimum_of_two_seconds() -> None:
    floor = SteadyNoise(2)
    levels = np.random.default_rng(1).uniform(-80, -40, (60, 2))
    for number, level in enumerate(levels):
        floor.update(level)
        expected = levels[number + 1 - MEMORY : number + 1].min(axis=0) if number + 1 >= MEMORY else -np.inf
        assert np.array_equal(floor.level, np.broadcast_to(expected, 2))
    floor.stored = np.array([-30.0, -200.0])
    assert np.array_equal(floor.threshold, [-30.0 + MARGIN_DB, levels[-MEMORY:, 1].min() + MARGIN_DB])
    floor.reset()
    assert np.array_equal(floor.level, floor.stored)


@pytest.mark.parametrize(
    ("speed", "turn", "kept"), [(0.0, 0.0, 0), (6.0, 0.0, 20), (0.0, 20.0, 0), (20.0, 20.0, 0), (-10.0, 10.0, 20)]
)
def test_a_source_moves_in_the_world_and_relative_to_the_head(speed: float, turn: float, kept: int) -> None:
    steady = SteadyNoise(1)
    counts = [
        len(steady.remove_from([Candidate(-30 + speed * t, 0.5, salience=0.0)], t, float(angles.wrap(170 + turn * t))))
        for t in np.arange(0, 4, 0.1)
    ]
    assert sum(counts) >= kept and (kept or not sum(counts))
    assert steady.azimuths == ([] if kept else [-30 + speed * 3.9])
    assert len(steady.remove_from([Candidate(100, 0.5, salience=0.5)], 4.1, 0.0)) == 1 and not steady.azimuths


def test_calibration_file(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "noise.json"
    parameters = {"fb_nChannels": 4, "pp_bLevelScaling": True}
    NoiseCalibration(16000.0, parameters, np.array([-61.234, -70.0, -80.0, -90.0])).save(path)
    loaded = NoiseCalibration.load(path)
    assert loaded.parameters == parameters and np.allclose(loaded.level_db, [-61.23, -70, -80, -90])
    loaded.check(16000.0, parameters)
    with pytest.raises(ValueError, match="sample_rate: expected 16000 Hz as in the calibration, got 44100"):
        loaded.check(44100.0, parameters)
    with pytest.raises(ValueError, match="fb_nChannels: expected 4 as in the calibration, got 8"):
        loaded.check(16000.0, {**parameters, "fb_nChannels": 8})


@pytest.mark.parametrize(
    "change", [{"format": "x"}, {"level_db": []}, {"level_db": [None]}, {"level_db": 3}, {"sample_rate": "x"}, None]
)
def test_damaged_calibration_files(tmp_path: Path, change: dict[str, Any] | None) -> None:
    path = tmp_path / "noise.json"
    NoiseCalibration(16000.0, {}, np.array([-61.0])).save(path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}) if change is not None else "[" * 50_000)
    with pytest.raises(ValueError, match=r"noise\.json: expected a file of rosafe localize --calibrate-noise"):
        NoiseCalibration.load(path)
    with pytest.raises(ValueError, match="missing file; check the path, or create it with rosafe localize --cal"):
        NoiseCalibration.load(tmp_path / "other.json")
