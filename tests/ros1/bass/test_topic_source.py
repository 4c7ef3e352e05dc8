"""The source that subscribes to a port Audio: each new frame once, losses, and the end of a stream."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from rosafe.interface import ComponentError
from rosafe.ros1.bass.topic_source import TopicSource
from tests.harness import Graph
from tests.ros1.afe.session import RATE, Microphone, noise


@pytest.fixture
def microphone(graph: Graph) -> Iterator[Microphone]:
    """Create a microphone with a window of 4000 frames, some of which are old."""
    microphone = Microphone(graph)
    microphone.play(noise(2000, seed=9))
    yield microphone
    microphone.close()


@pytest.fixture
def source(microphone: Microphone) -> Iterator[TopicSource]:
    source = TopicSource(microphone.topic, 0, 0, threading.Event(), patience=1.0)
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
    assert (source.sample_rate, source.newest, source.port_chunk) == (RATE, 2000, 400)
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


def test_end_and_new_stream(source: TopicSource, microphone: Microphone) -> None:
    microphone.play(noise(400))
    assert source.read() is not None
    pause = source.read()
    assert pause is not None and pause.samples.shape == (2, 0)
    assert source.read() is None  # no frames for a second
    microphone.index = 0
    microphone.play(noise(400))
    with pytest.raises(ComponentError, match="a new stream begins"):
        source.read()


def test_options_and_another_rate_are_rejected(microphone: Microphone) -> None:
    for options, rate, why in (("?rate=1", 0, "expected no options for a port"), ("", 8000, "8000 Hz, got 20000 Hz")):
        with pytest.raises(ComponentError, match=why):
            TopicSource(microphone.topic + options, rate, 0, threading.Event())


def test_only_old_audio_is_an_error(source: TopicSource, microphone: Microphone) -> None:
    with pytest.raises(ComponentError, match=r"got only old ones.* call Acquire"):
        while source.read() is not None:  # the pause
            pass
