"""An .npz file that grows block by block, several arrays at once; and reading one larger than the memory.

numpy's own `savez` wants each array whole. Here the sizes are known beforehand, so that every array has its place in
the file from the start and is written into it as it comes. Arrays lie in Fortran order: time is the slowest axis, and
the file's order is that in which the blocks came. `numpy.load` reads it as any other .npz.

The container is a zip file without compression, always with the fields for sizes beyond 4 GiB (PKWARE's APPNOTE.TXT,
4.3 and 4.5.3); the arrays in it are .npy files (numpy.lib.format).
"""

from __future__ import annotations

import io
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
from numpy.lib import format as npy

_ALIGNMENT = 64  # of the data in the file, as numpy aligns them in an .npy
_SAMPLE = np.dtype("<f8")
_IN_ZIP64 = 0xFFFFFFFF  # a 32-bit field that says: see the zip64 field
_VERSION = 45  # of the format, the first with zip64
_DATE = 1 << 5 | 1  # 1980-01-01, the first there is: the same numbers give the same file
_PADDING_ID = 0xD935  # of an extra field that is there for alignment only


class _Member:
    """One array: where it lies and how far it is written."""

    def __init__(self, name: str, shape: tuple[int, ...], head: bytes, start: int) -> None:
        self.file_name = f"{name}.npy".encode()
        self.shape = shape
        self.start = start  # of its local header
        plain = start + 30 + len(self.file_name) + 20 + 4
        self.padding = -plain % _ALIGNMENT
        self.content = plain + self.padding  # where the .npy begins
        self.size = len(head) + _SAMPLE.itemsize * math.prod(shape)
        self.head = head
        self.written = len(head)
        self.crc = zlib.crc32(head)

    @property
    def end(self) -> int:
        return self.content + self.size

    def local_header(self) -> bytes:
        return (
            struct.pack("<4s5H3L2H", b"PK\3\4", *self._common(), len(self.file_name), 20 + 4 + self.padding)
            + self.file_name
            + struct.pack("<HHQQ", 1, 16, self.size, self.size)
            + struct.pack("<HH", _PADDING_ID, self.padding)
            + bytes(self.padding)
        )

    def central_header(self) -> bytes:
        made_by_unix = 3 << 8 | _VERSION
        permissions = 0o100644 << 16
        return (
            struct.pack("<4sH5H3L2H", b"PK\1\2", made_by_unix, *self._common(), len(self.file_name), 28)
            + struct.pack("<3H2L", 0, 0, 0, permissions, _IN_ZIP64)
            + self.file_name
            + struct.pack("<HHQQQ", 1, 24, self.size, self.size, self.start)
        )

    def _common(self) -> tuple[int, ...]:
        """What both headers say: version, flags, method (stored), time, date, CRC and the two sizes."""
        return (_VERSION, 0, 0, 0, _DATE, self.crc, _IN_ZIP64, _IN_ZIP64)


class NpzWriter:
    """Writes an .npz of arrays that are there and of arrays that are still to come.

    Different arrays may be appended to from different threads at the same time.

    Parameters
    ----------
    descriptor : int
        Of an empty file, open for writing; it stays open.
    arrays : mapping of str to array_like
        Written at once; numbers and strings.
    shapes : mapping of str to tuple of int
        Shapes of the float64 arrays that come through `append`, the last axis being the time.
    """

    def __init__(
        self, descriptor: int, arrays: Mapping[str, np.ndarray | float | str], shapes: Mapping[str, tuple[int, ...]]
    ) -> None:
        self._descriptor = descriptor
        self._members: dict[str, _Member] = {}
        for name, value in arrays.items():
            whole = io.BytesIO()
            npy.write_array(whole, np.asanyarray(value), allow_pickle=False)
            self._add(name, (0,), whole.getvalue())
        for name, shape in shapes.items():
            head = io.BytesIO()
            npy.write_array_header_1_0(head, {"descr": _SAMPLE.str, "fortran_order": True, "shape": shape})
            self._add(name, shape, head.getvalue())

    def _add(self, name: str, shape: tuple[int, ...], head: bytes) -> None:
        start = max((member.end for member in self._members.values()), default=0)
        self._members[name] = _Member(name, shape, head, start)

    @property
    def size(self) -> int:
        """Bytes that the file will have, but for its directory at the end."""
        return max((member.end for member in self._members.values()), default=0)

    def append(self, name: str, block: np.ndarray) -> None:
        """Write the next part of an array, of its shape but for the last axis; ValueError where it does not fit."""
        member = self._members[name]
        data = np.ascontiguousarray(block.T, _SAMPLE)
        if block.shape[:-1] != member.shape[:-1] or member.written + data.nbytes > member.size:
            raise ValueError(f"{name}: a block of shape {block.shape} does not fit into {member.shape}")
        if data.nbytes:
            content = data.data.cast("B")
            self._write(content, member.content + member.written)
            member.crc = zlib.crc32(content, member.crc)
            member.written += data.nbytes

    def finish(self) -> None:
        """Write all that is not data; ValueError where an array is not complete."""
        for name, member in self._members.items():
            if member.written != member.size:
                raise ValueError(f"{name}: {member.size - member.written} bytes of it never came")
            self._write(member.local_header() + member.head, member.start)
        directory = b"".join(member.central_header() for member in self._members.values())
        start, count = self.size, len(self._members)
        self._write(directory + _directory_end(start, len(directory), count), start)

    def _write(self, content: bytes | memoryview, at: int) -> None:
        rest = memoryview(content)
        while rest:
            written = os.pwrite(self._descriptor, rest, at)
            rest, at = rest[written:], at + written


def _directory_end(start: int, size: int, count: int) -> bytes:
    """The three records after the directory, which is at `start`."""
    return (
        struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, _VERSION, _VERSION, 0, 0, count, count, size, start)
        + struct.pack("<4sLQL", b"PK\6\7", 0, start + size, 1)
        + struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, _IN_ZIP64, _IN_ZIP64, 0)
    )


def memory_map(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of an uncompressed .npz as read-only memory maps: only what is looked at is read from disk.

    Works on what `NpzWriter` and `numpy.savez` write. Raises OSError, zipfile.BadZipFile, or ValueError for an
    .npz that is compressed or holds Python objects.
    """
    arrays: dict[str, np.ndarray] = {}
    with open(path, "rb") as file, zipfile.ZipFile(file) as container:
        for info in container.infolist():
            if info.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"{path}: {info.filename} is compressed")
            file.seek(info.header_offset + 26)
            file.seek(sum(struct.unpack("<2H", file.read(4))), os.SEEK_CUR)
            shape, order, dtype = _read_header(file)
            if dtype.hasobject:
                raise ValueError(f"{path}: {info.filename} holds Python objects")
            name = info.filename.removesuffix(".npy")
            if math.prod(shape) == 0:
                arrays[name] = np.zeros(shape, dtype, order)
            else:
                arrays[name] = np.memmap(path, dtype, "r", file.tell(), shape, order)
    return arrays


def _read_header(file: BinaryIO) -> tuple[tuple[int, ...], Literal["C", "F"], np.dtype]:
    """Shape, order and type of the .npy that `file` is at; `file` is at its data then."""
    read = npy.read_array_header_1_0 if npy.read_magic(file) == (1, 0) else npy.read_array_header_2_0
    shape, fortran_order, dtype = read(file)
    return shape, "F" if fortran_order else "C", dtype
