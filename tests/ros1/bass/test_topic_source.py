"""The source that subscribes to a port Audio: each new frame once, losses, and the end of a stream."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from rosafe.interface import ComponentError
from rosafe.ros1.bass.recording import topic_source
from rosafe.ros1.bass.recording.topic_source import TopicSource
from tests.audio import bags
from tests.harness import Graph, wait_for
from tests.ros1.afe.session import RATE, Microphone, noise


@pytest.fixture
def microphone(graph: Graph) -> Iterator[Microphone]:
    """Create a microphone with a window of 4000 frames, some of which are old."""
    microphone = Microphone(graph)
    microphone.play(noise(2000, seed=9))
    yield microphone
    microphone.close()


@pytest.fixture
def source(microphone: Microphone, monkeypatch: pytest.MonkeyPatch) -> Iterator[TopicSource]:
    monkeypatch.setattr(topic_source, "STALL_SECONDS", 1.0)
    source = TopicSource(microphone.topic, 0, threading.Event())
    yield source
    source.close()


def read(source: TopicSource, frames: int) -> np.ndarray:
    """Return this many frames, with zeros for gaps."""
    parts: list[np.ndarray] = []
    while sum(part.shape[1] for part in parts) < frames:
        chunk = source.read()
        assert chunk is not None
        parts.append(np.pad(chunk.samples, ((0, 0), (chunk.gap, 0))))
    return np.concatenate(parts, axis=1)


def test_each_new_frame_once_and_losses(source: TopicSource, microphone: Microphone) -> None:
    assert (source.sample_rate, source.newest, source.frames_per_chunk) == (RATE, 2000, 400)
    signal = noise(14_000)
    microphone.play(signal[:, :3000])
    assert np.array_equal(read(source, 3000), signal[:, :3000])
    microphone.publish()  # no new frames
    microphone.publish_bytes(b"\1\2\3")
    microphone.lose(signal[:, 3000:6000])
    microphone.play(signal[:, 6000:8000])
    assert np.array_equal(read(source, 5000), signal[:, 3000:8000])
    assert (source.overruns, source.lost_frames) == (0, 0)  # the windows overlapped
    microphone.lose(signal[:, 8000:13_600])
    microphone.play(signal[:, 13_600:])
    frames = read(source, 6000)
    assert not frames[:, :2000].any() and np.array_equal(frames[:, 2000:], signal[:, 10_000:])
    assert (source.overruns, source.lost_frames) == (1, 2000)


def test_a_slow_reader_loses_frames_and_needs_no_more_memory(
    source: TopicSource, microphone: Microphone, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(topic_source, "MAX_WAITING", 2000)
    signal = noise(10_000)
    microphone.play(signal[:, :8000])
    wait_for(lambda: source._missed == 6000)
    assert source._queue.qsize() == 5
    assert np.array_equal(read(source, 2000), signal[:, :2000])
    microphone.play(signal[:, 8000:])
    frames = read(source, 8000)
    assert not frames[:, :6000].any() and np.array_equal(frames[:, 6000:], signal[:, 8000:])
    assert (source.overruns, source.lost_frames) == (1, 6000)


def test_repeated_restarts_are_reported_once(source: TopicSource) -> None:
    for index in range(100, 0, -10):
        message = bags.message(noise(100), index, 10, rate=RATE)
        message.problem = ""
        source._receive(message)
    with pytest.raises(ComponentError, match="its index falls from 2000 to 100"):
        source.read()
    assert source._queue.empty()


def test_end_and_new_stream(source: TopicSource, microphone: Microphone) -> None:
    microphone.play(noise(400))
    assert source.read() is not None
    assert source.read() is None  # no frames for a second
    microphone.index = 0
    microphone.play(noise(400))
    with pytest.raises(ComponentError, match="a new stream begins"):
        source.read()


def test_only_old_audio_is_an_error(source: TopicSource, microphone: Microphone) -> None:
    with pytest.raises(ComponentError, match=r"got only old ones.* call Acquire"):
        source.read()


@pytest.mark.parametrize(
    ("name", "rate", "why"),
    [
        ("a b", 0, "expected the name of a topic"),
        ("MICROPHONE", 44100, f"expected 44100 Hz, got {RATE} Hz"),
    ],
)
def test_unusable_topics_are_rejected(graph: Graph, microphone: Microphone, name: str, rate: int, why: str) -> None:
    with pytest.raises(ComponentError, match=why):
        TopicSource(name.replace("MICROPHONE", microphone.topic), rate, threading.Event())
    wait_for(lambda: not microphone.subscribed)
