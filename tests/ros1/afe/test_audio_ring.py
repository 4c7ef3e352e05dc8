"""The audio ring compared with a simple model of its rules, and its threads."""

from __future__ import annotations

import dataclasses
import math
import threading
import time
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from rosafe.audio.files.windows import MAX_RATE
from rosafe.audio.stream.ring import PAUSE_SECONDS, RING_SECONDS, AudioReader, AudioRing, Counters
from tests.harness import PATIENCE, ROOT

RATE = 8  # Hz: the ring contains 80 frames
CAPACITY = int(RING_SECONDS * RATE)


@dataclass
class Source:
    """A stream whose samples identify the stream and the frame."""

    rate: int = RATE
    window: int = 12
    index: int = 0
    number: int = 1

    def sample(self, frame: int) -> int:
        return self.number * 100_000 + frame % 99_991 if frame > 0 else 0

    def message(self) -> Any:
        left = np.array([self.sample(f) for f in range(self.index - self.window + 1, self.index + 1)], np.int32)
        return message(self.rate, self.index, left)


def message(rate: int, index: int, left: np.ndarray, right: np.ndarray | None = None, **other: Any) -> Any:
    fields = {
        "sampleRate": rate,
        "lastFrameIndex": index,
        "left": left,
        "right": -left if right is None else right,
        "nChunksOnPort": 1,
        "nFramesPerChunk": len(left),
        "problem": "",
        "stamp": {"sec": 0, "nsec": 0},
    }
    return SimpleNamespace(**{**fields, **other})


def opened(ring: AudioRing, block: int) -> AudioReader:
    reader = ring.open_reader(block, 0.0, lambda: False)
    assert reader is not None
    return reader


class Model:
    """The rules in the docstring of rosafe/audio/stream/ring.py, with a dict from frame index to sample."""

    def __init__(self) -> None:
        self.rate = self.window = self.newest = 0
        self.capacity = 0
        self.frames: dict[int, int] = {}
        self.lost = self.gaps = self.streams = self.dropped = self.breaks = self.messages = self.refused = 0
        self.joint = 1
        self.position = 0
        self.block = 0
        self.reader_rate = 0

    @property
    def unread(self) -> int:
        if not self.block or self.reader_rate != self.rate:
            return 0
        return sum(frame >= self.position for frame in self.frames)

    def feed(self, source: Source) -> None:
        self.messages += 1
        index, window = source.index, source.window
        jump = index - self.newest > max(self.capacity, window)
        if self.rate == 0 or source.rate != self.rate or index < self.newest or jump:
            if self.rate == source.rate and index > self.newest:
                self.lost += index - self.newest - window
                self.gaps += 1
            self.dropped += self.unread
            self.streams += 1
            self.rate = source.rate
            self.capacity = max(int(RING_SECONDS * source.rate), window, 2 * self.block)
            self.frames = {}
            self.newest = max(0, index - window)
            self.position = self.joint = self.newest + 1
        self.capacity = max(self.capacity, window)
        self.window = window
        known = range(max(index - window + 1, self.joint), self.newest + 1)
        if any(self.frames.get(f, source.sample(f)) != source.sample(f) for f in known):
            self.breaks += 1
            self.joint = self.newest + 1
        missing = range(self.newest + 1, index - window + 1)
        if missing:
            self.lost += len(missing)
            self.gaps += 1
        for frame in range(self.newest + 1, index + 1):
            self.frames[frame] = 0 if frame in missing else source.sample(frame)
        self.newest = max(self.newest, index)
        for frame in [f for f in self.frames if f <= self.newest - self.capacity]:
            del self.frames[frame]

    def read(self) -> tuple[list[int], int]:
        oldest = min(self.frames)
        if self.position < oldest:
            self.lost += oldest - self.position
            self.gaps += 1
            self.position = oldest
        block = [self.frames[f] for f in range(self.position, self.position + self.block)]
        self.position += self.block
        return block, self.position


class RingMachine(RuleBasedStateMachine):
    """For any input, the ring and the model agree."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []
        self.ring = AudioRing(self.lines.append)
        self.feed = self.ring.connect()
        self.source = Source()
        self.model = Model()
        self.reader: AudioReader | None = None

    def send(self) -> None:
        self.feed(self.source.message())
        self.model.feed(self.source)

    @rule(frames=st.integers(0, 30))
    def play(self, frames: int) -> None:
        self.source.index += frames
        self.send()

    @rule(frames=st.sampled_from([1, 11, 13, 40, 79, 80, 81, 92, 93, 500, 10**9, 2**62]))
    def lose(self, frames: int) -> None:
        if self.source.index + frames < 2**63:
            self.source.index += frames
            self.send()

    @rule()
    def send_again(self) -> None:
        self.send()

    @rule(index=st.integers(0, 60), zeros_first=st.booleans())
    def restart(self, index: int, zeros_first: bool) -> None:
        self.source = Source(self.source.rate, self.source.window, 0, self.source.number + 1)
        if zeros_first:
            self.send()
        self.source.index = index
        self.send()

    @rule(rate=st.sampled_from([RATE, RATE, 2 * RATE]))
    def change_rate(self, rate: int) -> None:
        if rate != self.source.rate:
            self.source = Source(rate, self.source.window, self.source.index, self.source.number + 1)
        self.send()

    @rule(window=st.sampled_from([1, 5, 12, 60, 200]))
    def change_window(self, window: int) -> None:
        self.source.window = window
        self.send()

    @rule()
    def garbage(self) -> None:
        self.feed(message(RATE, 5, np.zeros(3, np.int32), np.zeros(2, np.int32)))
        self.model.messages += 1
        self.model.refused += 1

    @precondition(lambda self: self.ring.sample_rate)
    @rule(block=st.sampled_from([1, 4, 10, 50]))
    def open(self, block: int) -> None:
        if self.reader is not None:
            self.reader.stop()
            assert self.reader.read() is None
        self.reader = opened(self.ring, block)
        self.model.block, self.model.reader_rate = block, self.model.rate
        self.model.capacity = max(self.model.capacity, 2 * block)
        self.model.position = self.model.newest + 1

    @precondition(lambda self: self.model.unread >= self.model.block > 0)
    @rule()
    def read(self) -> None:
        assert self.reader is not None
        read = self.reader.read()
        assert read is not None
        block, position = self.model.read()
        assert read[0].dtype == np.int32
        np.testing.assert_array_equal(read[0], [block, [-value for value in block]])
        assert read[1] == position

    @invariant()
    def agree(self) -> None:
        counters, model = self.ring.counters, self.model
        assert self.ring.sample_rate == model.rate
        assert self.ring.behind == model.unread
        for name in ("messages", "refused", "lost", "gaps", "streams", "dropped", "breaks"):
            assert getattr(counters, name) == getattr(model, name), name


RingMachine.TestCase.settings = settings(max_examples=80, stateful_step_count=30)
TestRing = RingMachine.TestCase


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        (message(RATE, 5, np.zeros(3, np.int32), np.zeros(2, np.int32)), "3 left and 2 right"),
        (message(RATE, 5, np.zeros(0, np.int32)), "samples per ear, got 0"),
        (message(0, 5, np.zeros(3, np.int32)), "Hz, got 0"),
        (message(MAX_RATE + 1, 5, np.zeros(3, np.int32)), f"Hz, got {MAX_RATE + 1}"),
        (message(2**32 - 1, 5, np.zeros(3, np.int32)), "Hz, got 4294967295"),
        (message(RATE, 5, np.zeros(3, np.int32), nChunksOnPort=2), "expected 2 x 3 samples per ear, got 3"),
        (message(RATE, 5, np.zeros(3, np.int32), nChunksOnPort=0), "0 x 3"),
        (message(RATE, 5, np.zeros(3, np.int32), nFramesPerChunk=2**32 - 1), "1 x 4294967295"),
        (message(RATE, 2**63, np.zeros(3, np.int32)), "9223372036854775808"),
        (message(RATE, 2**64 - 1, np.zeros(3, np.int32)), "18446744073709551615"),
    ],
)
def test_malformed_messages_change_nothing_and_are_reported_once(bad: Any, why: str) -> None:
    lines: list[str] = []
    ring = AudioRing(lines.append)
    feed = ring.connect()
    source = Source(index=20)
    feed(source.message())
    reader = opened(ring, 4)
    feed(bad)
    feed(bad)
    assert ring.counters.refused == 2
    assert len(lines) == 1 and why in lines[0]
    source.index += 4
    feed(source.message())
    assert reader.read() is not None
    assert ring.counters.lost == ring.counters.dropped == 0
    feed(bad)
    assert len(lines) == 2, "another event, reported again"


def test_events_are_reported_as_text() -> None:
    lines: list[str] = []
    ring = AudioRing(lines.append)
    feed = ring.connect()
    source = Source(index=50)
    feed(source.message())
    opened(ring, 4)
    assert lines == []
    source.window = 30
    feed(source.message())
    assert lines == ["Audio: the window changed from 12 to 30 frames"]
    lines.clear()
    source.index += 3
    feed(source.message())
    feed(Source(index=2, number=2).message())
    assert lines == [
        "Audio: 3 unread frames of the old stream are dropped",
        "Audio: a new stream at 8 Hz, frame 2 (its index fell from 53 to 2)",
    ]
    lines.clear()
    feed(Source(index=8, number=3).message())
    feed(Source(index=8, number=2).message())
    feed(Source(index=9, number=3).message())
    assert len(lines) == 1 and "another stream began" in lines[0], "once, while it does not fit"
    lines.clear()
    feed(Source(rate=16, index=9).message())
    assert "8 unread frames" not in lines[0]
    assert lines[-2:] == [
        "Audio: a new stream at 16 Hz, frame 9 (it was at 8 Hz)",
        "Audio: the tree runs at 8 Hz and does not read this stream; call Stop",
    ]


def test_a_new_connection_starts_a_stream_and_the_old_one_is_ignored() -> None:
    lines: list[str] = []
    ring = AudioRing(lines.append)
    old = ring.connect()
    old(Source(index=50).message())
    reader = opened(ring, 2)
    old(Source(index=53).message())
    new = ring.connect()
    assert ring.counters.dropped == 3 and ring.behind == 0
    assert ring.open_reader(4, 0.0, lambda: False) is None, "no message on the new connection yet"
    old(Source(index=60).message())
    assert ring.sample_rate == 0
    new(Source(index=5, number=2).message())
    assert ring.counters.dropped == 3 and ring.counters.streams == 2
    read = reader.read()
    assert read is not None and list(read[0][0]) == [200_001, 200_002]


def test_waiting_for_the_first_message() -> None:
    ring = AudioRing(lambda line: None)
    feed = ring.connect()
    assert ring.open_reader(4, 0.0, lambda: False) is None
    assert ring.open_reader(4, 60.0, lambda: True) is None, "interrupted"
    found: list[Any] = []
    waiting = threading.Thread(target=lambda: found.append(ring.open_reader(4, 60.0, lambda: False)))
    waiting.start()
    feed(Source(index=7).message())
    waiting.join(PATIENCE)
    assert found[0].position == 8 and found[0].sample_rate == RATE


def test_the_first_message_of_a_new_acquisition_may_still_be_on_its_way() -> None:
    """The sample rate of a tree is that of the new acquisition, not of the one that has ended."""
    ring = AudioRing(lambda line: None)
    feed = ring.connect()

    def arrives() -> bool:
        feed(Source(rate=2 * RATE, number=2).message())
        return False

    ended = Source(index=50).message()
    ended.stamp = {"sec": 1_000_000_000, "nsec": 0}
    feed(ended)
    without = ring.open_reader(4, 60.0, lambda: False)
    assert without is not None and without.sample_rate == RATE, "no other message arrives"
    reader = ring.open_reader(4, 60.0, arrives)
    assert reader is not None and reader.sample_rate == 2 * RATE
    running = Source(rate=RATE, index=50).message()
    running.stamp = {"sec": int(time.time()) + 60, "nsec": 0}
    feed(running)
    reader = ring.open_reader(4, 60.0, arrives)
    assert reader is not None and reader.sample_rate == RATE, "no wait for a running acquisition"


def test_a_reader_is_notified_of_each_complete_block_until_it_is_stopped() -> None:
    ring = AudioRing(lambda line: None)
    feed = ring.connect()
    source = Source()
    feed(source.message())
    reader = opened(ring, 6)
    came: list[int] = []
    calls = []

    def wake() -> None:  # as by the tree, but on the thread that feeds the ring, which must not be locked
        calls.append(1)
        while (block := reader.read()) is not None:
            came.append(block[1])

    reader.open(wake)
    for _ in range(12):
        source.index += 1
        feed(source.message())
    assert came == [7, 13]
    assert len(calls) == 2
    reader.stop()
    source.index += 12
    feed(source.message())
    assert len(calls) == 2
    assert reader.ended
    assert reader.read() is None


def test_two_readers_at_a_replacement() -> None:
    ring = AudioRing(lambda line: None)
    feed = ring.connect()
    source = Source()
    feed(source.message())
    old = opened(ring, 4)
    source.index += 6
    feed(source.message())
    new = opened(ring, 5)
    source.index += 6
    feed(source.message())
    assert ring.behind == 12, "the slowest reader counts"
    first, second = old.read(), new.read()
    assert first is not None and list(first[0][0]) == [source.sample(f) for f in (1, 2, 3, 4)]
    assert second is not None and list(second[0][0]) == [source.sample(f) for f in (7, 8, 9, 10, 11)]
    old.stop()
    assert ring.behind == 1


def test_a_block_longer_than_the_ring_enlarges_it() -> None:
    ring = AudioRing(lambda line: pytest.fail(line))
    feed = ring.connect()
    source = Source(index=40)
    feed(source.message())
    reader = opened(ring, 3 * CAPACITY)
    for _ in range(3 * CAPACITY // 10):
        source.index += 10
        feed(source.message())
    read = reader.read()
    assert read is not None and list(read[0][0]) == [source.sample(f) for f in range(41, 41 + 3 * CAPACITY)]


def test_generated_messages_with_lists_are_accepted() -> None:
    ring = AudioRing(lambda line: pytest.fail(line))
    feed = ring.connect()
    feed(message(RATE, 4, (1, 2, 3, 4), (5, 6, 7, 8)))  # type: ignore[arg-type]
    reader = opened(ring, 2)
    feed(message(RATE, 6, (3, 4, 9, 10), (7, 8, 11, 12)))  # type: ignore[arg-type]
    read = reader.read()
    assert read is not None and read[0].tolist() == [[9, 10], [11, 12]]


# --- unobserved blocks ---


def test_unobserved_blocks_are_read_together() -> None:
    """The reader is woken for 0.1 s of sound, or when a block is awaited; no frame is lost or repeated."""
    ring, rate, block = AudioRing(print), 1000, 8
    feed, source = ring.connect(), Source(rate=rate, window=2 * block)
    feed(source.message())
    reader, woken, got = opened(ring, block), [], list[int]()
    observed = False
    reader.open(lambda: woken.append(source.index), lambda: 0 if observed else math.inf)

    def play(frames: int) -> None:
        for _ in range(frames // 4):
            source.index += 4
            feed(source.message())

    def read() -> int:
        found = reader.read()
        if found is None:
            return 0
        assert found[1] == len(got) + found[0].shape[1] + 1
        got.extend(found[0][0].tolist())
        return found[0].shape[1]

    play(92)
    assert (woken, reader.waiting) == ([], True)
    play(16)
    assert woken == [96, 100, 104, 108], "12 blocks are 0.096 s"
    assert (reader.waiting, read(), reader.waiting, read()) == (False, 96, True, 0), "at most 12 blocks at once"
    play(16)
    assert (woken[4:], ring.catch_up(), woken[4:]) == ([], True, [124])
    assert (reader.waiting, read(), reader.waiting) == (False, 24, True)
    assert not ring.catch_up(), "less than a block"
    observed = True
    play(16)
    assert woken[5:] == [128, 132, 136, 140]
    assert [read(), read(), read()] == [8, 8, 0]
    assert got == [source.sample(frame) for frame in range(1, 137)]
    observed = False
    play(24)
    assert reader.waiting
    observed = True  # by a new subscriber, which gets each block that has arrived
    assert ring.catch_up()
    assert [read(), read(), read(), read()] == [8, 8, 8, 0]
    observed, source.index = False, 20  # a new stream, whose frames were not awaited
    feed(source.message())
    assert reader.waiting


def test_blocks_are_read_until_an_awaited_output_can_be_complete() -> None:
    ring, block = AudioRing(print), 8
    feed, source = ring.connect(), Source(rate=1000, window=2 * block)
    feed(source.message())
    reader, woken = opened(ring, block), list[int]()
    required, at_once = 20, list[int]()
    reader.open(lambda: woken.append(source.index), lambda: required)
    for _ in range(20):
        source.index += 4
        feed(source.message())
        while (found := reader.read()) is not None:
            at_once.append(found[0].shape[1])
            required = max(required, 20 + 20 * (sum(at_once) // 20))  # an output for every 20 frames
    assert woken == [24, 40, 64, 80]
    assert at_once == [24, 16, 24, 16]


def test_unobserved_blocks_are_read_when_the_sound_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr("rosafe.audio.stream.ring.time.monotonic", lambda: now)
    ring = AudioRing(print)
    feed, source = ring.connect(), Source(rate=1000, window=16)
    feed(source.message())
    reader = opened(ring, 8)
    reader.open(lambda: None, lambda: math.inf)
    source.index = 12
    feed(source.message())
    assert reader.waiting
    now += PAUSE_SECONDS / 2
    assert reader.waiting
    now += PAUSE_SECONDS
    assert not reader.waiting


def test_the_counters_are_documented() -> None:
    text = (ROOT / "docs" / "audio-stream.md").read_text("utf-8")
    for counter in dataclasses.fields(Counters):
        if counter.name not in ("messages", "last_loss"):
            assert f"`{counter.name}`" in text, counter.name
    assert f"a ring of {RING_SECONDS:g} s" in text
