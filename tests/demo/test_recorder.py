"""Recording a port with overlapping windows: each frame is counted once, and losses are detected."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from rosafe.demo.recorder import PortFollower

RATE = 44100
BLOCK = 12000
HOP, WINDOW = 441, 882


class Port:
    """A simulated port of `kind` for a random signal that starts with audio frame `start`."""

    def __init__(self, kind: str, start: int = 1, seconds: float = 1.0) -> None:
        self.kind, self.start = kind, start
        self.framed = kind == "ild"
        self.rate = 100 if self.framed else RATE
        self.window = np.zeros((3, round(seconds * self.rate)))
        self.sent = np.zeros((3, 0))
        self.index = start
        self.random = np.random.default_rng(start)

    def next(self) -> SimpleNamespace:
        """Return the message after the next block."""
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
def test_each_frame_is_recorded_once(start: int) -> None:
    port, followed = Port("ild", start), follower("ild")
    for _ in range(40):
        followed.receive(port.next())
    times, data = followed.series()
    np.testing.assert_array_equal(data, port.sent)
    assert (followed.row.frames, followed.row.lost, followed.row.frame_rate) == (port.sent.shape[1], 0, 100)
    centres = (start - 1 + WINDOW / 2 + HOP * np.arange(data.shape[1])) / RATE
    np.testing.assert_allclose(times, centres, atol=0.5 * HOP / RATE)


def test_samples_are_counted_by_the_index() -> None:
    port, followed = Port("gammatone"), follower("gammatone")
    for _ in range(10):
        followed.receive(port.next())
    assert (followed.row.frames, followed.row.lost) == (10 * BLOCK, 0)


@pytest.mark.parametrize("kind", ["ild", "gammatone"])
def test_a_lost_message_is_compensated_by_overlapping_windows(kind: str) -> None:
    port, followed = Port(kind), follower(kind)
    for number in range(12):
        message = port.next()
        if number % 3:
            followed.receive(message)
    missed = 27 if kind == "ild" else BLOCK
    assert followed.row.lost == 0
    assert followed.row.frames == pytest.approx(
        port.sent.shape[1] - missed, abs=1
    )  # message 0 is before the first received one


@pytest.mark.parametrize("kind", ["ild", "gammatone"])
def test_frames_missing_in_all_windows_are_lost(kind: str) -> None:
    port, followed = Port(kind), follower(kind)
    followed.receive(port.next())
    before = port.sent.shape[1]
    for _ in range(7):
        port.next()
    followed.receive(port.next())
    gap = port.sent.shape[1] - before - port.window.shape[1]
    assert gap > 0
    assert followed.row.lost == pytest.approx(gap, abs=1)
    assert followed.row.frames + followed.row.lost == pytest.approx(port.sent.shape[1], abs=1)
    if kind == "ild":
        times, data = followed.series()
        assert data.shape[1] == len(times) == followed.row.frames + followed.row.lost
        np.testing.assert_array_equal(data[:, -100:], port.sent[:, -100:])
        assert not data[:, before : before + followed.row.lost].any()


def test_a_restart_of_the_audio_restarts_the_recording() -> None:
    old, followed = Port("ild", 50_000), follower("ild")
    for _ in range(5):
        followed.receive(old.next())
    assert followed.starts == 1
    new = Port("ild")
    for _ in range(5):
        followed.receive(new.next())
    assert followed.starts == 2
    np.testing.assert_array_equal(followed.series()[1], new.sent)
    assert followed.row.lost == 0


def test_empty_and_repeated_messages_are_ignored() -> None:
    port, followed = Port("ild"), follower("ild")
    empty = SimpleNamespace(sampleRate=100, lastFrameIndex=0, framesOnPort=100, left=np.zeros((3, 100)))
    followed.receive(empty)
    assert followed.starts == 0 and np.isnan(followed.row.message_rate)
    message = port.next()
    followed.receive(message)
    followed.receive(message)
    assert followed.row.frames == 26
    assert np.isnan(followed.row.message_rate), "the repetition counts as a message"


def test_messages_after_stop_are_ignored() -> None:
    port, followed = Port("ild"), follower("ild")
    followed.receive(port.next())
    followed.stop()
    followed.receive(port.next())
    assert followed.row.frames == 26


def test_the_sound_of_the_input_is_taken_once() -> None:
    random, followed = np.random.default_rng(0), follower("input")
    sound = random.random((2, 6 * BLOCK))

    def send(index: int) -> None:
        window = np.concatenate((np.zeros((2, RATE)), sound[:, :index]), axis=1)[:, -RATE:]
        followed.receive(
            SimpleNamespace(sampleRate=RATE, lastFrameIndex=index, framesOnPort=RATE, left=window[0], right=window[1])
        )

    send(BLOCK)
    send(2 * BLOCK)
    position, taken = followed.take_sound()
    assert position == (1, 0)
    np.testing.assert_array_equal(taken, sound[:, : 2 * BLOCK])
    assert followed.take_sound()[1].shape == (2, 0)
    send(3 * BLOCK)
    position, taken = followed.take_sound()
    assert position == (1, 2 * BLOCK)
    np.testing.assert_array_equal(taken, sound[:, 2 * BLOCK : 3 * BLOCK])
    send(BLOCK)  # the audio has restarted
    position, taken = followed.take_sound()
    assert position == (2, 0)
    np.testing.assert_array_equal(taken, sound[:, :BLOCK])
