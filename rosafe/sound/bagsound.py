"""The sound in a rosbag: the streams of one port Audio, every frame once. Needs nothing of ROS."""

from __future__ import annotations

import os
import struct
import threading
from collections.abc import Iterator
from itertools import chain, groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rosafe.sound.bagfile import BagError, BagReader, NotClosedError
from rosafe.sound.windows import MAX_WINDOW, WindowStream, window_error

TYPE = "binaudio_portStruct"  # of the port Audio, in the package bass or another
MD5SUM = "a3b73b6f3547870cf712571c1a85ea1d"
MAX_MESSAGE = 2 * 4 * MAX_WINDOW + 1024  # bytes: both ears, and the rest
MAX_LISTED = 20  # topics in a refusal
_HEAD, _LENGTH, _STAMP = struct.Struct("<3IQ"), struct.Struct("<I"), 8
Piece = tuple[int, np.ndarray]  # frames lost before it, and int32 (2, n)


class BagSoundError(Exception):
    """The bag, or the port in it, cannot be read; the text is one line that names it and says why."""


class _Message(NamedTuple):
    """A message of the port Audio, as it is on the wire."""

    sampleRate: int
    nChunksOnPort: int
    nFramesPerChunk: int
    lastFrameIndex: int
    left: np.ndarray
    right: np.ndarray


def _decoded(data: bytes) -> _Message:
    """The message in these bytes; ValueError or struct.error where they hold none."""
    numbers = _HEAD.unpack_from(data)
    at, ears = _HEAD.size, []
    for _ in range(2):
        (count,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        if count > (len(data) - at) // 4:
            raise ValueError(f"{count} samples are announced in a message of {len(data)} bytes")
        ears.append(np.frombuffer(data, "<i4", count, at))
        at += 4 * count
    if at + _STAMP != len(data):
        raise ValueError(f"a message of {len(data)} bytes holds {at + _STAMP}")
    return _Message(*numbers, *ears)


class Recording:
    """The messages of one port Audio in a bag.

    Parameters
    ----------
    path : path
        The bag; ``~`` is the user's home.
    topic : str, optional
        Of the port; by default the only one, or `usual` of several.
    stopping : threading.Event
        Once set, what iterates ends.
    usual : str
        The topic to take where there are several and none is named.
    several : str
        What to do where there are several ports, for the refusal.

    Raises
    ------
    BagSoundError
        The file is not a whole bag, or does not hold that port.
    """

    def __init__(
        self,
        path: str | Path,
        topic: str | None,
        stopping: threading.Event,
        usual: str = "",
        several: str = "pick one with ?topic=",
    ) -> None:
        self._path = Path(os.path.expanduser(path))
        try:
            self._bag = BagReader(self._path, MAX_MESSAGE, stopping)
        except (OSError, ValueError) as problem:  # ValueError: a path that no file can have
            raise BagSoundError(f"{path}: {getattr(problem, 'strerror', None) or problem}") from None
        except NotClosedError:
            raise BagSoundError(
                f"{path} was not closed by its recorder, or is cut off; `rosbag reindex {path}` repairs what is there"
            ) from None
        except BagError as problem:
            raise BagSoundError(f"{path} {problem}") from None
        try:
            self.topic = self._pick(topic, usual, several)
        except BagSoundError:
            self.close()
            raise

    def _pick(self, topic: str | None, usual: str, several: str) -> str:
        found = {connection.topic: connection.type for connection in self._bag.connections.values()}
        ports = sorted(name for name, kind in found.items() if kind.endswith(f"/{TYPE}"))
        if topic is None and (len(ports) == 1 or usual in ports):
            return ports[0] if len(ports) == 1 else usual
        if topic is not None and topic in ports:
            return topic
        if topic in found:
            raise BagSoundError(f"{self._path}: {topic} is no port Audio, but of type {found[topic]}")
        there = ", ".join((ports if ports or topic is None else sorted(found))[:MAX_LISTED]) or "none"
        if topic is not None:
            raise BagSoundError(f"{self._path}: no topic {topic} in there; there are: {there}")
        if not ports:
            raise BagSoundError(f"{self._path} holds no port Audio (type bass/{TYPE})")
        raise BagSoundError(f"{self._path} holds several ports Audio: {several}, of {there}")

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
            problem = window_error(message)
            if problem:
                raise BagSoundError(f"{self._path}: a malformed message on {self.topic}: {problem}")
            if stream.join_state(message):
                count, stream = count + 1, WindowStream(with_first=True)
            yield count, message.sampleRate, stream.fresh(message)

    def _messages(self) -> Iterator[_Message]:
        connections = {number for number, one in self._bag.connections.items() if one.topic == self.topic}
        try:
            for number, data in self._bag.messages(connections):
                md5sum = self._bag.connections[number].md5sum
                if md5sum != MD5SUM:
                    raise BagSoundError(f"{self._path}: {self.topic} is of another version of its type ({md5sum})")
                yield _decoded(data)
        except BagError as problem:
            raise BagSoundError(f"{self._path} {problem}") from None
        except (struct.error, OSError, ValueError) as problem:
            raise BagSoundError(f"{self._path} is damaged: {problem}") from None

    def close(self) -> None:
        """Close the bag."""
        self._bag.close()
