"""Statistical reverberation: reverberation time, direct-to-reverberant ratio, coherence of the ears, determinism."""

from pathlib import Path

import numpy as np
import pytest
import scipy.signal

from rosafe.localization.head import Head
from rosafe.localization.localize import localize
from rosafe.localization.localizer import Localizer
from rosafe.localization.rooms import reverberation, surround
from tests.localization.conftest import modulated

RATE = 16000
HEAD = Head.sphere()


def reverberant_filters(
    head: Head, azimuth: float, rt60: float, drr_db: float, generator: np.random.Generator
) -> np.ndarray:
    """Return the impulse responses (2, samples) of both ears for a source in a room."""
    direct = head.filters(RATE).response(azimuth)
    late = reverberation(surround(head, RATE), RATE, rt60, drr_db, generator)
    late = late * np.sqrt(np.sum(direct**2)) * 10 ** (-drr_db / 20)
    response = np.zeros((2, max(direct.shape[1], late.shape[1])))
    response[:, : late.shape[1]] = late
    response[:, : direct.shape[1]] += direct
    return response


def late(azimuth: float, rt60: float, drr_db: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    response = reverberant_filters(HEAD, azimuth, rt60, drr_db, np.random.default_rng(seed))
    direct = HEAD.filters(RATE).response(azimuth)
    rest = response.copy()
    rest[:, : direct.shape[1]] -= direct
    return direct, rest


@pytest.mark.parametrize(("azimuth", "rt60", "drr_db"), [(0, 0.2, 6), (75, 0.5, 0), (-140, 0.9, -5)])
def test_energy_of_direct_sound_over_the_rest_and_its_decay(azimuth: float, rt60: float, drr_db: float) -> None:
    for seed in range(3):
        direct, rest = late(azimuth, rt60, drr_db, seed)
        assert 10 * np.log10(np.sum(direct**2) / np.sum(rest**2)) == pytest.approx(drr_db, abs=1e-6)
        decay = 10 * np.log10(np.cumsum(np.sum(rest**2, axis=0)[::-1])[::-1] / np.sum(rest**2))
        first, last = (int(np.argmax(decay < level)) for level in (-5, -30))
        assert 60 / 25 * (last - first) / RATE == pytest.approx(rt60, rel=0.15)


def test_reflections_are_sparse_at_first_and_dense_later() -> None:
    kurtosis = {}
    for part, samples in {"early": slice(16, 240), "late": slice(3200, 4000)}.items():
        rest = np.stack([late(30, 0.6, 0, seed)[1][0, samples] for seed in range(20)])
        kurtosis[part] = np.mean(rest**4) / np.mean(rest**2) ** 2
    assert kurtosis["early"] > 6
    assert kurtosis["late"] < 5


def test_late_part_is_diffuse() -> None:
    rest = late(60, 0.9, -3, 1)[1]
    frequency, coherence = scipy.signal.coherence(*rest[:, 800:10000], RATE, nperseg=256)
    assert coherence[(frequency > 60) & (frequency < 200)].mean() > 0.6
    assert coherence[frequency > 2000].mean() < 0.15


def test_equal_generators_give_equal_rooms_and_others_do_not() -> None:
    first, again, other = (reverberant_filters(HEAD, 10.0, 0.3, 2, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert np.array_equal(first, again)
    assert not np.allclose(first, other, atol=1e-3)


def test_directions_in_rooms(kemar: Head, kemar_model: Path) -> None:
    """At 0 dB, in rooms that training has not seen; without reverberation among the conditions half are right."""
    right = []
    for number, azimuth in enumerate(range(-165, 180, 30)):
        room = np.random.default_rng(100 + number)
        response = reverberant_filters(kemar, azimuth, room.uniform(0.2, 0.8), 0.0, room)
        sound = scipy.signal.oaconvolve(modulated(1.5, number)[np.newaxis], response, axes=-1)[:, : 3 * RATE // 2]
        found = localize(sound, RATE, kemar_model, 1.0)
        right.append(abs(found["azimuth"][-1] - azimuth) <= 5)
    assert np.mean(right) >= 0.7


@pytest.mark.parametrize("drr_db", [5.0, 0.0])
def test_a_room_is_noticed_and_its_absence(kemar: Head, kemar_model: Path, drr_db: float) -> None:
    """The decision lasts from the first second on, also in noise, and a room that begins ends it."""
    dry = modulated(4.0, 3)
    direct = kemar.render(dry, RATE, 40.0)
    noise = np.random.default_rng(4).standard_normal(direct.shape) * np.std(direct) * 10 ** (-15 / 20)
    response = reverberant_filters(kemar, 40.0, 0.4, drr_db, np.random.default_rng(2))
    room = scipy.signal.oaconvolve(dry[np.newaxis], response, axes=1)[:, : len(dry)]
    localizer = Localizer(RATE, kemar_model)
    decisions = []
    for sound in (direct + noise, room + noise, direct + noise):
        for begin in range(0, sound.shape[1], RATE // 10):
            localizer.process(sound[:, begin : begin + RATE // 10])
            decisions.append(localizer._evidence.surroundings.dry)
    first, second, third = (decisions[begin : begin + 40] for begin in (0, 40, 80))
    assert all(first[12:]) and not any(second[12:]) and all(third[22:]), decisions


def test_sums_of_noisy_sound_without_a_room_have_its_tables(kemar: Head, kemar_model: Path) -> None:
    """Those of all frames of the window, also of the frames before it was noticed."""
    sound = kemar.render(modulated(2.0, 3), RATE, 40.0)
    sound += np.random.default_rng(4).standard_normal(sound.shape) * np.std(sound)
    localizer = Localizer(RATE, kemar_model, 1.0)
    counts = set()
    for number, begin in enumerate(range(0, sound.shape[1], RATE // 10)):
        localizer.process(sound[:, begin : begin + RATE // 10])
        window, model = localizer._evidence, localizer.model
        rows = model.rows(window._cues.select(slice(window.filled)), window._floor)
        of_frames = [table[row] for table, row in zip(model.dry[:2], rows, strict=True)]
        expected = np.sum(of_frames, axis=(0, 1), dtype=np.float64)
        if not window.surroundings.room:
            np.testing.assert_allclose(window.sums(), expected, atol=1e-9)
        counts.add((window.surroundings.room, window.surroundings.dry))
        assert number < 19 or not window.surroundings.room
    assert counts == {(True, False), (False, False)}


def test_noise_has_the_tables_of_rooms(kemar: Head, kemar_model: Path) -> None:
    """The factor of the evidence without a room would make sources of noise that is as loud as the source."""
    direct = kemar.render(modulated(4.0, 3), RATE, 40.0)
    localizer = Localizer(RATE, kemar_model)
    decisions = []
    for ratio_db in (20, 0):
        noise = np.random.default_rng(4).standard_normal(direct.shape) * np.std(direct) * 10 ** (-ratio_db / 20)
        for begin in range(0, direct.shape[1], RATE // 10):
            localizer.process((direct + noise)[:, begin : begin + RATE // 10])
            decisions.append(localizer._evidence.surroundings.dry)
    assert all(decisions[12:40]) and not any(decisions[60:]), decisions
