"""The source `bag:PATH`: what a port Audio published while rosbag recorded it, in real time.

The one source that needs ROS: its messages, but no master.
"""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterator
from itertools import chain, groupby, islice
from pathlib import Path
from typing import Any

import genpy
import numpy as np

from rosafe.bass.sources.bagfile import BagError, BagFile, NotClosedError
from rosafe.bass.sources.base import (
    Chunk,
    Chunker,
    Pacer,
    device_error,
    flag,
    hwparams_error,
    number,
    parse_options,
)
from rosafe.bass.sources.file import split_path
from rosafe.bass.windows import WindowStream
from rosafe.interface import BASS, ComponentError
from rosafe.ros import wire
from rosafe.ros.audio import MAX_WINDOW, malformed

MAX_MESSAGE = 2 * 4 * MAX_WINDOW + 1024  # bytes: both ears, and the rest
MAX_LISTED = 20  # topics in a refusal
_AUDIO = BASS.port("Audio").idl
Piece = tuple[int, np.ndarray]  # frames lost before it, and int32 (2, n)


def _topic_name(text: str) -> str:
    if not text:
        raise ValueError("a topic, such as /bass/Audio")
    return text if text.startswith("/") else f"/{text}"


def _stream_number(text: str) -> int:
    if not re.fullmatch("[1-9][0-9]{0,5}", text):
        raise ValueError("a whole number from 1 on")
    return int(text)


_OPTIONS = {"topic": _topic_name, "stream": _stream_number, "start": number(0, 1e9), "loop": flag}


class BagSource:
    """One recorded stream: of overlapping windows every frame once; what no window shows is lost again.

    Parameters
    ----------
    text : str
        ``PATH`` or ``PATH?OPTIONS``. Options: ``topic=/left/Audio`` where the bag holds several ports Audio;
        ``stream=2`` for the second acquisition of those that were recorded one after the other; ``start=SECONDS``
        leaves out the beginning; ``loop=1`` goes on from there again at the end, for ever.
    sample_rate : int
        Hz; must be that of the recording, or 0.
    frames_per_chunk : int
        The last chunk is filled up with zeros.
    """

    def __init__(self, text: str, sample_rate: int, frames_per_chunk: int, stopping: threading.Event) -> None:
        self.name = f"bag:{text}"
        self.overruns = 0
        self.lost_frames = 0
        path, options_text = split_path(text)
        if not path:
            raise device_error("bag: names no file; write bag:PATH")
        options = parse_options(self.name, options_text, _OPTIONS)
        self._stream = options.get("stream", 1)
        self._loop = options.get("loop", False)
        self._start = options.get("start", 0.0)
        self._another = False  # whether the bag holds more streams after this one
        self.sample_rate = 0
        self._stopping = stopping
        self._recording = _Recording(path, options.get("topic"), stopping)
        try:
            self._pieces = self._play()
            first = next(self._pieces, None)
            if first is None:
                raise device_error(f"{self.name}: interrupted before its sound was found")
            self._pieces = chain([first], self._pieces)
            if sample_rate not in (0, self.sample_rate):
                raise hwparams_error(
                    f"{path} was recorded at {self.sample_rate} Hz, asked for were {sample_rate}; 0 is what it has"
                )
        except ComponentError:
            self.close()
            raise
        self._frames_per_chunk = frames_per_chunk
        self._chunks = Chunker(frames_per_chunk)
        self._pacer = Pacer(self.sample_rate, stopping)

    def _play(self) -> Iterator[Piece]:
        """The stream from its start on, again and again if it is looped."""
        while True:
            streams = self._recording.streams()
            chosen = next(islice(streams, self._stream - 1, None), None)
            if self._stopping.is_set():
                return
            if chosen is None:
                raise device_error(f"{self.name}: no stream {self._stream} of sound in the bag")
            self.sample_rate, pieces = chosen
            yield from self._from_start(pieces)
            if not self._loop:
                self._another = next(streams, None) is not None
                return

    def _from_start(self, pieces: Iterator[Piece]) -> Iterator[Piece]:
        skip = round(self._start * self.sample_rate)
        begun = False
        for gap, samples in pieces:
            without = min(skip, gap)
            skip, gap = skip - without, gap - without
            without = min(skip, samples.shape[1])
            skip, samples = skip - without, samples[:, without:]
            if samples.shape[1]:
                yield gap * begun, samples  # it begins with sound
                begun = True
        if not begun and not self._stopping.is_set():
            raise device_error(f"{self.name}: start={self._start:g} is behind the end of the stream")

    def read(self) -> Chunk | None:
        """The next chunk in its time; None after the end, ``::bass::e_device`` where another stream follows."""
        while (chunk := self._chunks.take()) is None:
            piece = next(self._pieces, None)
            if piece is None:
                chunk = self._chunks.take(whole=False)
                break
            gap, samples = piece
            self.overruns += gap > 0
            self.lost_frames += gap
            self._chunks.lose(gap)
            self._chunks.add(samples)
        if chunk is not None:
            due = self._pacer.wait(chunk[1] + self._frames_per_chunk)
            return None if due is None else Chunk(*chunk, due)
        if self._another:
            raise device_error(
                f"{self.name}: here a new stream begins in the bag; ?stream={self._stream + 1} plays that"
            )
        return None

    def close(self) -> None:
        """Close the bag."""
        self._recording.close()


class _Recording:
    """The messages of one port Audio in a bag.

    Raises ``::bass::e_device`` where the file is no whole bag, or does not hold that port.
    """

    def __init__(self, path: str, topic: str | None, stopping: threading.Event) -> None:
        self._path = Path(os.path.expanduser(path))
        self._message_class = wire.message_class("bass", _AUDIO)
        try:
            self._bag = BagFile(self._path, MAX_MESSAGE, stopping)
        except (OSError, ValueError) as problem:  # ValueError: a path that no file can have
            raise device_error(f"{path}: {getattr(problem, 'strerror', None) or problem}") from None
        except NotClosedError:
            raise device_error(
                f"{path} was not closed by its recorder, or is cut off; `rosbag reindex {path}` repairs what is there"
            ) from None
        except BagError as problem:
            raise device_error(f"{path} {problem}") from None
        try:
            self._topic = self._pick(topic)
        except ComponentError:
            self.close()
            raise

    def _pick(self, topic: str | None) -> str:
        found = {connection.topic: connection.type for connection in self._bag.connections.values()}
        ports = sorted(name for name, kind in found.items() if kind.endswith(f"/{self._message_class.__name__}"))
        if topic is None and len(ports) == 1:
            return ports[0]
        if topic is not None and topic in ports:
            return topic
        if topic in found:
            raise device_error(f"{self._path}: {topic} is no port Audio, but of type {found[topic]}")
        there = ", ".join((ports if ports or topic is None else sorted(found))[:MAX_LISTED]) or "none"
        if topic is not None:
            raise device_error(f"{self._path}: no topic {topic} in there; there are: {there}")
        if not ports:
            raise device_error(f"{self._path} holds no port Audio (type {self._message_class._type})")
        raise device_error(f"{self._path} holds several ports Audio: pick one with ?topic=, of {there}")

    def streams(self) -> Iterator[tuple[int, Iterator[Piece]]]:
        """Each stream: its sample rate (Hz) and its pieces, to be read before the next one is asked for.

        A stream of a single message is what a latched port still showed from before; it counts only where there is
        nothing else.
        """
        lone: list[tuple[int, Piece]] = []
        played = False
        for _, group in groupby(self._numbered(), key=lambda item: item[0]):
            head = [item[1:] for _, item in zip(range(2), group, strict=False)]
            sample_rate = head[0][0]
            if len(head) == 1:
                lone = head
            else:
                played = True
                yield sample_rate, chain((piece for _, piece in head), (piece for _, _, piece in group))
        if lone and not played:
            yield lone[0][0], iter([lone[0][1]])

    def _numbered(self) -> Iterator[tuple[int, int, Piece]]:
        """Number of the stream, its sample rate, and a piece of it."""
        count, stream = 0, WindowStream(with_first=True)
        for message in self._messages():
            problem = malformed(message)
            if problem:
                raise device_error(f"{self._path}: a malformed message on {self._topic}: {problem}")
            if stream.joint(message):
                count, stream = count + 1, WindowStream(with_first=True)
            yield count, message.sampleRate, stream.fresh(message)

    def _messages(self) -> Iterator[Any]:
        connections = {number for number, one in self._bag.connections.items() if one.topic == self._topic}
        try:
            for number, data in self._bag.messages(connections):
                md5sum = self._bag.connections[number].md5sum
                if md5sum != self._message_class._md5sum:
                    raise device_error(f"{self._path}: {self._topic} is of another version of its type ({md5sum})")
                yield self._message_class().deserialize(data)
        except BagError as problem:
            raise device_error(f"{self._path} {problem}") from None
        except (genpy.DeserializationError, OSError, ValueError) as problem:
            raise device_error(f"{self._path} is damaged: {problem}") from None

    def close(self) -> None:
        """Close the bag."""
        self._bag.close()
