"""`load`: read .npz and .h5. Sizes and types are checked before memory is allocated."""

from __future__ import annotations

import functools
import importlib.util
import math
import os
import re
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from rosafe.declarations.checks import is_number
from rosafe.declarations.text import short_repr
from rosafe.interface import KINDS, Representation
from rosafe.results.hdf5_reading import check_arrays, open_hdf5
from rosafe.results.result import Result
from rosafe.results.result_metadata import ABOUT, is_texts, new_array, parse_metadata, sample_times
from rosafe.system.input import open_regular
from rosafe.system.missing import require

_MAX_MEMBERS = 4096  # members of an .npz
_MAX_HEADER = 4096  # bytes of the header of an array
_MAX_EMPTY = 2**20  # along each axis of an array without numbers
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
# The reader of files that are no results, by suffix
_OTHERS = {
    ".mat": "scipy.io.loadmat, or h5py if it is of version 7.3,",
    ".csv": "pandas.read_csv or numpy.loadtxt",
    ".zarr": "xarray.open_zarr",
    ".nc": "xarray.open_dataset",
    ".wav": "soundfile.read",
}


def load(path: str | os.PathLike[str]) -> Result:
    """Read a .npz or .h5 that `rosafe process` or `Result.save` has written.

    Parameters
    ----------
    path : path
        It ends in .npz or .h5.

    Returns
    -------
    Result
        The result of `rosafe.process` for the same samples, with the same bits, keys and attributes. If
        `rosafe process` has written it, it also has the keys `block_frames`, `source` (name of the input), `channels`
        and `topic` if they were given, `pad` and `clip`.

    Raises
    ------
    ValueError
        It is not a result file, or it is damaged, or it has another format: the text names the reader to use.
    OSError
        It does not exist, or cannot be read.
    ModuleNotFoundError
        h5py is not installed.
    """
    result = read(path)
    try:
        _check_arrays(result)
    except ValueError as problem:
        raise _damaged(path, problem) from None
    for kind in KINDS.values():  # times of samples are not stored
        stored = [name for name in kind.outputs if name in result["axes"]]
        if stored and f"{kind.kind}_time" not in result:
            result[f"{kind.kind}_time"] = sample_times(result[stored[0]].shape[-1], result["sample_rate"])
    if result.pop("dtype", "") == "float32":
        result |= {name: result[name].astype(np.float32) for name in result["axes"]}
    return Result(
        result,
        parameters=result["parameters"],
        sample_rate=result["sample_rate"],
        version=result.get("rosafe_version", ""),
        clipped=result.get("clipped", 0),
    )


def read(path: str | os.PathLike[str], arrays: bool = True) -> dict[str, Any]:
    """Return the contents of a file; without `arrays`, only the metadata. Raises the errors of `load`."""
    extension = Path(path).suffix.lower()
    if extension not in READERS:
        other = (
            f"{_OTHERS[extension]} reads it" if extension in _OTHERS else "rosafe process and Result.save write them"
        )
        raise ValueError(f"{path}: expected a name that ends in {' or '.join(READERS)}, got {extension!r}; {other}")
    if not os.path.exists(path):
        raise FileNotFoundError(2, os.strerror(2), str(path))
    if extension == ".h5" and not importlib.util.find_spec("h5py"):  # the child process imports it
        require("h5py", ".h5 files")
    try:
        result = READERS[extension](Path(path), arrays)
    except (ValueError, OverflowError, RecursionError, MemoryError) as problem:  # json.JSONDecodeError, too
        raise _damaged(path, problem) from None
    for name in ("axes", "parameters", "sample_rate"):
        if name not in result:
            raise _damaged(path, f"it lacks {name}")
    return result


# --- .h5 ----------------------------------------------------------------------------------------------------------


def _read_h5(path: Path, arrays: bool) -> dict[str, Any]:
    with open_hdf5(path) as content:
        about = parse_metadata(content.attrs)
        found = {name: content[name] for name in content}
        check_arrays(os.path.getsize(path), sum(math.prod(one.shape, start=8.0) for one in found.values()))
        if not arrays:
            return about
        return {**{name: one[()] if one.shape else float(one[()]) for name, one in found.items()}, **about}


# --- .npz ---------------------------------------------------------------------------------------------------------


def _read_npz(path: Path, arrays: bool) -> dict[str, Any]:
    with open_npz(path) as (members, read_array):
        found = {name: read_array(one) for name, one in members.items() if arrays or name in ABOUT}
    return {**found, **parse_metadata({name: value for name, value in found.items() if value.ndim == 0})}


READERS: dict[str, Callable[[Path, bool], dict[str, Any]]] = {".npz": _read_npz, ".h5": _read_h5}


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
    check_arrays(size, sum(one.file_size for one in members))
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


# --- checks -------------------------------------------------------------------------------------------------------


def _check_arrays(result: Mapping[str, Any]) -> None:
    """Raise ValueError if outputs or coordinates are missing or have another type."""
    missing = result["axes"].keys() - result.keys()
    if missing:
        raise ValueError(f"it lacks {', '.join(map(short_repr, sorted(missing)))}")
    for name, axes in result["axes"].items():
        _check_array(name, result[name], len(axes))
    for kind in KINDS.values():
        _check_outputs(kind, result)
        _check_coordinates(kind, result)


def _check_outputs(kind: Representation, result: Mapping[str, Any]) -> None:
    """Raise ValueError if axes or times of the outputs of a kind do not match its declaration."""
    outputs = [name for name in kind.outputs if name in result]
    for name in outputs:
        if result["axes"].get(name) != kind.outputs[name].axes:
            raise ValueError(f"axes: {name}: expected {', '.join(kind.outputs[name].axes)}")
        if kind.outputs[name].axes[0] == "ear" and not 1 <= len(result[name]) <= 2:
            raise ValueError(f"{name}: expected one or two ears, got {len(result[name])}")
    time = f"{kind.kind}_time"
    if outputs and time in result:
        _check_array(time, result[time], 1)
        if any(result[name].shape[-1] != len(result[time]) for name in outputs):
            raise ValueError(f"{time}: expected the length of {outputs[0]}, got {len(result[time])}")


def _check_coordinates(kind: Representation, result: Mapping[str, Any]) -> None:
    """Raise ValueError if the frame rate or a coordinate of a kind does not match its declaration."""
    rate = result.get(f"{kind.kind}_frameRate", 1.0)
    if not is_number(rate) or not 0 < rate < math.inf:
        raise ValueError(f"{kind.kind}_frameRate: expected a positive number, got {short_repr(rate)}")
    for name in kind.coordinates:
        if kind.units[name]:
            _check_array(name, result.get(name, np.empty(0)), 1)
        elif not is_texts(result.get(name, ())):
            raise ValueError(f"{name}: expected texts")


def _check_array(name: str, value: Any, dimensions: int) -> None:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu" or value.dtype.itemsize < 4:
        raise ValueError(f"{short_repr(name)}: expected an array of numbers of 32 or 64 bits")
    if value.ndim != dimensions or (not value.size and max(value.shape) > _MAX_EMPTY):
        raise ValueError(f"{short_repr(name)}: expected {dimensions} axes, got the shape {value.shape}")


def _damaged(path: str | os.PathLike[str], reason: object) -> ValueError:
    return ValueError(
        f"{path}: expected a result of rosafe process, got another or damaged file: {reason}; compute the result again"
    )
