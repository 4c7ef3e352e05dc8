"""Program of a child process that reads HDF5 files and Zarr folders: damaged ones can crash or block their libraries.

It is run by file name, imports nothing of rosafe, and is given one argument, a JSON object: `path`, `kind` (h5, mat
or zarr), `arrays` (which to send: all, texts or none) and `modules` (folders to import from). Its standard output is
one byte once the libraries are loaded; the length of a head (8 bytes) and the head, JSON: `attributes`, and for each
array that follows `name`, `shape`, `dtype`, `block` and `attributes`; then the numbers, block by block, in row-major
order.
An error is one line on standard error, and exit status 1.
"""

from __future__ import annotations

import sys

if __name__ == "__main__":  # the folders of the parent, before anything else is imported
    import json

    sys.path += [folder for folder in json.loads(sys.argv[1])["modules"] if folder not in sys.path]

import codecs
import itertools
import json
import math
import os
import resource
import stat
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

MAX_MEMORY = 2**31  # bytes of address space besides what the libraries take
MAX_CHUNK = 2**28  # bytes of a chunk
MAX_CHUNKS = 2**20  # of an array
MAX_ARRAYS = 4096  # of a file
MAX_TEXT = 2**20  # bytes of an attribute or of a file of metadata
MAX_SIZE = 2**30  # bytes of all arrays of a small file
MAX_RATIO = 1000  # of the bytes of all arrays to those of a large file
BLOCK = 2**22  # bytes that are sent at a time, about
_STALL = 20  # seconds of processor time for one block: a process without a parent ends

Slices = tuple[slice, ...]


class Array(NamedTuple):
    """An array to be sent: `read` gives the numbers of a block; all blocks but the last of an axis have one shape."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    block: tuple[int, ...]
    attributes: dict[str, Any]
    read: Callable[[Slices], np.ndarray]


def blocks(shape: tuple[int, ...], block: tuple[int, ...]) -> Iterator[Slices]:
    """Where the blocks of an array are, in row-major order."""
    starts = (range(0, length, step) for length, step in zip(shape, block, strict=True))
    for corner in itertools.product(*starts):
        parts = zip(corner, block, shape, strict=True)
        yield tuple(slice(at, min(at + step, length)) for at, step, length in parts)


def check_array(name: str, shape: tuple[int, ...], chunks: tuple[int, ...] | None, dtype: np.dtype[Any]) -> None:
    """ValueError for an array that is not one of numbers, or is cut into absurd chunks (None: not cut)."""
    if dtype.kind not in "fiu" or dtype.itemsize > 8:
        raise ValueError(f"{name}: expected numbers of at most 64 bits, got {str(dtype)[:40]}")
    if chunks is None:
        return
    if len(chunks) != len(shape) or not all(n >= 0 for n in shape) or not all(n > 0 for n in chunks):
        raise ValueError(f"{name}: its chunks do not fit its shape")
    if math.prod(chunks) * dtype.itemsize > MAX_CHUNK:
        raise ValueError(f"{name}: a chunk takes more than {MAX_CHUNK // 2**20} MiB")
    if math.prod(-(-length // chunk) for length, chunk in zip(shape, chunks, strict=True)) > MAX_CHUNKS:
        raise ValueError(f"{name}: it is cut into more than {MAX_CHUNKS} chunks")


def check_size(taken: float, size: int) -> None:
    """ValueError where arrays of `taken` bytes are more than what a file of `size` bytes may hold."""
    if taken > max(MAX_SIZE, MAX_RATIO * size):
        raise ValueError(f"its arrays would take {taken / 2**20:.0f} MiB of memory, and it has {size} bytes")


# --- HDF5 ---------------------------------------------------------------------------------------------------------


def open_h5(path: str) -> tuple[dict[str, Any], list[Array]]:
    """The attributes and the arrays of an HDF5 file; ValueError for what could lead out of it."""
    import h5py

    file = h5py.File(path, "r", locking=False)
    _allow_no_more_files()
    names = list(file)
    if len(names) > MAX_ARRAYS:
        raise ValueError(f"it holds more than {MAX_ARRAYS} objects")
    for name in names:
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            raise ValueError(f"{_quoted(name)} is a link")
    return _h5_attributes("the file", file), [_h5_array(file, name) for name in names]


def _allow_no_more_files() -> None:
    """External storage, external links and virtual datasets are refused; and could not be opened either."""
    for codec in ("ascii", "utf-8", "latin-1"):  # modules that h5py would open later
        codecs.lookup(codec)
    lowest = os.dup(0)
    limit(resource.RLIMIT_NOFILE, lowest)
    os.close(lowest)


def _h5_array(file: Any, name: str) -> Array:
    import h5py
    from h5py import h5d, h5o, h5s, h5t, h5z

    found = h5o.open(file.id, name.encode("utf-8", "surrogateescape"))
    name = _quoted(name) if not name.isidentifier() else name
    if not isinstance(found, h5d.DatasetID):
        raise ValueError(f"{name} is not an array")
    plan = found.get_create_plist()
    if plan.get_external_count():
        raise ValueError(f"{name}: its numbers are in another file (external storage)")
    if plan.get_layout() not in (h5d.COMPACT, h5d.CONTIGUOUS, h5d.CHUNKED):
        raise ValueError(f"{name}: its numbers are in other datasets (virtual dataset)")
    allowed = (h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32, h5z.FILTER_SZIP, h5z.FILTER_LZF)
    for index in range(plan.get_nfilters()):
        if plan.get_filter(index)[0] not in allowed:
            raise ValueError(f"{name}: filter {plan.get_filter(index)[0]} is not one of those that are read")
    if found.get_type().get_class() not in (h5t.INTEGER, h5t.FLOAT):
        raise ValueError(f"{name} is not an array of numbers")
    if found.get_space().get_simple_extent_type() not in (h5s.SIMPLE, h5s.SCALAR):
        raise ValueError(f"{name} is empty")
    dataset = h5py.Dataset(found)
    attributes = _h5_attributes(name, dataset)
    shape, dtype = dataset.shape, dataset.dtype
    check_array(name, shape, dataset.chunks, dtype)
    chunks = dataset.chunks or (1,) * len(shape)
    return Array(name, shape, dtype, _block(shape, chunks, dtype.itemsize), attributes, dataset.__getitem__)


def _block(shape: tuple[int, ...], chunks: tuple[int, ...], itemsize: int) -> tuple[int, ...]:
    """As many whole chunks as `BLOCK` holds, along the last axis first."""
    block = [min(chunk, max(1, length)) for chunk, length in zip(chunks, shape, strict=True)]
    for axis in reversed(range(len(block))):
        more = max(1, BLOCK // (math.prod(block) * itemsize))
        block[axis] = max(1, min(shape[axis], block[axis] * more))
    return tuple(block)


def _h5_attributes(name: str, of: Any) -> dict[str, Any]:
    from h5py import h5t

    found: dict[str, Any] = {}
    for attribute in of.attrs:
        one = of.attrs.get_id(attribute)
        if one.get_type().get_class() not in (h5t.INTEGER, h5t.FLOAT, h5t.STRING):
            raise ValueError(f"{name}: an attribute is neither a number nor a text")
        if one.get_storage_size() > MAX_TEXT:
            raise ValueError(f"{name}: an attribute takes more than {MAX_TEXT // 2**20} MiB")
        value = of.attrs[attribute]
        value = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
        found[attribute] = value.decode() if isinstance(value, bytes) else value
    return found


# --- Zarr ---------------------------------------------------------------------------------------------------------

_CODECS = ("blosc", "zlib", "gzip", "zstd", "lz4", "bz2", "lzma")
_FILLS = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf, None: 0}


def open_zarr(path: str) -> tuple[dict[str, Any], list[Array]]:
    """The attributes and the arrays of a Zarr group of format 2; ValueError for codecs that are not in the list.

    Of the folder only regular files are opened, and no symbolic links; the library itself, which finds codecs by the
    names that a file gives, is not used.
    """
    root = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    names = [name for name in sorted(os.listdir(root)) if not name.startswith(".")]
    if len(names) > MAX_ARRAYS:
        raise ValueError(f"it holds more than {MAX_ARRAYS} objects")
    if "zarr.json" in names:
        raise ValueError("it is a Zarr of format 3, expected format 2")
    if _metadata(root, ".zgroup").get("zarr_format") != 2:
        raise ValueError("it is not a Zarr group of format 2")
    attributes = _metadata(root, ".zattrs")
    consolidated = _metadata(root, ".zmetadata", 16).get("metadata", {}) if _exists(root, ".zmetadata") else {}
    if not isinstance(consolidated, dict):
        raise ValueError(".zmetadata: expected an object of metadata")
    for name, metadata in consolidated.items():
        if name.endswith(".zarray"):
            _checked(_quoted(name), metadata)
    return attributes, [_zarr_array(root, name) for name in names]


def _open_inside(folder: int, name: str, flags: int = os.O_NONBLOCK) -> int:
    try:
        return os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | flags, dir_fd=folder)
    except OSError as problem:
        raise ValueError(f"{_quoted(name)}: {problem.strerror}") from None


def _exists(folder: int, name: str) -> bool:
    try:
        os.stat(name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        return False
    return True


def _content(folder: int, name: str, most: int) -> bytes:
    """What is in a regular file."""
    with open(_open_inside(folder, name), "rb") as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise ValueError(f"{_quoted(name)} is not a regular file")
        if found.st_size > most:
            raise ValueError(f"{_quoted(name)}: it takes more than {most} bytes")
        return file.read(found.st_size)


def _metadata(folder: int, name: str, most: int = 1) -> dict[str, Any]:
    try:
        found = json.loads(_content(folder, name, most * MAX_TEXT))
    except RecursionError:
        raise ValueError(f"{name}: nested too deeply") from None
    if not isinstance(found, dict):
        raise ValueError(f"{name}: expected an object")
    return found


def _checked(name: str, metadata: Any) -> tuple[tuple[int, ...], tuple[int, ...], np.dtype[Any], Any]:
    """Shape, chunks, type and codec of an array; ValueError for what is not allowed."""
    metadata = metadata if isinstance(metadata, dict) else {}
    if metadata.get("zarr_format") != 2:
        raise ValueError(f"{name} is not an array of format 2")
    if metadata.get("filters"):
        raise ValueError(f"{name}: expected no filters")
    compressor = metadata.get("compressor")
    codec = compressor.get("id") if isinstance(compressor, dict) else compressor
    if not (codec is None or (isinstance(codec, str) and codec in _CODECS)):
        raise ValueError(f"{name}: expected one of the codecs {', '.join(_CODECS)} or none, got another one")
    if metadata.get("dimension_separator", ".") != "." or metadata.get("order") not in ("C", "F"):
        raise ValueError(f"{name}: order or dimension_separator is not one that is read")
    if not isinstance(metadata.get("dtype"), str) or len(metadata["dtype"]) > 3:
        raise ValueError(f"{name} is not an array of numbers")
    try:
        dtype = np.dtype(metadata["dtype"])
    except TypeError:
        raise ValueError(f"{name} is not an array of numbers") from None
    shape, chunks = metadata.get("shape"), metadata.get("chunks")
    for lengths in (shape, chunks):
        if not isinstance(lengths, list) or len(lengths) > 32 or not all(type(n) is int for n in lengths):
            raise ValueError(f"{name}: shape and chunks: expected lists of integers")
    assert isinstance(shape, list) and isinstance(chunks, list)
    check_array(name, tuple(shape), tuple(chunks), dtype)
    return tuple(shape), tuple(chunks), dtype, codec


def _zarr_array(root: int, name: str) -> Array:
    from numcodecs import registry

    folder = _open_inside(root, name, os.O_DIRECTORY)
    name = _quoted(name) if not name.isidentifier() else name
    if _exists(folder, "zarr.json") or not _exists(folder, ".zarray"):
        raise ValueError(f"{name} is not an array of format 2")
    metadata = _metadata(folder, ".zarray")
    shape, chunks, dtype, codec = _checked(name, metadata)
    fill = metadata.get("fill_value")
    if not (fill in _FILLS if isinstance(fill, str) or fill is None else isinstance(fill, (int, float))):
        raise ValueError(f"{name}: fill_value: expected a number")
    empty = np.array(_FILLS.get(fill, fill)).astype(dtype)
    decode = registry.get_codec({"id": codec}).decode if codec else bytes

    def read(slices: Slices) -> np.ndarray:
        key = ".".join(str(part.start // chunk) for part, chunk in zip(slices, chunks, strict=True)) or "0"
        whole = tuple(slice(part.stop - part.start) for part in slices)
        if not _exists(folder, key):
            return np.full([part.stop for part in whole], empty)
        data = np.frombuffer(decode(_content(folder, key, 2 * MAX_CHUNK)), np.uint8)
        if data.size != math.prod(chunks) * dtype.itemsize:
            raise ValueError(f"{name}: a chunk takes {data.size} bytes")
        return data.view(dtype).reshape(chunks, order=metadata["order"])[whole]

    return Array(name, shape, dtype, chunks, {}, read)


# --- the process --------------------------------------------------------------------------------------------------


def limit(what: int, most: int) -> None:
    """Set a limit of this process for good."""
    hard = resource.getrlimit(what)[1]
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(what, (most, most))


def _address_space() -> int:
    """Bytes that this process has mapped; how much the libraries map depends on their versions and on the machine."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[0]) * resource.getpagesize()
    except OSError:  # a chroot without /proc
        return 0


def _quoted(name: str) -> str:
    text = ascii(name)
    return text if len(text) <= 80 else text[:77] + "..."


def _size_on_disk(path: str) -> int:
    if not os.path.isdir(path):
        return os.stat(path).st_size
    folders = [path, *(one.path for one in os.scandir(path) if one.is_dir(follow_symlinks=False))]
    return sum(one.stat(follow_symlinks=False).st_size for folder in folders for one in os.scandir(folder))


def _send(data: memoryview) -> None:
    while data:
        data = data[os.write(1, data) :]


def _more_time() -> None:
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    soft = int(time.process_time()) + _STALL
    resource.setrlimit(resource.RLIMIT_CPU, (soft if hard == resource.RLIM_INFINITY else min(soft, hard), hard))


def _is_text(array: Array) -> bool:
    """Whether this is a text or a single number of MATLAB's."""
    return array.attributes.get("MATLAB_class") == "char" or math.prod(array.shape) == 1


def send(path: str, kind: str, which: str) -> None:
    """Check a file, and write it to the standard output."""
    size = _size_on_disk(path)
    attributes, arrays = open_zarr(path) if kind == "zarr" else open_h5(path)
    check_size(sum(math.prod(array.shape) * array.dtype.itemsize for array in arrays), size)
    if which != "all":
        arrays = [one for one in arrays if which == "texts" and _is_text(one)]
    described = [
        {"name": a.name, "shape": a.shape, "dtype": a.dtype.str, "block": a.block, "attributes": a.attributes}
        for a in arrays
    ]
    head = json.dumps({"attributes": attributes, "arrays": described}).encode()
    _send(memoryview(len(head).to_bytes(8, "little") + head))
    for array in arrays:
        for slices in blocks(array.shape, array.block):
            _more_time()
            data = np.ascontiguousarray(array.read(slices), array.dtype).reshape(-1)
            _send(data.view(np.uint8).data)


def main() -> None:
    """Do what the argument says."""
    request = json.loads(sys.argv[1])
    limit(resource.RLIMIT_CORE, 0)
    limit(resource.RLIMIT_FSIZE, 0)
    if request["kind"] == "zarr":
        import numcodecs  # noqa: F401
    else:
        import h5py  # noqa: F401
    limit(resource.RLIMIT_AS, _address_space() + MAX_MEMORY)
    _send(memoryview(b"+"))
    try:
        _more_time()
        send(request["path"], request["kind"], request["arrays"])
    except MemoryError:
        sys.exit(f"reading it takes more than {MAX_MEMORY // 2**20} MiB of memory")
    except Exception as problem:  # of damaged files the libraries raise anything
        sys.exit((str(problem).splitlines() or [type(problem).__name__])[0][:300])


if __name__ == "__main__":
    main()
