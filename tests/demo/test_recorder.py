"""Counting frames on a port whose messages overlap: nothing twice, nothing missed, losses seen."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from rosafe.demo.recorder import PortFollower

RATE = 44100
BLOCK = 12000
HOP, WINDOW = 441, 882


class Port:
    """What a port of `kind` shows of a made-up signal that begins with audio frame `start`."""

    def __init__(self, kind: str, start: int = 1, seconds: float = 1.0) -> None:
        self.kind, self.start = kind, start
        self.framed = kind == "ild"
        self.rate = 100 if self.framed else RATE
        self.window = np.zeros((3, round(seconds * self.rate)))
        self.sent = np.zeros((3, 0))
        self.index = start
        self.random = np.random.default_rng(start)

    def next(self) -> SimpleNamespace:
        """The message after one more block."""
        self.index += BLOCK
        samples = self.index - self.start
        total = max(0, (samples - WINDOW) // HOP + 1) if self.framed else samples
        fresh = self.random.random((3, total - self.sent.shape[1]))
        self.sent = np.concatenate((self.sent, fresh), axis=1)
        self.window = np.concatenate((self.window, fresh), axis=1)[:, -self.window.shape[1] :]
        return SimpleNamespace(
            sampleRate=self.rate, lastFrameIndex=self.index, framesOnPort=self.window.shape[1], left=self.window
        )


def follower(kind: str) -> PortFollower:
    return PortFollower(kind, "/x", RATE, BLOCK)


@pytest.mark.parametrize("start", [1, 2206, 100_000])
def test_every_frame_is_taken_once(start: int) -> None:
    port, followed = Port("ild", start), follower("ild")
    for _ in range(40):
        followed.take(port.next())
    times, data = followed.series()
    np.testing.assert_array_equal(data, port.sent)
    assert (followed.row.frames, followed.row.lost, followed.row.frame_rate) == (port.sent.shape[1], 0, 100)
    centres = (start - 1 + WINDOW / 2 + HOP * np.arange(data.shape[1])) / RATE
    np.testing.assert_allclose(times, centres, atol=0.5 * HOP / RATE)


def test_samples_are_counted_by_the_index() -> None:
    port, followed = Port("gammatone"), follower("gammatone")
    for _ in range(10):
        followed.take(port.next())
    assert (followed.row.frames, followed.row.lost) == (10 * BLOCK, 0)


@pytest.mark.parametrize("kind", ["ild", "gammatone"])
def test_a_message_that_did_not_come_is_no_loss_while_windows_overlap(kind: str) -> None:
    port, followed = Port(kind), follower(kind)
    for number in range(12):
        message = port.next()
        if number % 3:
            followed.take(message)
    missed = 27 if kind == "ild" else BLOCK
    assert followed.row.lost == 0
    assert followed.row.frames == pytest.approx(port.sent.shape[1] - missed, abs=1)  # number 0 came before the first


@pytest.mark.parametrize("kind", ["ild", "gammatone"])
def test_frames_in_no_window_are_lost(kind: str) -> None:
    port, followed = Port(kind), follower(kind)
    followed.take(port.next())
    before = port.sent.shape[1]
    for _ in range(7):
        port.next()
    followed.take(port.next())
    gap = port.sent.shape[1] - before - port.window.shape[1]
    assert gap > 0
    assert followed.row.lost == pytest.approx(gap, abs=1)
    assert followed.row.frames + followed.row.lost == pytest.approx(port.sent.shape[1], abs=1)
    if kind == "ild":
        times, data = followed.series()
        assert data.shape[1] == len(times) == followed.row.frames + followed.row.lost
        np.testing.assert_array_equal(data[:, -100:], port.sent[:, -100:])
        assert not data[:, before : before + followed.row.lost].any()


def test_sound_that_begins_anew_is_counted_anew() -> None:
    old, followed = Port("ild", 50_000), follower("ild")
    for _ in range(5):
        followed.take(old.next())
    assert followed.beginnings == 1
    new = Port("ild")
    for _ in range(5):
        followed.take(new.next())
    assert followed.beginnings == 2
    np.testing.assert_array_equal(followed.series()[1], new.sent)
    assert followed.row.lost == 0


def test_zeros_of_a_new_processor_and_repetitions_count_for_nothing() -> None:
    port, followed = Port("ild"), follower("ild")
    empty = SimpleNamespace(sampleRate=100, lastFrameIndex=0, framesOnPort=100, left=np.zeros((3, 100)))
    followed.take(empty)
    assert followed.beginnings == 0 and np.isnan(followed.row.message_rate)
    message = port.next()
    followed.take(message)
    followed.take(message)
    assert followed.row.frames == 26


def test_nothing_is_taken_after_stop() -> None:
    port, followed = Port("ild"), follower("ild")
    followed.take(port.next())
    followed.stop()
    followed.take(port.next())
    assert followed.row.frames == 26
