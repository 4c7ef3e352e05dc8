"""Streams that are joined from overlapping windows: new, lost and repeated frames, restarts."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from rosafe.audio.files.windows import MAX_JUMP_SECONDS, WindowStream, mismatch, new_samples

RATE, WINDOW = 1000, 200
HOP, WIDTH, BLOCK = 441, 882, 12000


class Port:
    """A simulated framed port for random frames, of a sound that begins `start` audio frames before the processor."""

    def __init__(self, start: int = 0, shown: int = 100) -> None:
        self.start, self.end = start, start
        self.window = np.zeros((3, shown))
        self.sent = np.zeros((3, 0))
        self.random = np.random.default_rng(start)

    def next(self, block: int = BLOCK) -> tuple[int, np.ndarray]:
        """Return end and window after the next block."""
        self.end += block
        total = max(0, (self.end - self.start - WIDTH) // HOP + 1)
        fresh = self.random.random((3, total - self.sent.shape[1]))
        self.sent = np.concatenate((self.sent, fresh), axis=1)
        self.window = np.concatenate((self.window, fresh), axis=1)[:, -self.window.shape[1] :]
        return self.end, self.window


def joined(stream: WindowStream, messages: list[tuple[int, np.ndarray]]) -> tuple[np.ndarray, int]:
    """Return all new frames, with those that are lost as NaN, and the number of the first."""
    parts: list[np.ndarray] = []
    first = None
    for end, window in messages:
        step = stream.advance(end, window)
        first = step.first if first is None else first
        parts += [np.full((3, step.lost), np.nan), window[:, window.shape[1] - step.new :]]
        assert step.first + step.new == first + sum(part.shape[1] for part in parts) == max(0, stream.frames)
    return np.concatenate(parts, axis=1), first or 0


@pytest.mark.parametrize("block", [441, 4410, 12000, 300])
def test_each_frame_is_new_once(block: int) -> None:
    port = Port()
    found, first = joined(WindowStream(HOP, WIDTH), [port.next(block) for _ in range(40)])
    assert first == 0
    np.testing.assert_array_equal(found, port.sent)


@pytest.mark.parametrize("start", [2205, 100_000])
def test_a_processor_that_begins_later(start: int) -> None:
    """The window of the first message may have frames from before the processor, which are zeros."""
    port = Port(start)
    found, first = joined(WindowStream(HOP, WIDTH), [port.next() for _ in range(40)])
    zeros = found.shape[1] - port.sent.shape[1]
    assert not found[:, :zeros].any() and abs(first + zeros - start / HOP) <= 1
    np.testing.assert_array_equal(found[:, zeros:], port.sent)


def test_overlap_compensates_for_missed_messages_and_the_rest_is_lost() -> None:
    port, stream = Port(), WindowStream(HOP, WIDTH)
    messages = [port.next() for _ in range(20)]
    kept = [messages[0], messages[2], messages[5], messages[12], messages[13]]
    found, _ = joined(stream, kept)
    missing = np.isnan(found[0])
    assert missing.sum() == pytest.approx(7 * BLOCK / HOP - 100, abs=1)
    np.testing.assert_array_equal(found[:, ~missing], port.sent[:, : found.shape[1]][:, ~missing])


def test_restarts_and_repetitions() -> None:
    port, stream = Port(50_000), WindowStream(HOP, WIDTH)
    messages = [port.next() for _ in range(5)]
    joined(stream, messages)
    assert stream.advance(*messages[-1])[1:] == (0, 0, False)
    again = Port()
    step = stream.advance(*again.next())
    assert step == (0, 26, 0, True)
    assert stream.advance(again.end + 4410, np.zeros((4, 100))).restarted, "another number of channels"


def test_silence_has_the_frames_of_its_duration() -> None:
    """Windows of silence are all equal, so that the overlap does not show how many frames are new."""
    stream = WindowStream(HOP, WIDTH)
    for block in range(1, 2000):
        stream.advance(block * 1000, np.zeros((3, 100)))
        assert stream.frames == (block * 1000 - WIDTH) // HOP + 1


def message(index: int) -> SimpleNamespace:
    samples = np.arange(index - WINDOW, index, dtype=np.int32)
    return SimpleNamespace(sampleRate=RATE, lastFrameIndex=index, left=samples, right=-samples)


@pytest.mark.parametrize("with_first", [True, False])
def test_samples_are_counted_by_the_index(with_first: bool) -> None:
    stream = WindowStream(with_first=with_first)
    found = [new_samples(stream, message(index)) for index in (150, 250, 250, 600)]
    assert [(lost, samples.shape[1]) for lost, samples in found] == [
        (0, 150 * with_first), (0, 100), (0, 0), (150, 200)
    ]  # fmt: skip
    assert found[3][1].tolist() == [[*range(400, 600)], [*range(-400, -600, -1)]]


@pytest.mark.parametrize(("jump", "continues"), [(3_600_200, True), (3_600_201, False)])
def test_a_jump_of_more_than_an_hour_starts_a_new_stream(jump: int, continues: bool) -> None:
    assert MAX_JUMP_SECONDS * RATE + WINDOW == 3_600_200
    stream = WindowStream()
    new_samples(stream, message(500))
    assert (mismatch(stream, RATE, message(500 + jump)) == "") == continues
    assert "sample rate changes" in mismatch(stream, 8000, message(600)) and "falls" in mismatch(
        stream, RATE, message(400)
    )
