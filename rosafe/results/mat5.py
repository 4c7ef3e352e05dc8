"""Read MATLAB's version 5: arrays of numbers, and texts. The format: "MAT-File Format", The MathWorks.

scipy's reader is not used, because damaged files crash the interpreter in it.
"""

from __future__ import annotations

import io
import math
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from rosafe.results.memory import check_arrays
from rosafe.results.result_metadata import ABOUT, MAX_TEXT, is_scalar, new_array, parse_metadata, restored
from rosafe.system.input import open_regular

_HEAD = 128  # bytes
_MATRIX, _COMPRESSED = 14, 15
# numpy's names of data types and array classes
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_CHARACTERS, _COMPLEX = 4, 0x800
_ENCODINGS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}


class _Element(NamedTuple):
    """Header of an element: its type, the offsets of its data, and the offset of the next element."""

    kind: int
    start: int
    end: int
    after: int


class _Source:
    """Elements of a file, or of decompressed data, from the present position to `end`."""

    def __init__(self, file: BinaryIO, end: int, order: str) -> None:
        self.file = file
        self.end = end
        self.order = order

    def element(self) -> _Element:
        """Read the tag of the next element."""
        at = self.file.tell()
        first, count = struct.unpack(f"{self.order}II", self.take(8))
        if first >> 16:  # up to four bytes in the place of the length
            found = _Element(first & 0xFFFF, at + 4, at + 4 + (first >> 16), at + 8)
            if first >> 16 > 4:
                raise ValueError(f"expected a small element of at most 4 bytes, got {first >> 16}")
            self.file.seek(at + 4)
            return found
        end = at + 8 + count
        return _Element(first, at + 8, end, end if first == _COMPRESSED else min(self.end, end + -count % 8))

    def take(self, count: int) -> bytes:
        """Return the next `count` bytes."""
        content = self.file.read(count) if count <= self.end - self.file.tell() else b""
        if len(content) != count:
            raise ValueError("it is cut off")
        return content

    def small(self, kinds: tuple[int, ...], max_size: int) -> tuple[int, bytes]:
        """Return the type and the data of the next element; ValueError if it is longer than `max_size` bytes."""
        found = self.element()
        if found.kind not in kinds or found.end - found.start > max_size:
            raise ValueError(
                f"expected an element of type {kinds[0]} of at most {max_size} bytes, got type {found.kind} with "
                f"{found.end - found.start} bytes"
            )
        content = self.take(found.end - found.start)
        self.file.seek(found.after)
        return found.kind, content


def read_mat5(path: Path, arrays: bool = True) -> dict[str, Any]:
    """Return the contents of a version 5 .mat; without `arrays`, only the metadata. ValueError if it is damaged."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        found = dict(_variables(file, size, arrays))
    about = parse_metadata({name: value for name, value in found.items() if isinstance(value, str) or is_scalar(name)})
    axes = about.get("axes", {})
    others = found.keys() - about.keys()
    return {**{name: restored(found[name], axes.get(name)) for name in others}, **about}


def _variables(file: BinaryIO, size: int, arrays: bool) -> Iterator[tuple[str, Any]]:
    """Yield names and values of the variables; without `arrays`, only of those in `ABOUT`."""
    head = file.read(_HEAD)
    order = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}.get(head[124:])
    if order is None:
        raise ValueError("expected a .mat file of version 5 or 7.3")
    source, total = _Source(file, size, order), 0
    while file.tell() < size:
        outer = source.element()
        if outer.end > size:
            raise ValueError("it is cut off")
        inner = source
        if outer.kind == _COMPRESSED:
            content = _inflated(source.take(outer.end - outer.start), order, total, size)
            inner = _Source(io.BytesIO(content), len(content), order)
            if inner.element().kind != _MATRIX:
                raise ValueError("expected elements that are arrays, got another type")
        elif outer.kind != _MATRIX:
            raise ValueError("expected elements that are arrays, got another type")
        else:
            inner = _Source(file, outer.end, order)
        name, value = _matrix(inner, arrays, total, size)
        total += value.nbytes if isinstance(value, np.ndarray) else 0
        if arrays or name in ABOUT:
            yield name, value
        file.seek(outer.after)


def _inflated(content: bytes, order: str, total: int, size: int) -> bytes:
    """Return the decompressed array. `total` is the size of the arrays before it, `size` that of the file (bytes)."""
    inflate = zlib.decompressobj()
    try:
        tag = inflate.decompress(content, 8)
        count = struct.unpack(f"{order}I", tag[4:])[0] if len(tag) == 8 else 0
        check_arrays(total, size, count)
        return tag + (inflate.decompress(inflate.unconsumed_tail, count) if count else b"")
    except zlib.error as problem:
        raise ValueError(str(problem)) from None


def _matrix(source: _Source, arrays: bool, total: int, size: int) -> tuple[str, Any]:
    """Return the name and the value of an array; the value is None if it is not needed."""
    order = source.order
    flags = struct.unpack(f"{order}II", source.small((6,), 8)[1].ljust(8, b"\0"))[0]
    lengths = np.frombuffer(source.small((5,), 4 * 32)[1][: 4 * 32], f"{order}i4")
    shape = tuple(map(int, lengths))
    name = source.small((1, 16), 256)[1].decode()
    if flags & 0xFF == _CHARACTERS:
        kind, content = source.small(tuple(_ENCODINGS), 4 * MAX_TEXT)
        return name, _decoded(content, _ENCODINGS[kind], order)
    if flags & 0xFF not in _CLASSES or flags & _COMPLEX or min(shape, default=-1) < 0:
        raise ValueError(f"{ascii(name)[:80]}: expected an array of real numbers, or a text")
    data = source.element()
    if data.kind not in _TYPES:
        raise ValueError(f"{ascii(name)[:80]}: expected numbers")
    dtype = np.dtype(order + _TYPES[data.kind])
    count = math.prod(shape)
    if data.end > source.end or data.end - data.start != count * dtype.itemsize:
        raise ValueError(f"{ascii(name)[:80]}: expected {count} numbers by its shape, got another length")
    if not (arrays or name in ABOUT):
        return name, None
    check_arrays(total, size, count * max(dtype.itemsize, np.dtype(_CLASSES[flags & 0xFF]).itemsize))
    values = new_array((count,), dtype)
    if count and source.file.readinto(values.view(np.uint8).data) != values.nbytes:  # type: ignore[attr-defined]
        raise ValueError("it is cut off")
    return name, values.astype(_CLASSES[flags & 0xFF], copy=False).reshape(shape, order="F")


def _decoded(content: bytes, encoding: str, order: str) -> str:
    return content.decode(encoding + ("-le" if order == "<" else "-be") * encoding.startswith(("utf-16", "utf-32")))
