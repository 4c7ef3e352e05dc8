"""The audio in a rosbag: the streams of one port Audio, with each frame once. Does not need ROS."""

from __future__ import annotations

import os
import struct
import threading
from collections.abc import Iterator
from itertools import chain, groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rosafe.audio.files.bagfile import BagError, BagReader, NotClosedError
from rosafe.audio.files.windows import MAX_WINDOW, WindowStream, mismatch, new_samples, window_error

TYPE = "binaudio_portStruct"  # of the port Audio, in the package bass or another
MD5SUM = "a3b73b6f3547870cf712571c1a85ea1d"
MAX_MESSAGE = 2 * 4 * MAX_WINDOW + 1024  # bytes: the samples of both ears, and the other fields
MAX_LISTED = 20  # topics in an error message
_EXPECTED = "expected a complete bag of format 2.0, got one that"
_HEAD, _LENGTH, _STAMP = struct.Struct("<3IQ"), struct.Struct("<I"), 8
Piece = tuple[int, np.ndarray]  # number of frames lost before the samples, and the samples, int32 (2, n)


class BagSoundError(Exception):
    """The bag, or the port in it, cannot be read; the text is one line with the file's name and the reason."""


class _Message(NamedTuple):
    """The fields of a message of the port Audio."""

    sampleRate: int
    nChunksOnPort: int
    nFramesPerChunk: int
    lastFrameIndex: int
    left: np.ndarray
    right: np.ndarray


def _decode(data: bytes) -> _Message:
    """Deserialize a message. Raises ValueError or struct.error."""
    numbers = _HEAD.unpack_from(data)
    at, ears = _HEAD.size, []
    for _ in range(2):
        (count,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        if count > (len(data) - at) // 4:
            raise ValueError(f"{count} samples do not fit into a message of {len(data)} bytes")
        ears.append(np.frombuffer(data, "<i4", count, at))
        at += 4 * count
    if at + _STAMP != len(data):
        raise ValueError(f"expected a message of {at + _STAMP} bytes, got {len(data)}")
    return _Message(*numbers, *ears)


class Recording:
    """The messages of one port Audio in a bag.

    Parameters
    ----------
    path : path
        The bag; ``~`` is the user's home.
    topic : str, optional
        Topic of the port. By default the only port in the bag, or `default` if there are several.
    stopping : threading.Event
        Once set, iterations end.
    default : str
        Topic to choose if there are several ports and `topic` is not given.
    advice : str
        What the user can do if there are several ports, for the error message.

    Raises
    ------
    BagSoundError
        The file is not a complete bag, or does not contain the port.
    """

    def __init__(
        self,
        path: str | Path,
        topic: str | None,
        stopping: threading.Event,
        default: str = "",
        advice: str = "choose one with ?topic=",
    ) -> None:
        self._path = Path(os.path.expanduser(path))
        try:
            self._bag = BagReader(self._path, MAX_MESSAGE, stopping)
        except (OSError, ValueError) as problem:  # ValueError: an invalid path
            raise BagSoundError(f"{path}: {getattr(problem, 'strerror', None) or problem}") from None
        except NotClosedError:
            raise BagSoundError(
                f"{path}: expected a complete bag, got one that was not closed by its recorder, or is truncated; "
                f"repair it with `rosbag reindex {path}`"
            ) from None
        except BagError as problem:
            raise BagSoundError(f"{path}: {_EXPECTED} {problem}") from None
        try:
            types = {connection.topic: connection.type for connection in self._bag.connections.values()}
            ports = sorted(name for name, kind in types.items() if kind.endswith(f"/{TYPE}"))
            self.topic = self._only_port(ports, default, advice) if topic is None else self._port(topic, ports, types)
        except BagSoundError:
            self.close()
            raise

    def _port(self, topic: str, ports: list[str], types: dict[str, str]) -> str:
        """Return `topic`. Raises BagSoundError if it is not one of the `ports`."""
        if topic in ports:
            return topic
        if topic in types:
            raise BagSoundError(f"{self._path}: expected {topic} to be a port Audio, got type {types[topic]}")
        topics = ", ".join((ports or sorted(types))[:MAX_LISTED]) or "none"
        raise BagSoundError(f"{self._path}: expected the topic {topic}, got {topics}")

    def _only_port(self, ports: list[str], default: str, advice: str) -> str:
        """Return the only one of the `ports`, or `default` if it is one of several. Raises BagSoundError."""
        if len(ports) == 1:
            return ports[0]
        if default in ports:
            return default
        if not ports:
            raise BagSoundError(f"{self._path}: expected a port Audio (type bass/{TYPE}), got none")
        raise BagSoundError(
            f"{self._path}: expected one port Audio, got several; {advice}: {', '.join(ports[:MAX_LISTED])}"
        )

    def streams(self) -> Iterator[tuple[int, Iterator[Piece]]]:
        """Yield the sample rate (Hz) and the pieces of each stream; read the pieces before the next stream.

        A stream of a single message is usually the last message of a latched port from before the recording. It is
        used only if there is no other stream.
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
        """Yield each piece with the number of its stream and the sample rate."""
        count, sample_rate, stream = 0, 0, WindowStream()
        for message in self._messages():
            problem = window_error(message)
            if problem:
                raise BagSoundError(f"{self._path}: malformed message on {self.topic}: {problem}")
            if sample_rate and mismatch(stream, sample_rate, message):
                count, stream = count + 1, WindowStream()
            sample_rate = message.sampleRate
            yield count, sample_rate, new_samples(stream, message)

    def _messages(self) -> Iterator[_Message]:
        connections = {number for number, found in self._bag.connections.items() if found.topic == self.topic}
        try:
            for number, data in self._bag.messages(connections):
                md5sum = self._bag.connections[number].md5sum
                if md5sum != MD5SUM:
                    raise BagSoundError(f"{self._path}: {self.topic}: expected md5sum {MD5SUM}, got {md5sum}")
                yield _decode(data)
        except BagError as problem:
            raise BagSoundError(f"{self._path}: {_EXPECTED} {problem}") from None
        except (struct.error, OSError, ValueError) as problem:
            raise BagSoundError(f"{self._path}: {_EXPECTED} is damaged: {problem}") from None

    def close(self) -> None:
        """Close the bag."""
        self._bag.close()


def from_first_samples(pieces: Iterator[Piece], skip: int = 0) -> Iterator[Piece]:
    """Skip the first `skip` frames of a stream, and frames that were lost before the first remaining samples."""
    started = False
    for lost, samples in pieces:
        skipped = min(skip, lost + samples.shape[1])
        skip -= skipped
        rest = samples[:, max(0, skipped - lost) :]
        if rest.shape[1]:
            yield max(0, lost - skipped) * started, rest
            started = True
