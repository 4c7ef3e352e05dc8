"""The sliding window and the acquisition loop, with a scripted source."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe.audio.devices import Chunk
from rosafe.audio.stream import capture as capture_module
from rosafe.audio.stream.capture import MAX_WINDOW, AudioWindow, Capture, Snapshot, check_window
from rosafe.interface import ComponentError


@settings(max_examples=40)
@given(st.integers(1, 50), st.lists(st.tuples(st.integers(0, 120), st.integers(0, 80)), max_size=30))
def test_window_contains_the_newest_frames_of_the_stream(frames: int, steps: list[tuple[int, int]]) -> None:
    window = AudioWindow(frames)
    stream = np.zeros((2, frames), np.int32)
    kept = []
    for count, gap in steps:
        block = np.random.default_rng(count).integers(1, 2**31, (2, count)).astype(np.int32)
        window.skip(gap)
        window.append(block)
        stream = np.concatenate((stream, np.zeros((2, gap), np.int32), block), axis=1)
        kept.append((window.view(), stream[:, -frames:]))
    for view, expected in kept:  # published views do not change
        assert np.array_equal(view, expected)
        assert not view.flags.writeable


class ScriptedSource:
    """A source of chunks of two frames with given gaps and times."""

    name = "script"
    sample_rate = 1000
    overruns = 0
    lost_frames = 0

    def __init__(self, script: list[tuple[int, float]]) -> None:
        self.script = list(script)
        self.next = 1
        self.now = 0.0  # time of the last read

    def read(self) -> Chunk | None:
        """Return the next chunk: consecutive numbers, negative for the right ear."""
        if not self.script:
            return None
        gap, age = self.script.pop(0)
        if gap:
            self.overruns += 1
            self.lost_frames += gap
        numbers = np.arange(self.next, self.next + 2, dtype=np.int32)
        self.next += 2
        self.now = time.monotonic()
        return Chunk(np.stack((numbers, -numbers)), gap, self.now - age)

    def close(self) -> None:
        """Do nothing."""


def run(script: list[tuple[int, float]], chunks: int = 3) -> tuple[list[Snapshot], list[str]]:
    published: list[Snapshot] = []
    reports: list[str] = []
    source = ScriptedSource(script)
    capture = Capture(source, 2, chunks, published.append, reports.append)
    clock = SimpleNamespace(monotonic=lambda: source.now)  # capture needs no time, also on a busy machine
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(capture_module, "time", clock)
        capture.publish()
        capture.run(threading.Event(), lambda seconds: None)
    return published, reports


def test_port_starts_with_zeros_and_advances() -> None:
    published, reports = run([(0, 0.0), (0, 0.0), (0, 0.0), (0, 0.0)])
    assert [s.last_frame_index for s in published] == [0, 2, 4, 6, 8]
    assert [s.left.tolist() for s in published] == [
        [0, 0, 0, 0, 0, 0],
        [0, 0, 0, 0, 1, 2],
        [0, 0, 1, 2, 3, 4],
        [1, 2, 3, 4, 5, 6],
        [3, 4, 5, 6, 7, 8],
    ]
    assert all(np.array_equal(s.right, -s.left) for s in published)
    assert {(s.sample_rate, s.chunks_on_port, s.frames_per_chunk) for s in published} == {(1000, 3, 2)}
    assert published[0].time_ns == 0
    assert abs(published[-1].time_ns - time.time_ns()) < 60e9
    assert reports == []


def test_lost_frames_are_zeros_that_count_and_are_reported() -> None:
    published, reports = run([(0, 0.0), (3, 0.0), (100, 0.0)])
    assert [s.last_frame_index for s in published] == [0, 2, 7, 109]
    assert published[2].left.tolist() == [2, 0, 0, 0, 3, 4]
    assert published[3].left.tolist() == [0, 0, 0, 0, 5, 6]
    assert reports == [
        "lost 3 frames (0.003 s) after frame 2 (0.00 s)",
        "lost 100 frames (0.100 s) after frame 7 (0.01 s)",
    ]


def test_stamp_is_the_time_of_acquisition() -> None:
    begin = time.time_ns()
    published, _ = run([(0, 5.0)])
    assert begin - 1e6 <= published[-1].time_ns + 5e9 <= time.time_ns() + 1e6


def test_late_chunks_are_published_together_without_a_loss() -> None:
    published, _ = run([(0, 10.0)] * 21, chunks=8)
    indexes = [s.last_frame_index for s in published]
    assert len(indexes) < 10 and indexes[-1] == 42
    assert max(np.diff(indexes)) <= 16  # the window overlaps the previous one
    seen = {int(frame) for s in published for frame in s.left}
    assert seen == set(range(43))


def test_too_long_windows_are_rejected() -> None:
    check_window(2205, 200)
    check_window(MAX_WINDOW, 1)
    with pytest.raises(ComponentError, match="expected at most 16777216 frames") as caught:
        check_window(1_000_000, 100_000)
    assert caught.value.ex == "::bass::e_hwparams"


def test_lack_of_memory_is_a_named_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr("rosafe.audio.stream.capture.np.zeros", refuse)
    with pytest.raises(ComponentError) as caught:
        Capture(ScriptedSource([]), 2, 3, lambda _: None, lambda _: None)
    assert caught.value.ex == "::bass::e_nomem"
