"""Bags for tests: what a port Audio shows of a stream, message by message, written by rosbag's own library."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rosafe.component import wire


def stream(frames: int, seed: int = 0) -> np.ndarray:
    """Noise, int32 (2, frames), in which no frame is zero."""
    return np.random.default_rng(seed).integers(1, 2**31, (2, frames)).astype(np.int32)


def message(samples: np.ndarray, index: int, window: int, rate: int = 1000, chunk: int = 10) -> Any:
    """The port when frame `index` is the newest of `samples`."""
    padded = np.concatenate((np.zeros((2, window), np.int32), samples[:, :index]), axis=1)[:, -window:]
    left, right = np.ascontiguousarray(padded)
    return wire.message_class("bass", "::binaudio::portStruct")(
        sampleRate=rate,
        nChunksOnPort=window // chunk,
        nFramesPerChunk=chunk,
        lastFrameIndex=index,
        left=left,
        right=right,
        stamp={"sec": 1, "nsec": index},
    )


def write(path: Path, messages: Iterable[Any], topic: str = "/bass/Audio", **options: Any) -> Path:
    """A bag of `messages`, 10 ms apart."""
    import genpy
    import rosbag

    with rosbag.Bag(str(path), "w", **options) as bag:
        for count, item in enumerate(messages):
            bag.write(topic, item, genpy.Time(1000 + count // 100, count % 100 * 10_000_000))
    return path


def read(path: Path, topic: str) -> list[Any]:
    """The messages of a topic, as rosbag gives them."""
    import rosbag

    with rosbag.Bag(str(path)) as bag:
        return [message for _, message, _ in bag.read_messages(topics=[topic])]
