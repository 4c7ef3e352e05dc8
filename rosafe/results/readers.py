"""Read .npz and .csv. Sizes and types are checked before memory is allocated."""

from __future__ import annotations

import functools
import math
import os
import re
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np

from rosafe.declarations.text import short_repr
from rosafe.results.in_memory_formats import CSV_HEAD
from rosafe.results.memory import check_arrays
from rosafe.results.result_metadata import ABOUT, MAX_TEXT, checked, from_json, is_number, new_array, parse_metadata
from rosafe.system.input import open_regular

_MAX_MEMBERS = 4096  # members of an .npz
_MAX_HEADER = 4096  # bytes of the header of an array
_BLOCK = 2**20  # bytes read at a time
_MAGIC = re.compile(rb"\x93NUMPY[\x01-\x03]\x00", re.DOTALL)
_HEADER = re.compile(
    r"\{'descr': '([<>|=]?[biufU]\d{1,7})', 'fortran_order': (True|False), 'shape': \(([0-9, ]{0,500})\),? ?\}\s{0,500}"
)
_DAMAGED = (
    zipfile.BadZipFile,
    EOFError,
    zlib.error,
    NotImplementedError,
    RuntimeError,
    OverflowError,
    OSError,
    TypeError,
)
_ENCRYPTED = 1  # flag of a member
_MAX_NUMBER_LENGTH = 32  # characters of a number in a .csv; repr makes at most 24
_MAX_CSV_HEAD = 2**24  # bytes


def read_npz(path: Path, arrays: bool = True) -> dict[str, Any]:
    """Return the contents of an .npz; without `arrays`, only the metadata. ValueError if it is damaged."""
    with open_npz(path) as (members, read):
        found = {name: read(one) for name, one in members.items() if arrays or name in ABOUT}
    return {**found, **parse_metadata({name: value for name, value in found.items() if value.ndim == 0})}


@contextmanager
def open_npz(path: Path) -> Iterator[tuple[dict[str, zipfile.ZipInfo], Callable[..., np.ndarray]]]:
    """Yield the members of an .npz by name, and `read_array` for them; ValueError, also later, if it is damaged."""
    with open_regular(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        try:
            with zipfile.ZipFile(stream) as file:
                yield _members(file, size), functools.partial(_read_array, file)
        except _DAMAGED as problem:
            raise ValueError(str(problem)[:300]) from None


def _members(file: zipfile.ZipFile, size: int) -> dict[str, zipfile.ZipInfo]:
    """Return the members of a file of `size` bytes, after a check of their total size."""
    members = file.infolist()
    if len(members) > _MAX_MEMBERS:
        raise ValueError(f"expected at most {_MAX_MEMBERS} arrays, got {len(members)}")
    for one in members:
        if one.flag_bits & _ENCRYPTED or one.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError("expected arrays that are stored or deflated, and not encrypted")
    check_arrays(0, size, sum(one.file_size for one in members))
    return {one.filename.removesuffix(".npy"): one for one in members}


def _read_array(file: zipfile.ZipFile, member: zipfile.ZipInfo, expected: tuple[int, ...] | None = None) -> np.ndarray:
    """Read an array in numpy's format; ValueError if its shape is not the `expected` one."""
    with file.open(member) as content:
        version = content.read(8)
        width = 2 if version[6:7] == b"\x01" else 4
        length = int.from_bytes(content.read(width), "little")
        if not _MAGIC.fullmatch(version) or length > _MAX_HEADER:
            raise ValueError(f"{member.filename[:80]!r}: expected an array")
        header = _HEADER.fullmatch(content.read(length).decode("latin-1"))
        if not header:
            raise ValueError(f"{member.filename[:80]!r}: expected an array of numbers, or a text")
        dtype, shape = np.dtype(header[1]), tuple(int(n) for n in re.findall(r"\d+", header[3]))
        if expected is not None and shape != expected:
            raise ValueError(f"{member.filename[:80]!r}: expected the shape {expected}, got {short_repr(shape)}")
        size = math.prod(shape) * dtype.itemsize
        if member.file_size != len(version) + width + length + size or (shape and dtype.kind == "U"):
            raise ValueError(
                f"{member.filename[:80]!r}: expected {short_repr(size)} bytes by its shape, got another length"
            )
        array = new_array(shape, dtype, "F" if header[2] == "True" else "C")
        _fill(content, array.reshape(-1, order="A").view(np.uint8).data if size else memoryview(b""))
        if dtype.kind == "U":
            _check_text(member.filename, array)
        return array


def _check_text(name: str, text: np.ndarray) -> None:
    """Raise ValueError for invalid character codes: numpy would make an invalid text of them."""
    codes = text.reshape(1).view("<u4" if text.dtype.str[0] == "<" else ">u4")
    if codes.max(initial=0) > sys.maxunicode:
        raise ValueError(f"{name[:80]!r}: expected a text, got invalid character codes")


def _fill(content: IO[bytes], buffer: memoryview) -> None:
    for at in range(0, len(buffer), _BLOCK):
        part = content.read(min(_BLOCK, len(buffer) - at))
        if len(part) != min(_BLOCK, len(buffer) - at):
            raise ValueError("it is cut off")
        buffer[at : at + _BLOCK] = part
    if content.read(1):  # reading to the end also verifies the checksum
        raise ValueError("expected the end of an array, got more bytes")


def read_csv(path: Path, arrays: bool = True) -> dict[str, Any]:
    """As `read_npz`, for a .csv."""
    with open_regular(path) as file:
        head = file.readline(_MAX_CSV_HEAD)
        begin = CSV_HEAD.encode()
        if not head.startswith(begin):
            raise ValueError("line 1: expected the first line that rosafe process writes")
        about = from_json(head.removeprefix(begin), _MAX_CSV_HEAD)
        if not isinstance(about, dict) or not isinstance(about.get("axes"), dict) or len(about["axes"]) != 1:
            raise ValueError("line 1: expected the description of one output")
        fixed, rows = about.pop("fixed", None), about.pop("rows", None)
        about = checked(about)
        if not arrays:
            return about
        if not isinstance(fixed, dict) or type(rows) is not int:
            raise ValueError("line 1: expected the description of the rows")
        vectors = {name: _vector(name, value) for name, value in fixed.items()}
        time, *columns = file.readline(MAX_TEXT).decode().rstrip("\r\n").split(",")
        table = _table(file, rows, 1 + len(columns))
    (name,) = about["axes"]
    return {name: np.ascontiguousarray(table[:, 1:].T), time: table[:, 0].copy(), **vectors, **about}


def _vector(name: str, value: Any) -> np.ndarray | float:
    values = value if isinstance(value, list) else [value]
    if not all(map(is_number, values)):
        raise ValueError(f"{ascii(name)[:80]}: expected numbers")
    vector = np.array(values, np.float64)
    return vector if isinstance(value, list) else float(vector[0])


def _table(file: BinaryIO, rows: int, width: int) -> np.ndarray:
    """Read the rows of a .csv, each of `width` numbers."""
    size = os.fstat(file.fileno()).st_size
    if not 0 <= 2 * rows * width <= size:  # a digit and a comma for each number
        raise ValueError(f"expected {rows} rows, got a file of {size} bytes: it is cut off")
    check_arrays(0, size, 16 * rows * width)
    table = new_array((rows, width), np.dtype(np.float64))
    for index, row in enumerate(table):
        numbers = file.readline(_MAX_NUMBER_LENGTH * width).split(b",")
        if len(numbers) != width:
            raise ValueError(f"row {index + 1} of {rows}: expected {width} numbers: it is cut off or damaged")
        try:
            row[:] = [float(number) for number in numbers]
        except ValueError:
            raise ValueError(f"row {index + 1}: expected numbers") from None
    if file.read(1):
        raise ValueError(f"expected {rows} rows, got more")
    return table
