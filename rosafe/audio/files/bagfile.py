"""Reader of rosbag files (format 2.0) that returns messages as bytes and needs limited memory for any file.

The reader of rosbag trusts every length in the file, keeps the whole index in memory, and executes Python code that it
generates from the message definitions in the bag. It is therefore not safe for files from an untrusted source.

A bag starts with a line that names the format. Records follow, each with a header (fields `name=value`) and data: the
header of the bag; chunks of connections and messages, each chunk followed by its index; finally all connections again.
This module reads the connections at the end and then the chunks in order, so messages come in the order of recording.
"""

from __future__ import annotations

import bz2
import importlib
import os
import threading
from collections.abc import Callable, Container, Iterator
from pathlib import Path
from typing import NamedTuple

from rosafe.system.input import open_descriptor

MAX_HEADER = 2**20  # bytes
MAX_CONNECTIONS = 10_000
MAX_NAME = 1000  # characters of a topic or type
_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _INDEX, _CHUNK, _CONNECTION = 2, 3, 4, 5, 7  # the field `op` of a record's header
_INDEX_ENTRY = 12  # bytes
_COMPRESSED_PIECE = 2**16  # bytes of a compressed chunk that are decompressed at a time
_DECOMPRESSED_PIECE = 2**20  # maximum number of bytes that bz2 returns at a time


class BagError(Exception):
    """The bag cannot be read; the text is the reason and is to follow the file's name."""


class NotClosedError(BagError):
    """The bag has no index because its recorder did not close it, or its end is missing."""


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
    max_message : int
        Maximum size of a message in bytes; a longer one counts as damage.
    stopping : threading.Event
        Once set, `messages` ends.

    Attributes
    ----------
    connections : dict of int to BagConnection

    Raises
    ------
    BagError, OSError
        The file is not a bag, is incomplete, or cannot be read.
    """

    def __init__(self, path: Path, max_message: int, stopping: threading.Event) -> None:
        self._max_message = max_message
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
        """Close the file; further calls have no effect."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _read_bag_header(self) -> None:
        if os.pread(self._descriptor, len(_MAGIC), 0) != _MAGIC:
            # The message contains no byte of the file, as the caller may lack the right to read it.
            raise BagError("is not a bag of format 2.0")
        try:
            records = _FileSlice(self._descriptor, len(_MAGIC), self._size)
            header = _read_header(records, _BAG)
            self._index = _number(header, "index_pos", 8)
            self._count = _number(header, "conn_count", 4)
            records.skip(_length(records))
        except BagError as problem:
            raise NotClosedError(str(problem)) from None
        if not records.at <= self._index <= self._size:  # 0 in a bag that was not closed
            raise NotClosedError("has no index")
        self._first = records.at
        if "encryptor" in header:
            raise BagError("is encrypted")

    def _read_connections(self) -> dict[int, BagConnection]:
        if self._count > MAX_CONNECTIONS:
            raise BagError(f"is damaged: expected at most {MAX_CONNECTIONS} connections, got {self._count}")
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
        """Yield the number of the connection and the bytes of each message of `connections`. Can be called repeatedly.

        Raises BagError if the bag is damaged.
        """
        records = _FileSlice(self._descriptor, self._first, self._index)
        try:
            while records.left:
                self._check_stop()
                header = _read_header(records)
                length = _length(records)
                op = _number(header, "op", 1)
                if op == _INDEX:
                    length = _INDEX_ENTRY * _number(header, "count", 4)  # some recorders write a wrong length
                elif op == _CHUNK:
                    yield from self._messages_in(self._chunk(header, records.part(length)), connections)
                records.skip(length)
        except _StopReading:
            return

    def _chunk(self, header: dict[str, bytes], data: _FileSlice) -> _ByteSource:
        compression = header.get("compression", b"").decode("ascii", "replace")
        if compression == "none":
            return data
        if compression not in _DECOMPRESS:
            raise BagError(f"is damaged: unknown compression {compression[:20]!r}")
        return _DecompressedChunk(_DECOMPRESS[compression](_pieces(data)), _number(header, "size", 4), self._check_stop)

    def _messages_in(self, chunk: _ByteSource, connections: Container[int]) -> Iterator[tuple[int, bytes]]:
        while chunk.left:
            self._check_stop()
            header = _read_header(chunk)
            connection = _number(header, "conn", 4)
            if _number(header, "op", 1) == _MESSAGE and connection in connections:
                yield connection, _read(chunk, self._max_message)
            else:
                chunk.skip(_length(chunk))

    def _check_stop(self) -> None:
        if self._stopping.is_set():
            raise _StopReading


class _StopReading(Exception):
    """Reading was stopped by the caller."""


# --- bytes ------------------------------------------------------------------------------------------------------


class _FileSlice:
    """The bytes of a file from `at` to `end`. Methods raise BagError if fewer than `count` bytes are `left`."""

    def __init__(self, descriptor: int, at: int, end: int) -> None:
        self._descriptor = descriptor
        self.at = at
        self.left = end - at

    def read(self, count: int) -> bytes:
        """Return the next `count` bytes."""
        at = self.at
        self.skip(count)  # checks `count` before memory is allocated
        data = os.pread(self._descriptor, count, at)
        if len(data) != count:
            raise BagError("is damaged: it has been truncated while it was read")
        return data

    def skip(self, count: int) -> None:
        """Skip the next `count` bytes."""
        if count > self.left:
            raise BagError(f"is damaged: a record of {count} bytes, but only {self.left} remain")
        self.at += count
        self.left -= count

    def part(self, length: int) -> _FileSlice:
        """Return the next `length` bytes as a slice of their own."""
        return _FileSlice(self._descriptor, self.at, self.at + min(length, self.left))


class _DecompressedChunk:
    """The `size` bytes of a compressed chunk, decompressed on demand, with the methods of a `_FileSlice`."""

    def __init__(self, decompressed: Iterator[bytes], size: int, check_stop: Callable[[], None]) -> None:
        self.left = size
        self._decompressed = decompressed
        self._check_stop = check_stop
        self._ready = memoryview(b"")

    def read(self, count: int) -> bytes:
        """Return the next `count` bytes."""
        return b"".join(self._take(count))

    def skip(self, count: int) -> None:
        """Decompress and discard the next `count` bytes."""
        for _ in self._take(count):
            pass

    def _take(self, count: int) -> Iterator[memoryview]:
        if count > self.left:
            raise BagError(f"is damaged: a record of {count} bytes, but only {self.left} remain of its chunk")
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
            return next(self._decompressed)
        except (OSError, EOFError, ValueError) as problem:
            raise BagError(f"is damaged: a compressed chunk: {problem}") from None
        except StopIteration:
            raise BagError("is damaged: a compressed chunk is truncated") from None


_ByteSource = _FileSlice | _DecompressedChunk


def _pieces(data: _FileSlice) -> Iterator[bytes]:
    while data.left:
        yield data.read(min(_COMPRESSED_PIECE, data.left))


def _decompress_bz2(pieces: Iterator[bytes]) -> Iterator[bytes]:
    """Decompress in pieces of limited size: a single input piece can expand to a gigabyte."""
    decompressor = bz2.BZ2Decompressor()
    for piece in pieces:
        yield decompressor.decompress(piece, _DECOMPRESSED_PIECE)
        while not (decompressor.needs_input or decompressor.eof):
            yield decompressor.decompress(b"", _DECOMPRESSED_PIECE)


def _decompress_lz4(pieces: Iterator[bytes]) -> Iterator[bytes]:
    """Decompress; the output is at most 255 times as long."""
    try:
        decompressor = importlib.import_module("roslz4").LZ4Decompressor()
    except ImportError as problem:
        raise BagError(f"is compressed with lz4; install Debian's python3-roslz4 ({problem})") from None
    return map(decompressor.decompress, pieces)


_DECOMPRESS = {"bz2": _decompress_bz2, "lz4": _decompress_lz4}


def _length(source: _ByteSource) -> int:
    return int.from_bytes(source.read(4), "little")


def _read(source: _ByteSource, max_length: int) -> bytes:
    """Return the bytes of a field that starts with its length."""
    length = _length(source)
    if length > max_length:
        raise BagError(f"is damaged: expected a field of at most {max_length} bytes, got {length}")
    return source.read(length)


def _read_header(source: _ByteSource, op: int | None = None) -> dict[str, bytes]:
    """Return the header of a record and leave `source` at the length of the data."""
    header = _fields(_read(source, MAX_HEADER))
    if op is not None and _number(header, "op", 1) != op:
        raise BagError(f"is damaged: expected a record of type {op}, got {_number(header, 'op', 1)}")
    return header


def _fields(data: bytes) -> dict[str, bytes]:
    fields, at = {}, 0
    while at < len(data):
        end = at + 4 + int.from_bytes(data[at : at + 4], "little")
        name, equals, value = data[at + 4 : end].partition(b"=")
        if end > len(data) or not equals:
            raise BagError("is damaged: malformed fields of a record header")
        fields[name.decode("utf-8", "replace")] = value
        at = end
    return fields


def _number(header: dict[str, bytes], name: str, size: int) -> int:
    value = header.get(name, b"")
    if len(value) != size:
        raise BagError(f"is damaged: a record header without a valid {name!r}")
    return int.from_bytes(value, "little")


def _text(header: dict[str, bytes], name: str) -> str:
    text = header.get(name, b"").decode("utf-8", "replace")
    if not 0 < len(text) <= MAX_NAME or not text.isprintable():
        raise BagError(f"is damaged: invalid {name} of a connection")
    return text
