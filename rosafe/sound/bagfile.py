"""Messages out of a bag file of ROS, format 2.0, as bytes, in memory that no bag can fill.

rosbag's own reader believes every length in the file, keeps the whole index in memory, and makes Python code of the
message definitions in the bag, which it runs. None of that is for files that somebody else may have made.

A bag is a line that names the format, and records of a header (fields `name=value`) and data: the bag's header, chunks
of connections and messages, each chunk with its index behind it, and at the end all connections again. What is read
here are the connections at the end, and the chunks one after the other: messages come as they were recorded.
"""

from __future__ import annotations

import bz2
import importlib
import os
import struct
import threading
from collections.abc import Callable, Container, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol

from rosafe.input import open_descriptor

MAX_HEADER = 2**20  # bytes
MAX_CONNECTIONS = 10_000
MAX_NAME = 1000  # characters of a topic or type
_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _INDEX, _CHUNK, _CONNECTION = 2, 3, 4, 5, 7  # the field `op` of a record's header
_INDEX_ENTRY = 12  # bytes
_PIECE = 2**16  # bytes of a compressed chunk that are unpacked at a time,
_UNPACKED_PIECE = 2**20  # and at most so many of what comes out


class BagError(Exception):
    """The bag cannot be read; the text, which follows the file's name, says why."""


class NotClosedError(BagError):
    """The bag has no index, since its recorder did not close it, or its end is missing."""


class BagConnection(NamedTuple):
    """One publisher of a topic."""

    topic: str
    type: str
    md5sum: str


class BagReader:
    """A bag, open for reading.

    Parameters
    ----------
    path : Path
        The file.
    largest : int
        Bytes of a message that are read; longer ones count as damage.
    stopping : threading.Event
        Once set, `messages` ends.

    Attributes
    ----------
    connections : dict of int to Connection

    Raises
    ------
    BagError, OSError
        The file is no bag, or not a whole one, or cannot be read.
    """

    def __init__(self, path: Path, largest: int, stopping: threading.Event) -> None:
        self._largest = largest
        self._stopping = stopping
        self._descriptor = open_descriptor(path)
        try:
            self._size = os.fstat(self._descriptor).st_size
            self._read_bag_header()
            self.connections = self._read_connections()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file; once more is no harm."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _read_bag_header(self) -> None:
        if os.pread(self._descriptor, len(_MAGIC), 0) != _MAGIC:
            raise BagError("is not a bag of format 2.0")  # without a byte of it: who asks may not be allowed to read it
        try:
            records = _FileSlice(self._descriptor, len(_MAGIC), self._size)
            header = _read_header(records, _BAG)
            self._index = _number(header, "index_pos", 8)
            self._count = _number(header, "conn_count", 4)
            records.skip(_length(records))
        except BagError as problem:
            raise NotClosedError(str(problem)) from None
        if not records.at <= self._index <= self._size:  # 0 before it is closed
            raise NotClosedError("has no index")
        self._first = records.at
        if "encryptor" in header:
            raise BagError("is encrypted")

    def _read_connections(self) -> dict[int, BagConnection]:
        if self._count > MAX_CONNECTIONS:
            raise BagError(f"is not a whole bag: {self._count} connections, at most {MAX_CONNECTIONS} go")
        records = _FileSlice(self._descriptor, self._index, self._size)
        found = {}
        try:
            for _ in range(self._count):
                header = _read_header(records, _CONNECTION)
                data = _fields(_read(records, MAX_HEADER))
                texts = (_text(header, "topic"), _text(data, "type"), _text(data, "md5sum"))
                found[_number(header, "conn", 4)] = BagConnection(*texts)
        except BagError as problem:
            raise NotClosedError(str(problem)) from None
        return found

    def messages(self, connections: Container[int]) -> Iterator[tuple[int, bytes]]:
        """The messages of these connections: number of the connection, and the message. May be called again.

        Raises BagError where the bag is damaged.
        """
        records = _FileSlice(self._descriptor, self._first, self._index)
        try:
            while records.left:
                self._check_stop()
                header = _read_header(records)
                length = _length(records)
                op = _number(header, "op", 1)
                if op == _INDEX:
                    length = _INDEX_ENTRY * _number(header, "count", 4)  # some recorders wrote another length
                elif op == _CHUNK:
                    yield from self._messages_in(self._chunk(header, records.part(length)), connections)
                records.skip(length)
        except _StopReading:
            return

    def _chunk(self, header: dict[str, bytes], packed: _FileSlice) -> _Bytes:
        compression = header.get("compression", b"").decode("ascii", "replace")
        if compression == "none":
            return packed
        if compression not in _UNPACK:
            raise BagError(f"is damaged: compression {compression[:20]!r}")
        return _DecompressedChunk(_UNPACK[compression](_pieces(packed)), _number(header, "size", 4), self._check_stop)

    def _messages_in(self, chunk: _Bytes, connections: Container[int]) -> Iterator[tuple[int, bytes]]:
        while chunk.left:
            self._check_stop()
            header = _read_header(chunk)
            connection = _number(header, "conn", 4)
            if _number(header, "op", 1) == _MESSAGE and connection in connections:
                yield connection, _read(chunk, self._largest)
            else:
                chunk.skip(_length(chunk))

    def _check_stop(self) -> None:
        if self._stopping.is_set():
            raise _StopReading


class _StopReading(Exception):
    """It is told to stop."""


# --- bytes ------------------------------------------------------------------------------------------------------


class _Bytes(Protocol):
    """Bytes to be read in order."""

    left: int

    def read(self, count: int) -> bytes:
        """The next `count` bytes; BagError where there are fewer."""

    def skip(self, count: int) -> None:
        """Leave out the next `count` bytes; BagError where there are fewer."""


class _FileSlice:
    """The bytes of a file from `at` to `end`."""

    def __init__(self, descriptor: int, at: int, end: int) -> None:
        self._descriptor = descriptor
        self.at = at
        self.left = end - at

    def read(self, count: int) -> bytes:
        """The next ones."""
        at = self.at
        self.skip(count)  # before any memory is taken
        data = os.pread(self._descriptor, count, at)
        if len(data) != count:
            raise BagError("is damaged: it has become shorter")
        return data

    def skip(self, count: int) -> None:
        """Go on behind them."""
        if count > self.left:
            raise BagError(f"is damaged: {count} bytes are announced where {self.left} are left")
        self.at += count
        self.left -= count

    def part(self, length: int) -> _FileSlice:
        """The next `length` bytes as a stretch of their own."""
        return _FileSlice(self._descriptor, self.at, self.at + min(length, self.left))


class _DecompressedChunk:
    """The `size` bytes of a compressed chunk, unpacked as they are needed."""

    def __init__(self, unpacked: Iterator[bytes], size: int, check_stop: Callable[[], None]) -> None:
        self.left = size
        self._unpacked = unpacked
        self._check_stop = check_stop
        self._ready = memoryview(b"")

    def read(self, count: int) -> bytes:
        """The next ones."""
        return b"".join(self._take(count))

    def skip(self, count: int) -> None:
        """Unpack and forget them."""
        for _ in self._take(count):
            pass

    def _take(self, count: int) -> Iterator[memoryview]:
        if count > self.left:
            raise BagError(f"is damaged: {count} bytes are announced where {self.left} are left of a chunk")
        self.left -= count
        while count:
            if not self._ready:
                self._check_stop()
                self._ready = memoryview(self._next())
            yield self._ready[:count]
            taken = min(count, len(self._ready))
            self._ready = self._ready[taken:]
            count -= taken

    def _next(self) -> bytes:
        try:
            return next(self._unpacked)
        except (OSError, EOFError, ValueError) as problem:
            raise BagError(f"is damaged: a compressed chunk: {problem}") from None
        except StopIteration:
            raise BagError("is damaged: a compressed chunk ends too early") from None


def _pieces(packed: _FileSlice) -> Iterator[bytes]:
    while packed.left:
        yield packed.read(min(_PIECE, packed.left))


def _unpack_bz2(pieces: Iterator[bytes]) -> Iterator[bytes]:
    """What they hold, in bounded pieces again: one of theirs may unpack to a gigabyte."""
    unpacker = bz2.BZ2Decompressor()
    for piece in pieces:
        yield unpacker.decompress(piece, _UNPACKED_PIECE)
        while not (unpacker.needs_input or unpacker.eof):
            yield unpacker.decompress(b"", _UNPACKED_PIECE)


def _unpack_lz4(pieces: Iterator[bytes]) -> Iterator[bytes]:
    """What they hold: at most 255 times as much."""
    try:
        unpacker = importlib.import_module("roslz4").LZ4Decompressor()
    except ImportError as problem:
        raise BagError(f"is compressed by lz4, which needs Debian's python3-roslz4 ({problem})") from None
    return map(unpacker.decompress, pieces)


_UNPACK = {"bz2": _unpack_bz2, "lz4": _unpack_lz4}


def _length(source: _Bytes) -> int:
    return int(struct.unpack("<I", source.read(4))[0])


def _read(source: _Bytes, largest: int) -> bytes:
    """Bytes with their number before them."""
    length = _length(source)
    if length > largest:
        raise BagError(f"is damaged: {length} bytes are announced, at most {largest} go there")
    return source.read(length)


def _read_header(source: _Bytes, op: int | None = None) -> dict[str, bytes]:
    """A record's header; `source` is at the length of the data then."""
    header = _fields(_read(source, MAX_HEADER))
    if op is not None and _number(header, "op", 1) != op:
        raise BagError(f"is damaged: a record of kind {_number(header, 'op', 1)} where {op} is wanted")
    return header


def _fields(data: bytes) -> dict[str, bytes]:
    fields, at = {}, 0
    while at < len(data):
        end = at + 4 + int.from_bytes(data[at : at + 4], "little")
        name, equals, value = data[at + 4 : end].partition(b"=")
        if end > len(data) or not equals:
            raise BagError("is damaged: a header's fields")
        fields[name.decode("utf-8", "replace")] = value
        at = end
    return fields


def _number(header: dict[str, bytes], name: str, size: int) -> int:
    value = header.get(name, b"")
    if len(value) != size:
        raise BagError(f"is damaged: a header without {name!r}")
    return int.from_bytes(value, "little")


def _text(header: dict[str, bytes], name: str) -> str:
    text = header.get(name, b"").decode("utf-8", "replace")
    if not 0 < len(text) <= MAX_NAME or not text.isprintable():
        raise BagError(f"is damaged: the {name} of a connection")
    return text
