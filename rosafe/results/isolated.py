"""Program of a child process that reads an HDF5 file: a damaged one can crash or block the library.

It is run by file name and imports nothing of rosafe. Its argument is a JSON object with `descriptor` (of the open file)
and `modules` (folders to import from). It writes to standard output: one byte when the libraries are loaded; the
length of the header (8 bytes); the header, a JSON object with `attributes` and a list `arrays` of `name`, `shape`,
`dtype`, `block` and `attributes`, or of `name` and `problem` for objects that cannot be sent. Standard input has one
line for each array to be sent: a JSON list of the name and of the rows. If the rows are null, the whole array is sent,
block by block, in row-major order. On an error the program writes one line to standard error and exits with status 1.
"""

from __future__ import annotations

import sys

if __name__ == "__main__":  # the folders of the parent, before anything else is imported
    import json

    sys.path += [folder for folder in json.loads(sys.argv[1])["modules"] if folder not in sys.path]

import codecs
import io
import itertools
import json
import math
import os
import resource
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

MAX_MEMORY = 2**30  # bytes of address space in addition to that of the libraries
MAX_CHUNK = 2**28  # bytes of a chunk
MAX_CHUNKS = 2**20  # chunks of an array
MAX_ARRAYS = 4096  # arrays of a file
MAX_TEXT = 2**20  # bytes of an attribute
MAX_TEXTS = 32  # texts of an attribute, one for each axis; all of them can be the same long text of the file
MAX_HEADER = 2**24  # bytes of the header that is sent
MAX_SIZE = 2**28  # bytes of all arrays of a small file
MAX_RATIO = 250  # bytes of all arrays divided by the bytes of a large file
BLOCK = 2**22  # bytes, approximately, that are sent at a time
_STALL = 20  # seconds of processor time for one block; it ends a process whose parent has died

Slices = tuple[slice, ...]


class Array(NamedTuple):
    """An array to be sent. `read` returns the numbers of a block; only the last block along an axis may be smaller."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    block: tuple[int, ...]
    attributes: dict[str, Any]
    read: Callable[[Slices], np.ndarray]


def blocks(shape: tuple[int, ...], block: tuple[int, ...]) -> Iterator[Slices]:
    """Yield the slices of each block of an array, in row-major order."""
    starts = (range(0, length, step) for length, step in zip(shape, block, strict=True))
    for corner in itertools.product(*starts):
        parts = zip(corner, block, shape, strict=True)
        yield tuple(slice(at, min(at + step, length)) for at, step, length in parts)


def check_array(name: str, shape: tuple[int, ...], chunks: tuple[int, ...] | None, dtype: np.dtype[Any]) -> None:
    """Raise ValueError unless an array is one of numbers with reasonable chunks (None: not chunked)."""
    if dtype.kind not in "fiu" or dtype.itemsize > 8:
        raise ValueError(f"{name}: expected real numbers of at most 64 bits, got {str(dtype)[:40]}")
    if chunks is None:
        return
    if len(chunks) != len(shape) or not all(n >= 0 for n in shape) or not all(n > 0 for n in chunks):
        raise ValueError(f"{name}: expected chunks that match its shape")
    if math.prod(chunks) * dtype.itemsize > MAX_CHUNK:
        raise ValueError(f"{name}: expected chunks of at most {MAX_CHUNK // 2**20} MiB, got larger ones")
    if math.prod(-(-length // chunk) for length, chunk in zip(shape, chunks, strict=True)) > MAX_CHUNKS:
        raise ValueError(f"{name}: expected at most {MAX_CHUNKS} chunks, got more")


def check_size(taken: float, size: int) -> None:
    """Raise ValueError if arrays of `taken` bytes are too large for a file of `size` bytes."""
    if taken > max(MAX_SIZE, MAX_RATIO * size):
        raise ValueError(f"its arrays: expected less than {taken / 2**20:.0f} MiB in a file of {size} bytes")


def _h5_file(descriptor: int) -> Any:
    import h5py

    file = h5py.File(io.FileIO(descriptor, closefd=False), "r")
    _allow_no_more_files()
    if len(file) > MAX_ARRAYS:
        raise ValueError(f"expected at most {MAX_ARRAYS} objects, got {len(file)}")
    return file


def _h5_names(of: Any) -> list[str]:
    """Return names of objects or attributes; h5py returns bytes for those that are not UTF-8."""
    return [name.decode("utf-8", "surrogateescape") if isinstance(name, bytes) else name for name in of]


def _allow_no_more_files() -> None:
    """Set the limit of open files to those that are open: a reference to another file that is overlooked then fails."""
    for codec in ("ascii", "utf-8", "latin-1"):  # modules that h5py would open later
        codecs.lookup(codec)
    lowest = os.dup(0)
    limit(resource.RLIMIT_NOFILE, lowest)
    os.close(lowest)


def _h5_array(file: Any, name: str) -> Array:
    """Return an array of a file; ValueError for other objects, and for references to other files."""
    import h5py
    from h5py import h5d, h5o, h5s, h5t, h5z

    shown = name if name.replace(".", "_").isidentifier() else _quoted(name)
    key = name.encode("utf-8", "surrogateescape")
    if not isinstance(file.get(key, getlink=True), h5py.HardLink):
        raise ValueError(f"{shown}: expected an array, got a link")
    found = h5o.open(file.id, key)
    name = shown
    if not isinstance(found, h5d.DatasetID):
        raise ValueError(f"{name}: expected an array")
    plan = found.get_create_plist()
    if plan.get_external_count():
        raise ValueError(f"{name}: expected numbers in this file, got external storage")
    if plan.get_layout() not in (h5d.COMPACT, h5d.CONTIGUOUS, h5d.CHUNKED):
        raise ValueError(f"{name}: expected numbers of its own, got a virtual dataset")
    allowed = (h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32, h5z.FILTER_SZIP, h5z.FILTER_LZF)
    for index in range(plan.get_nfilters()):
        if plan.get_filter(index)[0] not in allowed:
            raise ValueError(f"{name}: expected a supported filter, got filter {plan.get_filter(index)[0]}")
    if found.get_type().get_class() not in (h5t.INTEGER, h5t.FLOAT):
        raise ValueError(f"{name}: expected an array of real numbers")
    if found.get_space().get_simple_extent_type() not in (h5s.SIMPLE, h5s.SCALAR):
        raise ValueError(f"{name}: expected an array, got an empty dataset")
    dataset = h5py.Dataset(found)
    attributes = _h5_attributes(name, dataset)
    shape, dtype = dataset.shape, dataset.dtype
    check_array(name, shape, dataset.chunks, dtype)
    chunks = dataset.chunks or (1,) * len(shape)
    return Array(name, shape, dtype, _block(shape, chunks, dtype.itemsize), attributes, dataset.__getitem__)


def _block(shape: tuple[int, ...], chunks: tuple[int, ...], itemsize: int) -> tuple[int, ...]:
    """Return the shape of a block: as many whole chunks as fit into `BLOCK`, along the last axis first."""
    block = [min(chunk, max(1, length)) for chunk, length in zip(chunks, shape, strict=True)]
    for axis in reversed(range(len(block))):
        more = max(1, BLOCK // (math.prod(block) * itemsize))
        block[axis] = max(1, min(shape[axis], block[axis] * more))
    return tuple(block)


def _h5_attributes(name: str, of: Any) -> dict[str, Any]:
    """Return the attributes that are numbers or texts; ValueError if one is too large."""
    from h5py import h5s, h5t

    found: dict[str, Any] = {}
    for attribute in _h5_names(of.attrs):
        key = attribute.encode("utf-8", "surrogateescape")
        one = of.attrs.get_id(key)
        kind, space = one.get_type().get_class(), one.get_space().get_simple_extent_type()
        if kind not in (h5t.INTEGER, h5t.FLOAT, h5t.STRING) or space == h5s.NULL:
            continue
        texts = one.get_space().get_simple_extent_npoints() if kind == h5t.STRING else 0
        if one.get_storage_size() > MAX_TEXT or texts > MAX_TEXTS:
            raise ValueError(f"{name}: expected attributes of at most {MAX_TEXT // 2**20} MiB, got a larger one")
        value = of.attrs[key]
        value = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
        found[attribute] = value.decode(errors="replace") if isinstance(value, bytes) else value
    return found


# --- the process --------------------------------------------------------------------------------------------------


def limit(resource_number: int, maximum: int) -> None:
    """Set a resource limit of this process permanently."""
    hard = resource.getrlimit(resource_number)[1]
    maximum = maximum if hard == resource.RLIM_INFINITY else min(maximum, hard)
    resource.setrlimit(resource_number, (maximum, maximum))


def _address_space() -> int:
    """Return the bytes that this process has mapped, which depend on the versions of the libraries and the machine."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[0]) * resource.getpagesize()
    except OSError:  # a chroot without /proc
        return 0


def _quoted(name: str) -> str:
    text = ascii(name)
    return text if len(text) <= 80 else text[:77] + "..."


def _send(data: memoryview) -> None:
    while data:
        data = data[os.write(1, data) :]


def _more_time() -> None:
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    soft = int(time.process_time()) + _STALL
    resource.setrlimit(resource.RLIMIT_CPU, (soft if hard == resource.RLIM_INFINITY else min(soft, hard), hard))


def _send_header(attributes: dict[str, Any], arrays: list[dict[str, Any]]) -> None:
    head = json.dumps({"attributes": attributes, "arrays": arrays}).encode()
    if len(head) > MAX_HEADER:
        raise ValueError(f"expected attributes of at most {MAX_HEADER // 2**20} MiB together")
    _send(memoryview(len(head).to_bytes(8, "little") + head))


def answer(descriptor: int) -> None:
    """Write the description of an HDF5 file, and the arrays that the standard input asks for."""
    size, file = os.fstat(descriptor).st_size, _h5_file(descriptor)
    arrays, described = {}, []
    for name in _h5_names(file):
        try:
            array = arrays[name] = _h5_array(file, name)
            described.append({**array._asdict(), "name": name, "dtype": array.dtype.str, "read": None})
        except Exception as problem:  # as in `main`; it matters only if this object is needed
            described.append({"name": name, "problem": _reason(problem)})
    _send_header(_h5_attributes("the file", file), described)
    for line in sys.stdin:
        name, rows = json.loads(line)
        array = arrays[name]
        shape = array.shape if rows is None else (len(rows), *array.shape[1:])
        check_size(math.prod(shape) * array.dtype.itemsize, size)
        for part in blocks(shape, array.block) if rows is None else [rows]:
            _more_time()
            data = np.ascontiguousarray(array.read(part), array.dtype).reshape(-1)
            _send(data.view(np.uint8).data)


def _reason(problem: Exception) -> str:
    return (str(problem).splitlines() or [type(problem).__name__])[0][:300]


def main() -> None:
    """Run the program."""
    limit(resource.RLIMIT_CORE, 0)
    limit(resource.RLIMIT_FSIZE, 0)
    import h5py  # noqa: F401

    limit(resource.RLIMIT_AS, _address_space() + MAX_MEMORY)
    _send(memoryview(b"+"))
    try:
        _more_time()
        answer(json.loads(sys.argv[1])["descriptor"])
    except MemoryError:
        sys.exit(f"expected at most {MAX_MEMORY // 2**20} MiB of memory for reading it")
    except Exception as problem:  # on damaged files the libraries raise any exception
        sys.exit(_reason(problem))


if __name__ == "__main__":
    main()
