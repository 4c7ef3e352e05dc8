"""Program of a child process that reads HDF5 files and Zarr folders: damaged ones can crash or block their libraries.

It is run by file name and imports nothing of rosafe. Its argument is a JSON object with `kind` (h5, mat or zarr),
`descriptor` (of the open HDF5 file) or `path` (of the Zarr folder), `arrays` (which to send: all, texts, none or
asked) and `modules` (folders to import from). It writes to standard output: one byte when the libraries are loaded; the
length of the header (8 bytes); the header, a JSON object with `attributes` and a list `arrays` of `name`, `shape`,
`dtype`, `block` and `attributes`; then the numbers of the arrays, block by block, in row-major order. With `asked`, the
list has all objects, those that cannot be sent as `name` and `problem`, and standard input has one line for each array
to be sent: a JSON list of the name and of the rows, null for all. On an error it writes one line to standard error and
exits with status 1.
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
import re
import resource
import stat
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

MAX_MEMORY = 2**30  # bytes of address space in addition to that of the libraries
MAX_CHUNK = 2**28  # bytes of a chunk
MAX_CHUNKS = 2**20  # chunks of an array
MAX_ARRAYS = 4096  # arrays of a file
MAX_TEXT = 2**20  # bytes of an attribute or of a file of metadata
MAX_TEXTS = 32  # texts of an attribute, one for each axis; all of them can be the same long text of the file
MAX_HEADER = 2**24  # bytes of the header that is sent
MAX_SIZE = 2**28  # bytes of all arrays of a small file
MAX_RATIO = 250  # bytes of all arrays divided by the bytes of a large file; silence in a Zarr has 240
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


# --- HDF5 ---------------------------------------------------------------------------------------------------------


def open_h5(descriptor: int) -> tuple[dict[str, Any], list[Array]]:
    """Return the attributes and the arrays of an HDF5 file; ValueError for references to other files."""
    file = _h5_file(descriptor)
    return _h5_attributes("the file", file), [_h5_array(file, name) for name in _h5_names(file)]


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


def _h5_array(file: Any, name: str, other_attributes: bool = False) -> Array:
    """Return an array of a file; ValueError, also for attributes of other types unless `other_attributes`."""
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
    attributes = _h5_attributes(name, dataset, other_attributes)
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


def _h5_attributes(name: str, of: Any, others: bool = False) -> dict[str, Any]:
    """Return attributes; ValueError for other types than numbers and texts, unless `others` are left out."""
    from h5py import h5s, h5t

    found: dict[str, Any] = {}
    for attribute in _h5_names(of.attrs):
        key = attribute.encode("utf-8", "surrogateescape")
        one = of.attrs.get_id(key)
        kind, space = one.get_type().get_class(), one.get_space().get_simple_extent_type()
        if kind not in (h5t.INTEGER, h5t.FLOAT, h5t.STRING) or space == h5s.NULL:
            if others:
                continue
            raise ValueError(f"{name}: expected attributes that are numbers or texts, got another type")
        texts = one.get_space().get_simple_extent_npoints() if kind == h5t.STRING else 0
        if one.get_storage_size() > MAX_TEXT or texts > MAX_TEXTS:
            raise ValueError(f"{name}: expected attributes of at most {MAX_TEXT // 2**20} MiB, got a larger one")
        value = of.attrs[key]
        value = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
        found[attribute] = value.decode(errors="replace" if others else "strict") if isinstance(value, bytes) else value
    return found


# --- Zarr ---------------------------------------------------------------------------------------------------------

_CODECS = ("blosc", "zlib", "gzip", "zstd", "lz4", "bz2", "lzma")
_FILLS = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf, None: 0}


def open_zarr(path: str) -> tuple[dict[str, Any], list[Array]]:
    """Return the attributes and the arrays of a Zarr group of format 2; ValueError for codecs that are not in the list.

    Only regular files in the folder are opened, and no symbolic links. The zarr library is not used, because it loads
    any codec that a file names.
    """
    root = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    names = [name for name in sorted(os.listdir(root)) if not name.startswith(".")]
    if len(names) > MAX_ARRAYS:
        raise ValueError(f"expected at most {MAX_ARRAYS} objects, got {len(names)}")
    if "zarr.json" in names:
        raise ValueError("expected a Zarr of format 2, got format 3")
    if _metadata(root, ".zgroup").get("zarr_format") != 2:
        raise ValueError("expected a Zarr group of format 2")
    attributes = _metadata(root, ".zattrs")
    consolidated = _metadata(root, ".zmetadata", 16).get("metadata", {}) if _exists(root, ".zmetadata") else {}
    if not isinstance(consolidated, dict):
        raise ValueError(".zmetadata: expected an object of metadata")
    for name, metadata in consolidated.items():
        if name.endswith(".zarray"):
            _checked(_quoted(name), metadata)
    return attributes, [_zarr_array(root, name) for name in names]


def _open_in_folder(folder: int, name: str, flags: int = os.O_NONBLOCK) -> int:
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


def _content(folder: int, name: str, max_size: int) -> bytes:
    """Return the contents of a regular file."""
    with open(_open_in_folder(folder, name), "rb") as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise ValueError(f"{_quoted(name)}: expected a regular file")
        if found.st_size > max_size:
            raise ValueError(f"{_quoted(name)}: expected at most {max_size} bytes, got {found.st_size}")
        return file.read(found.st_size)


def _metadata(folder: int, name: str, max_texts: int = 1) -> dict[str, Any]:
    try:
        found = json.loads(_content(folder, name, max_texts * MAX_TEXT))
    except RecursionError:
        raise ValueError(f"{name}: nested too deeply") from None
    if not isinstance(found, dict):
        raise ValueError(f"{name}: expected an object")
    return found


def _checked(name: str, metadata: Any) -> tuple[tuple[int, ...], tuple[int, ...], np.dtype[Any], Any]:
    """Return shape, chunks, type and codec of an array; ValueError if one is not supported."""
    metadata = metadata if isinstance(metadata, dict) else {}
    if metadata.get("zarr_format") != 2:
        raise ValueError(f"{name}: expected an array of format 2")
    if metadata.get("filters"):
        raise ValueError(f"{name}: expected no filters")
    codec = _codec(name, metadata.get("compressor"))
    if metadata.get("dimension_separator", ".") != "." or metadata.get("order") not in ("C", "F"):
        raise ValueError(f"{name}: expected order C or F, and dimension_separator .")
    dtype = metadata.get("dtype")
    if not isinstance(dtype, str) or not re.fullmatch("[<>|][fiu][1248]", dtype):
        raise ValueError(f"{name}: expected an array of numbers")
    shape, chunks = (_lengths(name, metadata.get(key)) for key in ("shape", "chunks"))
    check_array(name, shape, chunks, np.dtype(dtype))
    return shape, chunks, np.dtype(dtype), codec


def _codec(name: str, compressor: Any) -> str | None:
    codec = compressor.get("id") if isinstance(compressor, dict) else compressor
    if not (codec is None or (isinstance(codec, str) and codec in _CODECS)):
        raise ValueError(f"{name}: expected one of the codecs {', '.join(_CODECS)} or none, got another one")
    return codec


def _lengths(name: str, lengths: Any) -> tuple[int, ...]:
    if not isinstance(lengths, list) or len(lengths) > 32 or not all(type(n) is int for n in lengths):
        raise ValueError(f"{name}: shape and chunks: expected lists of integers")
    return tuple(lengths)


def _zarr_array(root: int, name: str) -> Array:
    from numcodecs import registry

    folder = _open_in_folder(root, name, os.O_DIRECTORY)
    name = _quoted(name) if not name.isidentifier() else name
    if _exists(folder, "zarr.json") or not _exists(folder, ".zarray"):
        raise ValueError(f"{name}: expected an array of format 2")
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
            raise ValueError(f"{name}: expected chunks of {math.prod(chunks) * dtype.itemsize} bytes, got {data.size}")
        return data.view(dtype).reshape(chunks, order=metadata["order"])[whole]

    return Array(name, shape, dtype, chunks, {}, read)


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


def _size_on_disk(file: int | str) -> int:
    """Return the bytes of an open file, or of all files of a Zarr folder."""
    if isinstance(file, int):
        return os.fstat(file).st_size
    folders = [file, *(one.path for one in os.scandir(file) if one.is_dir(follow_symlinks=False))]
    return sum(one.stat(follow_symlinks=False).st_size for folder in folders for one in os.scandir(folder))


def _send(data: memoryview) -> None:
    while data:
        data = data[os.write(1, data) :]


def _more_time() -> None:
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    soft = int(time.process_time()) + _STALL
    resource.setrlimit(resource.RLIMIT_CPU, (soft if hard == resource.RLIM_INFINITY else min(soft, hard), hard))


def _is_text(array: Array) -> bool:
    """Return whether an array is a text or a single number of MATLAB."""
    return array.attributes.get("MATLAB_class") == "char" or math.prod(array.shape) == 1


def _send_header(attributes: dict[str, Any], arrays: list[dict[str, Any]]) -> None:
    head = json.dumps({"attributes": attributes, "arrays": arrays}).encode()
    if len(head) > MAX_HEADER:
        raise ValueError(f"expected attributes of at most {MAX_HEADER // 2**20} MiB together")
    _send(memoryview(len(head).to_bytes(8, "little") + head))


def _described(array: Array) -> dict[str, Any]:
    return {**array._asdict(), "dtype": array.dtype.str, "read": None}


def _send_numbers(array: Array, slices: Any) -> None:
    _more_time()
    data = np.ascontiguousarray(array.read(slices), array.dtype).reshape(-1)
    _send(data.view(np.uint8).data)


def send(file: int | str, which: str) -> None:
    """Check a file, and write its contents to the standard output."""
    size = _size_on_disk(file)
    attributes, arrays = open_h5(file) if isinstance(file, int) else open_zarr(file)
    check_size(sum(math.prod(array.shape) * array.dtype.itemsize for array in arrays), size)
    if which != "all":
        arrays = [one for one in arrays if which == "texts" and _is_text(one)]
    _send_header(attributes, [_described(array) for array in arrays])
    for array in arrays:
        for slices in blocks(array.shape, array.block):
            _send_numbers(array, slices)


def answer(descriptor: int) -> None:
    """Write the parts of an HDF5 file that the standard input asks for."""
    size, file = _size_on_disk(descriptor), _h5_file(descriptor)
    arrays, described = {}, []
    for name in _h5_names(file):
        try:
            arrays[name] = _h5_array(file, name, other_attributes=True)
            described.append({**_described(arrays[name]), "name": name})
        except Exception as problem:  # as in `main`; it matters only if this object is needed
            described.append({"name": name, "problem": _reason(problem)})
    _send_header(_h5_attributes("the file", file, others=True), described)
    for line in sys.stdin:
        name, rows = json.loads(line)
        shape = arrays[name].shape
        check_size(math.prod(shape if rows is None else (len(rows), *shape[1:])) * arrays[name].dtype.itemsize, size)
        _send_numbers(arrays[name], () if rows is None else rows)


def _reason(problem: Exception) -> str:
    return (str(problem).splitlines() or [type(problem).__name__])[0][:300]


def main() -> None:
    """Run the program."""
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
        if request["arrays"] == "asked":
            answer(request["descriptor"])
        else:
            send(request.get("path", request.get("descriptor")), request["arrays"])
    except MemoryError:
        sys.exit(f"expected at most {MAX_MEMORY // 2**20} MiB of memory for reading it")
    except Exception as problem:  # on damaged files the libraries raise any exception
        sys.exit(_reason(problem))


if __name__ == "__main__":
    main()
