"""Rectangular rooms: decay, energy and directions of reflections; moving sources and a turning head in scenes."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import scipy.signal

import rosafe
from rosafe.localization import angles
from rosafe.localization.filters import HeadFilters
from rosafe.localization.rectangular_room import JITTER, RectangularRoom, RoomReflections
from rosafe.localization.scene import SceneRenderer
from rosafe.localization.scene_file import SceneError, read_scene

RATE = 16000
SPHERE = rosafe.Head.sphere().filters(RATE)
ROOMS = [((3.0, 3.0, 2.5), 0.2), ((6.0, 5.0, 3.0), 0.4), ((10.0, 8.0, 3.5), 0.2), ((12.0, 3.0, 3.0), 0.8)]


def both(reflections: RoomReflections, azimuth: float, distance: float, yaw: float = 0.0) -> np.ndarray:
    """Return all reflections of a source (2, N)."""
    early, gain = reflections.of_source(azimuth, distance, yaw)
    whole = np.zeros((2, max(early.shape[1], reflections.tail.shape[1])))
    whole[:, : early.shape[1]] = early
    whole[:, : reflections.tail.shape[1]] += gain * reflections.tail
    return whole


def no_head() -> HeadFilters:
    """Return the filters of two microphones at one place."""
    return HeadFilters(angles.grid(), np.tile(np.eye(1, 8), (72, 2, 1)), np.zeros((72, 2)))


@pytest.mark.parametrize(("size", "rt60"), ROOMS)
def test_the_sound_decays_with_the_reverberation_time(size: tuple[float, ...], rt60: float) -> None:
    reflections = RoomReflections(RectangularRoom(size, rt60), SPHERE, RATE)
    found = []
    for azimuth in (0.0, 70.0, -130.0):
        energy = np.sum(both(reflections, azimuth, 0.5) ** 2, axis=0)
        decay = 10 * np.log10(np.cumsum(energy[::-1])[::-1] / np.sum(energy))
        inside = np.flatnonzero((decay < -5) & (decay > -35))
        found.append(-60 / np.polyfit(inside / RATE, decay[inside], 1)[0])
    assert np.mean(found) == pytest.approx(rt60, rel=0.1)


@pytest.mark.parametrize(("size", "rt60"), ROOMS[:3])
def test_the_energy_is_that_of_all_images(size: tuple[float, ...], rt60: float) -> None:
    """All images are listed by a mirror at each wall, until they have decayed by 60 dB."""
    head = np.array(size) * (0.45, 0.4, 0.55)
    reflections = RoomReflections(RectangularRoom(size, rt60, tuple(head)), no_head(), RATE)
    ratios, distance = [], 0.6
    for azimuth in (20.0, 160.0):
        source = head + distance * np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), 0.0])
        axes = []
        for side, at, ear in zip(size, source, head, strict=True):
            rooms = np.arange(-int(343 * rt60 / side) - 1, int(343 * rt60 / side) + 2)
            axes.append((np.abs(rooms), side * rooms + np.where(rooms % 2 == 0, at, side - at) - ear))
        orders = np.add.outer(np.add.outer(axes[0][0], axes[1][0]), axes[2][0])
        ways = np.sqrt(np.add.outer(np.add.outer(axes[0][1] ** 2, axes[1][1] ** 2), axes[2][1] ** 2))
        reflected = (orders > 0) & (ways < 343 * rt60)
        expected = np.sum((reflections.reflection ** orders[reflected] * distance / ways[reflected]) ** 2)
        ratios.append(np.sum(both(reflections, azimuth, distance)[0] ** 2) / expected)
    assert 10 * np.log10(np.mean(ratios)) == pytest.approx(0, abs=1)


def test_the_first_reflection_has_its_delay_and_side() -> None:
    """The head looks along the wall on its left, 0.5 m away; the source is 2 m ahead."""
    room = RectangularRoom((8.0, 7.0, 6.0), 0.6, (3.0, 6.5, 3.0))
    for yaw, louder in ((0.0, 0), (180.0, 1)):
        early = RoomReflections(room, SPHERE, RATE).early(0.0, 2.0, yaw)
        way = np.hypot(2.0, 1.0)
        first = SPHERE.response(0.0)[0].argmax() + (way - 2.0) / 343 * RATE
        energy = np.sum(early[:, : round(first + 0.002 * RATE)] ** 2, axis=1)
        peak = np.abs(early[:, : round(first + 0.002 * RATE)]).max(axis=0).argmax()
        assert energy.argmax() == louder and abs(peak - first) < 0.0004 * RATE + JITTER / 343 * RATE
    expected = SPHERE.response(round(float(np.degrees(np.arcsin(1 / way))) / 5) * 5.0)
    early = RoomReflections(room, SPHERE, RATE).early(0.0, 2.0)[:, : round(first + 0.002 * RATE)]
    gain = np.sqrt(np.sum(early**2) / np.sum(expected**2))
    assert gain == pytest.approx(RoomReflections(room, SPHERE, RATE).reflection * 2.0 / way, rel=0.1)


def test_an_elevated_reflection_has_its_lateral_angle() -> None:
    """Floor and ceiling are near, the walls far: the first reflection of a source at the left is above and below."""
    room = RectangularRoom((20.0, 20.0, 2.0), 0.4)
    early = RoomReflections(room, no_head(), RATE).early(90.0, 1.0)
    assert early[0].argmax() == pytest.approx((np.hypot(1, 2) - 1) / 343 * RATE, abs=JITTER / 343 * RATE + 1)
    sphere = RoomReflections(room, SPHERE, RATE)
    left, right = (np.sum(sphere.early(azimuth, 1.0)[:, : RATE // 100] ** 2, axis=1) for azimuth in (90.0, -90.0))
    lateral = SPHERE.response(round(float(np.degrees(np.arcsin(1 / np.hypot(1, 2)))) / 5) * 5.0)
    assert 10 * np.log10(left[0] / left[1]) == pytest.approx(
        10 * np.log10(np.divide(*np.sum(lateral**2, axis=1))), abs=1.5
    )
    assert left == pytest.approx(right[::-1], rel=0.05)


@pytest.mark.parametrize("azimuth", [0.0, 75.0, -140.0])
def test_a_given_ratio_of_direct_to_reverberant_energy(azimuth: float) -> None:
    for seed, drr_db in itertools.product((1, 2), (-5.0, 3.0)):
        room = RectangularRoom.drawn(0.4, drr_db, seed)
        rest = both(RoomReflections(room, SPHERE, RATE, seed), azimuth, 1.5)
        direct = np.sum(SPHERE.response(azimuth) ** 2)
        assert 10 * np.log10(direct / np.sum(rest**2)) == pytest.approx(drr_db, abs=1e-6)


# --- scenes -----------------------------------------------------------------------------------------------------


def scene(folder: Path, text: str) -> SceneRenderer:
    path = folder / "scene.yaml"
    path.write_text(f"sample_rate: {RATE}\n{text}")
    return SceneRenderer(read_scene(path))


def test_a_static_source_is_convolved_with_all_its_reflections(tmp_path: Path) -> None:
    text = "seed: 4\nroom: {{{}}}\nsources: [{{signal: noise, azimuth: 40, distance: 2, end: 0.6, level_db: -20}}]"
    for room in ("rt60: 0.3, size: [5, 6, 3]", "rt60: 0.3, drr_db: 2"):
        renderer = scene(tmp_path, text.format(room))
        ears, description = renderer.frames(RATE), renderer.scene
        assert description.room is not None
        dry = 0.1 * description.sources[0].signal.samples(0, RATE) * (np.arange(RATE) < 0.6 * RATE)
        distance = 2.0 if "size" in room else 1.5
        response = both(RoomReflections(description.room, SPHERE, RATE, 4), 40.0, distance)
        response[:, : SPHERE.length] += SPHERE.response(40.0)
        expected = scipy.signal.fftconvolve(dry[np.newaxis], response, axes=-1)[:, :RATE]
        assert np.abs(ears - expected).max() < 1e-9 * np.abs(ears).max() + 1e-12


def test_reflections_stay_in_the_world_when_the_head_turns(tmp_path: Path) -> None:
    """After the turn, and after a walk, the sound is that of a head and a source that have always been there."""
    text = "room: {{rt60: 0.2, size: [5, 4, 3]}}\nhead_yaw: {}\nsources: [{{signal: noise, azimuth: {}}}]"
    moved = scene(tmp_path, text.format("[[0, 43], [0.7, 50]]", "[[0, 97], [0.7, 90]]")).frames(3 * RATE)
    static = scene(tmp_path, text.format("50", "90")).frames(3 * RATE)
    assert np.abs((moved - static)[:, 2 * RATE :]).max() < 1e-9
    assert np.abs((moved - static)[:, : RATE // 2]).max() > 0.01


@pytest.mark.parametrize(
    ("room", "message"),
    [
        ("3", "room: expected lines with NAME: VALUE"),
        ("{rt60: 0.4}", "room: expected rt60, and either size or drr_db, got ['rt60']"),
        ("{size: [6, 5, 3]}", "room: expected rt60, and either size or drr_db"),
        ("{size: [6, 5, 3], rt60: 0.4, drr_db: 3}", "room: expected rt60, and either size or drr_db"),
        ("{rt60: 0.4, drr: 3}", "room: unknown 'drr'; expected one of size, rt60, drr_db"),
        ("{rt60: 0, drr_db: 3}", "room: rt60: expected a number from 0.05 to 5, got '0'"),
        ("{rt60: .nan, drr_db: 3}", "room: rt60: expected a number from 0.05 to 5, got '.nan'"),
        ("{rt60: 0.4, drr_db: .inf}", "room: drr_db: expected a number from -20 to 40, got '.inf'"),
        ("{rt60: 0.4, size: [6, 5]}", "room: size: expected three sides in m, got (6.0, 5.0)"),
        ("{rt60: 0.4, size: 6}", "room: size: expected three sides in m, got (6.0,)"),
        ("{rt60: 0.4, size: [6, 5, 0.5]}", "room: size: expected a number from 1 to 30, got '0.5'"),
        ("{rt60: 0.1, size: [30, 30, 30]}", "room: rt60: expected at least 0.18 s in a room of this size, got 0.1"),
        ("{rt60: 0.4, size: [3, 2.5, 3]}", "a: distance: expected at most 1.2 m in this room, got 1.5"),
    ],
)
def test_unsuitable_rooms_are_rejected(tmp_path: Path, room: str, message: str) -> None:
    with pytest.raises(SceneError) as caught:
        scene(tmp_path, f"room: {room}\nsources: [{{name: a, signal: noise, azimuth: [[0, 0], [1, 120]]}}]")
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_source_may_be_far_along_the_room(tmp_path: Path) -> None:
    scene(tmp_path, "room: {rt60: 0.4, size: [9, 2, 3]}\nsources: [{signal: noise, azimuth: 180, distance: 4.4}]")
    with pytest.raises(SceneError, match=r"source 1: distance: expected a number from 0\.2 to 30, got '0'"):
        scene(tmp_path, "room: {rt60: 0.4, size: [9, 2, 3]}\nsources: [{signal: noise, distance: 0}]")
