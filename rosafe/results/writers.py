"""Writers of result files: .npz, .csv and version 5 .mat from whole arrays; .h5 and version 7.3 .mat in blocks."""

from __future__ import annotations

import io
import json
import math
import os
import tempfile
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from rosafe.results.result_metadata import Contents, sample_times

MAX_OVERHEAD = 2**10  # bytes in a file for each entry, and once for the file, in addition to numbers and letters
IN_MEMORY = 2**28  # bytes of all arrays together; larger ones are kept on the disk
CHUNK = 2**19  # bytes, approximately, of a chunk of HDF5; two of them fit into the library's cache for an array
_MAT_HEAD = 116  # bytes of the text at the beginning of a .mat


class ResultWriter(ABC):
    """Writes the arrays block by block. Different arrays may be appended concurrently by different threads.

    Parameters
    ----------
    path : Path
        An empty file.
    contents : Contents
    """

    def __init__(self, path: Path, contents: Contents) -> None:
        self._path = path
        self._contents = contents
        self._ends = dict.fromkeys(contents.shapes, 0)  # of the frames that have been appended
        self._open = ExitStack()
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    @classmethod
    def size(cls, contents: Contents) -> int:
        """Return the maximum number of bytes on the disk while it is written."""
        return contents.size

    def append(self, name: str, block: np.ndarray) -> None:
        """Append a block to an array, along the last axis."""
        first = self._ends[name]
        self._ends[name] = first + block.shape[-1]
        if block.size:
            self._write(name, first, block)

    @abstractmethod
    def _begin(self) -> None:
        """Prepare for the first block."""

    @abstractmethod
    def _write(self, name: str, first: int, block: np.ndarray) -> None:
        """Write frames of an array from frame `first` on."""

    @abstractmethod
    def finish(self) -> None:
        """Complete the file."""

    def close(self) -> None:
        """Close the file, complete or not, and release all resources."""
        self._open.close()

    def _mat_head(self, version: str) -> bytes:
        about = self._contents.about
        options = f", options {about['options']}" if "options" in about else ""
        return f"MATLAB {version} MAT-file, written by rosafe{options}".ljust(_MAT_HEAD).encode()


class _InMemoryWriter(ResultWriter):
    """Collects the arrays, and writes them all at the end. Subclasses implement `_write_all`."""

    def _begin(self) -> None:
        self._arrays = {name: self._array(shape) for name, shape in self._contents.shapes.items()}

    @classmethod
    def size(cls, contents: Contents) -> int:
        """Return the maximum number of bytes on the disk while it is written."""
        return contents.size if contents.size <= IN_MEMORY else 2 * contents.size

    def _array(self, shape: tuple[int, ...]) -> np.ndarray:
        count = math.prod(shape)
        if self._contents.size <= IN_MEMORY or not count:
            return np.empty(shape)
        file = self._open.enter_context(tempfile.TemporaryFile(dir=self._path.parent))  # noqa: SIM115
        os.posix_fallocate(file.fileno(), 0, 8 * count)  # fails on a full disk; a write to the map would be fatal
        return np.memmap(file, np.float64, "r+", 0, shape, "F")

    def _write(self, name: str, first: int, block: np.ndarray) -> None:
        self._arrays[name][..., first : self._ends[name]] = block

    def finish(self) -> None:
        """Write the file."""
        everything = {**self._arrays, **self._contents.fixed, **self._contents.flat()}
        with open(self._path, "r+b") as file:
            # On a full disk this fails. numpy and scipy would leave files open that they cannot complete.
            sizes = [np.asarray(value).nbytes for value in everything.values()]
            os.posix_fallocate(file.fileno(), 0, sum(sizes) + MAX_OVERHEAD * (len(sizes) + 1))
            self._write_all(file, everything)
            file.truncate()

    @abstractmethod
    def _write_all(self, file: BinaryIO, everything: dict[str, Any]) -> None:
        """Write the contents to the open file."""

    def close(self) -> None:
        """Release the arrays."""
        self._arrays = {}
        super().close()


class NpzWriter(_InMemoryWriter):
    """Writes .npz for numpy.load."""

    def _write_all(self, file: BinaryIO, everything: dict[str, Any]) -> None:
        # Not numpy.savez: the garbage collector would report the archive that it leaves open on failure.
        with zipfile.ZipFile(file, "w") as archive:
            for name, value in everything.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    np.lib.format.write_array(entry, np.asanyarray(value), allow_pickle=False)


class Mat5Writer(_InMemoryWriter):
    """Writes MATLAB's version 5, which Octave reads too."""

    def _write_all(self, file: BinaryIO, everything: dict[str, Any]) -> None:
        from scipy.io import savemat

        savemat(file, everything, long_field_names=True, oned_as="column")
        end = file.tell()
        file.seek(0)
        file.write(self._mat_head("5.0"))
        file.seek(end)


class CsvWriter(_InMemoryWriter):
    """Writes one output of two axes: a row per frame, with the time first. The other entries are JSON in line 1."""

    def _write_all(self, file: BinaryIO, everything: dict[str, Any]) -> None:
        contents = self._contents
        (name,) = contents.shapes
        time = f"{name}_time"
        fixed = {k: v if isinstance(v, float) else v.tolist() for k, v in contents.fixed.items() if k != time}
        rows = self._arrays[name].T
        head = {**contents.about, "axes": contents.axes, "units": contents.units, "fixed": fixed}
        lines = [f"# rosafe {json.dumps(head)}", ",".join([time, *self._columns(name, rows.shape[1])])]
        file.writelines(f"{line}\n".encode() for line in lines)
        times = contents.fixed.get(time, sample_times(len(rows), contents.about["sample_rate"]))
        for moment, row in zip(np.asarray(times).tolist(), rows, strict=True):
            file.write((",".join(map(repr, [moment, *row.tolist()])) + "\n").encode())

    def _columns(self, name: str, count: int) -> list[str]:
        if self._contents.axes[name][0] == "ear":
            return ["left", "right"][:count]
        frequencies = self._contents.fixed["fb_cfHz"]
        assert isinstance(frequencies, np.ndarray)
        return [f"{frequency:.6g} Hz" for frequency in frequencies]


# --- HDF5: with the library alone, a full disk would end the process instead of raising OSError ----------------------


class _File(io.RawIOBase):
    """A file object for h5py, on an empty file on the disk.

    If a write fails inside the library, as on a full disk, closing the HDF5 file later ends the process. After the
    first failure all data are therefore kept in memory and read from there. These are a few MB of the library's caches,
    because callers stop at the first error.

    Attributes
    ----------
    problem : OSError or None
        The first failure.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        self._at = self._end = 0
        self._kept: list[tuple[int, bytes]] = []
        self.problem: OSError | None = None

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = offset + (self._end if whence == os.SEEK_END else 0)  # the library does not use SEEK_CUR
        return self._at

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        try:
            count = os.preadv(self._descriptor, [view], self._at)
        except OSError as problem:
            self.problem, count = self.problem or problem, 0
        view[count:] = bytes(len(view) - count)
        for at, data in self._kept:
            first, last = max(at, self._at), min(at + len(data), self._at + len(view))
            if first < last:
                view[first - self._at : last - self._at] = data[first - at : last - at]
        return len(view)

    def write(self, data: Any) -> int:
        view, at = memoryview(data).cast("B"), self._at
        self._end = max(self._end, at + len(view))
        try:
            while view and not self.problem:
                count = os.pwrite(self._descriptor, view, at)
                view, at = view[count:], at + count
        except OSError as problem:
            self.problem = problem
        if view:
            self._kept.append((at, bytes(view)))
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        assert size is not None
        self._end = size
        try:
            os.ftruncate(self._descriptor, size)
        except OSError as problem:
            self.problem = self.problem or problem
        return size

    def close(self) -> None:
        if not self.closed:
            os.close(self._descriptor)
        super().close()


class _Hdf5:
    """An HDF5 file that is being written.

    All calls of the library run on a separate thread. KeyboardInterrupt cannot occur there, because Python runs signal
    handlers in the main thread only.

    Parameters
    ----------
    path : Path
        An empty file.
    **options
        For `h5py.File`.

    Raises
    ------
    OSError
        The file cannot be written.
    """

    def __init__(self, path: Path, **options: Any) -> None:
        import h5py

        self._file = _File(path)
        self._thread = ThreadPoolExecutor(1)
        self._group: Any = None

        def begin(_: None) -> None:
            self._group = h5py.File(self._file, "w", **options)

        try:
            self.call(begin)
        except BaseException:
            self.close()
            raise

    def call(self, work: Callable[..., object], *arguments: Any) -> None:
        """Run ``work(group, *arguments)``; OSError if this or an earlier write has failed."""
        self.check()
        self._thread.submit(lambda: work(self._group, *arguments)).result()
        self.check()

    def check(self) -> None:
        """Raise the OSError of the first write that has failed, if any."""
        if self._file.problem is not None:
            raise self._file.problem

    def close(self) -> None:
        """Close the file. Failures are reported only by `check`."""
        if not self._file.closed:
            self._thread.submit(self._close).result()
            self._thread.shutdown()

    def _close(self) -> None:
        if self._group is not None:
            self._group.close()
        self._file.close()


class _Hdf5Writer(ResultWriter):
    """Writes with the HDF5 library. Subclasses implement `_create`, `_write_in` and `_describe`."""

    USERBLOCK = 0  # bytes before the HDF5 data

    def _begin(self) -> None:
        self._file = self._open.enter_context(closing(_Hdf5(self._path, userblock_size=self.USERBLOCK)))
        self._file.call(self._create)

    def _write(self, name: str, first: int, block: np.ndarray) -> None:
        self._file.call(self._write_in, name, first, block)

    def finish(self) -> None:
        """Write everything except the arrays, and close the file."""
        self._file.call(self._describe)
        self._file.close()
        self._file.check()

    @staticmethod
    def _chunk_frames(shape: tuple[int, ...]) -> int:
        return min(shape[-1], max(1, CHUNK // (8 * math.prod(shape[:-1]))))

    @abstractmethod
    def _create(self, file: Any) -> None:
        """Create the arrays."""

    @abstractmethod
    def _write_in(self, file: Any, name: str, first: int, block: np.ndarray) -> None:
        """As `_write`, in the open file."""

    @abstractmethod
    def _describe(self, file: Any) -> None:
        """Write everything except the arrays."""


class H5Writer(_Hdf5Writer):
    """HDF5: a dataset for each array, with its axes as labels and its unit. The other entries are file attributes."""

    def _create(self, file: Any) -> None:
        for name, shape in self._contents.shapes.items():
            chunks = (*shape[:-1], self._chunk_frames(shape)) if math.prod(shape) else None
            dataset = file.create_dataset(name, shape, np.float64, chunks=chunks)
            dataset.attrs["unit"] = self._contents.units[name]
            for dimension, axis in zip(dataset.dims, self._contents.axes[name], strict=True):
                dimension.label = axis

    def _write_in(self, file: Any, name: str, first: int, block: np.ndarray) -> None:
        file[name][..., first : first + block.shape[-1]] = block

    def _describe(self, file: Any) -> None:
        for name, value in self._contents.fixed.items():
            file[name] = value
        for name, text in self._contents.flat().items():
            file.attrs[name] = text


class Mat73Writer(_Hdf5Writer):
    """MATLAB's version 7.3: HDF5 after 512 bytes, axes in reverse order, types as attributes."""

    USERBLOCK = 512

    def _create(self, file: Any) -> None:
        for name, shape in self._contents.shapes.items():
            if math.prod(shape):
                chunks = (self._chunk_frames(shape), *shape[-2::-1])
                dataset = file.create_dataset(name, shape[::-1], np.float64, chunks=chunks)
                dataset.attrs["MATLAB_class"] = np.bytes_("double")
            else:
                self._add(file, name, np.array(shape, np.uint64), "double", MATLAB_empty=np.uint8(1))

    def _write_in(self, file: Any, name: str, first: int, block: np.ndarray) -> None:
        file[name][first : first + block.shape[-1]] = block.T

    def _describe(self, file: Any) -> None:
        for name, value in {**self._contents.flat(), **self._contents.fixed}.items():
            if isinstance(value, str):
                codes = np.frombuffer(value.encode("utf-16-le"), np.uint16).reshape(-1, 1)
                self._add(file, name, codes, "char", MATLAB_int_decode=np.int32(2))
            else:
                self._add(file, name, np.atleast_1d(np.asarray(value, np.float64))[np.newaxis], "double")

    @staticmethod
    def _add(file: Any, name: str, data: np.ndarray, kind: str, **attributes: np.generic) -> None:
        dataset = file.create_dataset(name, data=data)
        for attribute, value in {"MATLAB_class": np.bytes_(kind), **attributes}.items():
            dataset.attrs[attribute] = value

    def finish(self) -> None:
        """Write everything except the arrays, and the head of the file."""
        super().finish()
        with open(self._path, "r+b") as file:  # a text, no data of subsystems, version 2.0, byte order
            file.write(self._mat_head("7.3") + bytes(8) + b"\x00\x02IM")
