"""Bags for tests: the messages of a port Audio, written by rosbag's own library."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rosafe.ros1.component import serialization


def stream(frames: int, seed: int = 0) -> np.ndarray:
    """Return noise, int32 (2, frames), in which no frame is zero."""
    return np.random.default_rng(seed).integers(1, 2**31, (2, frames)).astype(np.int32)


def message(samples: np.ndarray, index: int, window: int, rate: int = 1000, chunk: int = 10) -> Any:
    """Return the message of the port whose newest frame is frame `index` of `samples`."""
    padded = np.concatenate((np.zeros((2, window), np.int32), samples[:, :index]), axis=1)[:, -window:]
    left, right = np.ascontiguousarray(padded)
    return serialization.message_class("bass", "::binaudio::portStruct")(
        sampleRate=rate,
        nChunksOnPort=window // chunk,
        nFramesPerChunk=chunk,
        lastFrameIndex=index,
        left=left,
        right=right,
        stamp={"sec": 1, "nsec": index},
    )


def write(path: Path, messages: Iterable[Any], topic: str = "/bass/Audio", **options: Any) -> Path:
    """Write a bag of `messages`, 10 ms apart."""
    import genpy
    import rosbag

    with rosbag.Bag(str(path), "w", **options) as bag:
        for count, item in enumerate(messages):
            bag.write(topic, item, genpy.Time(1000 + count // 100, count % 100 * 10_000_000))
    return path


def record(op: int, data: bytes = b"", length: int | None = None, **fields: bytes) -> bytes:
    """Return the bytes of a record; `length` replaces the true length of its data."""
    header = b"".join(
        struct.pack("<I", len(name) + 1 + len(value)) + name.encode() + b"=" + value
        for name, value in {"op": bytes([op]), **fields}.items()
    )
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data) if length is None else length) + data


def number(value: int, size: int = 4) -> bytes:
    """Return the bytes of a numeric field."""
    return value.to_bytes(size, "little")


def forge(path: Path, chunks: bytes, hole: int = 0, connections: int = 1) -> Path:
    """Write a bag of these chunks and a hole, and connection 0 of a port Audio at the end."""
    kind = serialization.message_class("bass", "::binaudio::portStruct")

    def head(index: int) -> bytes:
        header = record(
            3, b" " * 4000, index_pos=number(index, 8), conn_count=number(connections), chunk_count=number(1)
        )
        return b"#ROSBAG V2.0\n" + header

    texts = {"topic": b"/bass/Audio", "type": kind._type.encode(), "md5sum": kind._md5sum.encode()}
    data = b"".join(number(len(name) + 1 + len(text)) + name.encode() + b"=" + text for name, text in texts.items())
    index = len(head(0)) + len(chunks) + hole
    with path.open("wb") as file:
        file.write(head(index) + chunks)
        file.seek(index)
        file.write(record(7, data, conn=number(0), topic=b"/bass/Audio"))
    return path


def read(path: Path, topic: str) -> list[Any]:
    """Return the messages of a topic, read by rosbag."""
    import rosbag

    with rosbag.Bag(str(path)) as bag:
        return [message for _, message, _ in bag.read_messages(topics=[topic])]
