"""Streams while sound arrives: those of the library, at the right times and numbers, only while they are used."""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
import weakref
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rosafe.audio.stream.ring import AudioRing
from rosafe.audio.stream.ring_sound import RingSound
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.head import Head
from rosafe.localization.live_streams import LiveStreams, SoundBlock
from rosafe.localization.streams import SourcePart, SourceStreams
from tests.harness import wait_for
from tests.localization.conftest import RATE, modulated
from tests.localization.test_streams import track

CLOCK = 1000.0  # s, of the first sample


class Sound:
    """Blocks of 20 ms, of which some are lost."""

    def __init__(self, ears: np.ndarray, lost: range = range(0)) -> None:
        samples = np.round(ears * 2**31).astype(np.int32)
        blocks = [
            SoundBlock(samples[:, n : n + 320], n, CLOCK + n / RATE) for n in range(0, samples.shape[1] - 319, 320)
        ]
        self._blocks = iter([block for number, block in enumerate(blocks) if number not in lost])
        self.closed = threading.Event()
        self.at_end = False

    def read(self, seconds: float) -> SoundBlock | None:
        block = next(self._blocks, None)
        if block is None:
            self.at_end = True
            time.sleep(0.01)
        return block

    def close(self) -> None:
        self.closed.set()


class Status:
    """Keeps the last state."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *values, **_: self.lines.append(" ".join(map(str, (name, *values))))


class Session:
    """Streams with subscribers, as the test says."""

    def __init__(self) -> None:
        self.parts: list[tuple[SourcePart, float]] = []
        self.status = Status()
        self.wanted = True
        self.streams = LiveStreams(
            lambda part, moment: self.parts.append((part, moment)), lambda: self.wanted, lambda: False, self.status
        )


@pytest.fixture
def session() -> Iterator[Session]:
    found = Session()
    yield found
    found.streams.close()


@pytest.fixture(scope="module")
def ears() -> np.ndarray:
    return Head.sphere().render(modulated(3.0, 5), RATE, 40.0)


def last_time(session: Session) -> float:
    return session.parts[-1][1] if session.parts else 0.0


def test_times_numbers_and_ids(session: Session, sphere_model: Path, ears: np.ndarray) -> None:
    sound = Sound(ears, lost=range(60, 63))
    session.streams.connect(DirectionModel.load(sphere_model), lambda: sound)
    session.streams.begin_again(10)
    session.streams.update(CLOCK - 1.0, [track(1, 40.0)], 0.0)
    session.streams.start()
    wait_for(lambda: len(session.parts) > 55, what=lambda: f"parts before the loss: {session.status.lines}")
    wait_for(lambda: sound.at_end, what="the end of the sound")
    assert {part.id for part, _ in session.parts} == {11}
    first = [(part, moment) for part, moment in session.parts[:50]]
    assert first[0][0].first_sample == 0
    for (before, _), (after, _) in itertools.pairwise(first):
        assert after.first_sample == before.first_sample + len(before.samples)
    offline = SourceStreams(DirectionModel.load(sphere_model), detect_speech=False)
    offline.update(-1.0, [track(1, 40.0)])
    same = np.concatenate([part.samples for part in offline.process(np.round(ears * 2**31).astype(np.int32))])
    live = np.concatenate([part.samples for part, _ in first])
    assert np.array_equal(live, same[: len(live)]), "those of a file"
    heard = live[RATE // 10 :] / 2**15
    begin = round((first[0][1] - CLOCK) * RATE) + RATE // 10
    truth = ears[0, begin : begin + len(heard)]
    assert np.sum((heard - truth) ** 2) < 0.05 * np.sum(truth**2), "the stamp of a part is that of its first sample"
    assert all(moment - CLOCK < 1.2 for _, moment in session.parts), "after the loss the streams begin again"
    assert not np.isfinite(session.streams.speech(11)) or session.streams.speech(11) <= 1


def test_sound_is_read_for_subscribers_only(session: Session, sphere_model: Path, ears: np.ndarray) -> None:
    opened: list[Sound] = []

    def open_sound() -> Sound:
        opened.append(Sound(ears))
        return opened[-1]

    session.wanted = False
    session.streams.connect(DirectionModel.load(sphere_model), open_sound)
    session.streams.start()
    session.streams.update(CLOCK, [track(1, 40.0)], 0.0)
    session.wanted = True
    wait_for(lambda: session.parts, what=lambda: f"parts: {session.status.lines}")
    session.wanted = False
    wait_for(opened[0].closed.is_set, what="the end of the subscription")
    assert len(opened) == 1
    session.wanted = True
    wait_for(lambda: len(opened) == 2, what="another subscription")
    session.streams.connect(None)
    wait_for(opened[1].closed.is_set, what="the end of the sound")
    sounds = [weakref.ref(sound) for sound in opened]
    opened.clear()
    wait_for(lambda: [sound() for sound in sounds] == [None] * 2, what="none is kept")


def test_the_first_times_are_those_of_another_stream(session: Session, sphere_model: Path, ears: np.ndarray) -> None:
    """Updates that were placed by them do not hide later ones."""
    sound = Sound(ears)
    blocks = [block._replace(time=block.time - 10 * (block.first < 1000)) for block in sound._blocks]
    sound._blocks = iter(blocks)
    session.streams.connect(DirectionModel.load(sphere_model), lambda: sound)
    session.streams.update(CLOCK, [], 0.0)
    read = sound.read

    def read_and_update(seconds: float) -> SoundBlock | None:
        block = read(seconds)
        if block is not None:
            session.streams.update(CLOCK + block.first / RATE, [track(1, 40.0)], 0.0)
        return block

    sound.read = read_and_update  # type: ignore[method-assign]
    session.streams.start()
    wait_for(lambda: len(session.parts) > 20, what=lambda: f"parts: {session.status.lines}")
    assert session.parts[0][1] < CLOCK + 0.2


def test_streams_wait_for_late_tracks(session: Session, sphere_model: Path, ears: np.ndarray) -> None:
    """Those of a busy machine: the samples are the same. Tracks that come no more delay them once only."""
    sound = Sound(ears)
    offline = SourceStreams(DirectionModel.load(sphere_model), detect_speech=False)
    updates = [(0.1 * number, [track(1, 40.0)] if number > 6 else []) for number in range(20)]
    for moment, tracks in updates:
        offline.update(moment, tracks)
    same = offline.process(np.round(ears * 2**31).astype(np.int32))
    session.streams.connect(DirectionModel.load(sphere_model), lambda: sound)
    session.streams.update(CLOCK, [], 0.0)
    session.streams.start()
    for moment, tracks in updates[1:]:
        wait_for(lambda before=moment - 0.1: session.streams._updates._needed > CLOCK + before)  # type: ignore[misc]
        session.streams.update(CLOCK + moment, tracks, 0.0)
    wait_for(lambda: sound.at_end, what="the end of the sound")
    assert len(session.parts) > 100 and len(session.parts) == len(same)
    for (part, _), expected in zip(session.parts, same, strict=True):
        assert (part.first_sample, part.time) == (expected.first_sample, pytest.approx(expected.time))
        assert np.array_equal(part.samples, expected.samples)


def test_a_block_without_a_time_is_kept() -> None:
    ring = AudioRing(lambda line: None)
    known: list[bool] = []

    def time_of(frame: int) -> float:
        if not known:
            raise LookupError
        return CLOCK + frame / RATE

    window = SimpleNamespace(sampleRate=RATE, nChunksOnPort=1, nFramesPerChunk=320, stamp={"sec": 0, "nsec": 0})
    with contextlib.closing(RingSound(ring, RATE, time_of)) as sound:
        feed = ring.connect()

        def fill(block: int) -> None:
            window.left = window.right = np.full(320, block, np.int32)
            window.lastFrameIndex = 320 * (block + 1)
            feed(window)

        fill(0)
        assert [sound.read(0.01) for _ in range(3)] == [None] * 3
        fill(1)
        known.append(True)
        blocks = [wait_for(lambda: sound.read(0.01)) for _ in range(2)]
    assert [(block.first, block.samples[0, 0]) for block in blocks if block] == [(0, 0), (320, 1)]


@pytest.mark.parametrize("late", [False, True], ids=["in time", "after the step"])
def test_a_clock_that_is_set_back(session: Session, sphere_model: Path, ears: np.ndarray, late: bool) -> None:
    """Updates with times of the old clock, also those that come after the step, do not hide the new ones."""
    sound, step = Sound(ears), RATE // 320 * 320
    sound._blocks = iter([block._replace(time=block.time - 100 * (block.first >= step)) for block in sound._blocks])
    session.streams.connect(DirectionModel.load(sphere_model), lambda: sound)
    read = sound.read

    def read_and_update(seconds: float) -> SoundBlock | None:
        block = read(seconds)
        if block is not None:
            old = block.first < step + 1600 * late
            moment = CLOCK - (0 if old else 100) + block.first / RATE
            session.streams.update(moment, [track(1, 40.0)], 0.0)
        return block

    sound.read = read_and_update  # type: ignore[method-assign]
    session.streams.start()
    wait_for(lambda: sound.at_end, what=lambda: f"the end: {session.status.lines}")
    after = [part for part, moment in session.parts if moment < CLOCK - 50]
    assert sum(len(part.samples) for part in after) > 1.3 * RATE
