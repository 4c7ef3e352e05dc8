"""Formats that are written block by block: HDF5, MATLAB's version 7.3 .mat (a kind of HDF5), and Zarr."""

from __future__ import annotations

import math
from abc import abstractmethod
from contextlib import closing
from typing import Any

import numpy as np

from rosafe.results.hdf5 import Hdf5
from rosafe.results.result_metadata import ResultWriter

CHUNK = 2**19  # bytes, approximately, of a chunk of the file
_MAT_HEAD = b"MATLAB 7.3 MAT-file, written by rosafe"
_FILL = math.nan  # of Zarr arrays: xarray shows NaN for each number that equals the fill value


class _ChunkBuffer:
    """Collects the blocks of one array into whole chunks."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        *rows, count = shape
        self.frames = min(count, max(1, CHUNK // max(1, 8 * math.prod(rows))))  # of a chunk
        self.written = 0  # frames
        self._blocks: list[np.ndarray] = []
        self._count = 0

    def add(self, block: np.ndarray) -> np.ndarray | None:
        """Add a block. Return the whole chunks to be written at `written`, or None if there are none."""
        self._blocks.append(block)
        self._count += block.shape[-1]
        return self.take(self._count // self.frames * self.frames) if self._count >= self.frames > 0 else None

    def take(self, count: int | None = None) -> np.ndarray | None:
        """Return and remove the first `count` frames, all by default; None if the buffer is empty."""
        if not self._count:
            return None
        whole = np.concatenate(self._blocks, axis=-1)
        count = self._count if count is None else count
        rest = whole[..., count:]
        self._blocks, self._count = ([rest] if rest.shape[-1] else []), rest.shape[-1]
        return whole[..., :count]


class ChunkedWriter(ResultWriter):
    """Writes whole chunks. Subclasses implement `_create`, `_write` and `_end`."""

    def _begin(self) -> None:
        self._buffers = {name: _ChunkBuffer(shape) for name, shape in self._contents.shapes.items()}
        self._create()

    def append(self, name: str, block: np.ndarray) -> None:
        """Append a block to an array, along the last axis."""
        self._write_chunks(name, self._buffers[name].add(block))

    def _write_chunks(self, name: str, data: np.ndarray | None) -> None:
        if data is not None:
            buffer = self._buffers[name]
            self._write(name, buffer.written, data)
            buffer.written += data.shape[-1]

    def finish(self) -> None:
        """Write the remaining frames, and complete the file."""
        for name, buffer in self._buffers.items():
            self._write_chunks(name, buffer.take())
        self._end()

    @abstractmethod
    def _create(self) -> None:
        """Create the file with everything except the numbers of the arrays."""

    @abstractmethod
    def _write(self, name: str, first: int, data: np.ndarray) -> None:
        """Write frames of an array from frame `first` on."""

    @abstractmethod
    def _end(self) -> None:
        """Complete the file."""


class _Hdf5Writer(ChunkedWriter):
    """Writes with the HDF5 library. Subclasses implement `_create_in` and `_write_in`, which run on its thread."""

    USERBLOCK = 0  # bytes before the HDF5 data

    def _create(self) -> None:
        self._file = self._open.enter_context(closing(Hdf5(self._path, userblock_size=self.USERBLOCK)))
        self._file.call(self._create_in)

    def _write(self, name: str, first: int, data: np.ndarray) -> None:
        self._file.call(self._write_in, name, first, data)

    def _end(self) -> None:
        if "clipped" in self._contents.about:
            self._file.call(self._update_clipped)
        self._file.close()
        self._file.check()

    @abstractmethod
    def _update_clipped(self, file: Any) -> None:
        """Write the number of clipped samples, which is known at the end."""

    @abstractmethod
    def _create_in(self, file: Any) -> None:
        """As `_create`, in the open file."""

    @abstractmethod
    def _write_in(self, file: Any, name: str, first: int, data: np.ndarray) -> None:
        """As `_write`, in the open file."""


class H5Writer(_Hdf5Writer):
    """HDF5: a dataset for each array, with its axes as labels and its unit. The other entries are file attributes."""

    def _create_in(self, file: Any) -> None:
        contents = self._contents
        for name, value in contents.fixed.items():
            file[name] = value
        for name, shape in contents.shapes.items():
            chunks = (*shape[:-1], self._buffers[name].frames) if math.prod(shape) else None
            dataset = file.create_dataset(name, shape, np.float64, chunks=chunks)
            dataset.attrs["unit"] = contents.units[name]
            for dimension, axis in zip(dataset.dims, contents.axes[name], strict=True):
                dimension.label = axis
        for name, text in contents.flat().items():
            file.attrs[name] = text

    def _write_in(self, file: Any, name: str, first: int, data: np.ndarray) -> None:
        file[name][..., first : first + data.shape[-1]] = data

    def _update_clipped(self, file: Any) -> None:
        file.attrs["clipped"] = self._contents.about["clipped"]


class Mat73Writer(_Hdf5Writer):
    """MATLAB's version 7.3: HDF5 after 512 bytes, axes in reverse order, types as attributes."""

    USERBLOCK = 512

    def _create_in(self, file: Any) -> None:
        for name, shape in self._contents.shapes.items():
            if math.prod(shape):
                chunks = (self._buffers[name].frames, *shape[-2::-1])
                dataset = file.create_dataset(name, shape[::-1], np.float64, chunks=chunks)
                dataset.attrs["MATLAB_class"] = np.bytes_("double")
            else:
                self._add(file, name, np.array(shape, np.uint64), "double", MATLAB_empty=np.uint8(1))
        flat = self._contents.flat()
        texts = {name: value for name, value in flat.items() if isinstance(value, str)}
        numbers: dict[str, Any] = {**flat, **self._contents.fixed}
        for name, text in texts.items():
            codes = np.frombuffer(text.encode("utf-16-le"), np.uint16).reshape(-1, 1)
            self._add(file, name, codes, "char", MATLAB_int_decode=np.int32(2))
        for name in numbers.keys() - texts.keys():
            self._add(file, name, np.atleast_1d(np.asarray(numbers[name], np.float64))[np.newaxis], "double")

    @staticmethod
    def _add(file: Any, name: str, data: np.ndarray, kind: str, **attributes: np.generic) -> None:
        dataset = file.create_dataset(name, data=data)
        for attribute, value in {"MATLAB_class": np.bytes_(kind), **attributes}.items():
            dataset.attrs[attribute] = value

    def _write_in(self, file: Any, name: str, first: int, data: np.ndarray) -> None:
        file[name][first : first + data.shape[-1]] = data.T

    def _update_clipped(self, file: Any) -> None:
        file["clipped"][...] = self._contents.about["clipped"]

    def _end(self) -> None:
        super()._end()
        with open(self._path, "r+b") as file:  # a text, no data of subsystems, version 2.0, byte order
            file.write(_MAT_HEAD.ljust(116) + bytes(8) + b"\x00\x02IM")


class ZarrWriter(ChunkedWriter):
    """Zarr, format 2, as a folder, with the names of dimensions that xarray expects."""

    MARKER_FILE = ".zgroup"  # a file that each such folder contains

    def _create(self) -> None:
        try:
            self._create_group()
        except KeyError as problem:  # zarr raises this if it cannot create a folder
            raise problem.__context__ if isinstance(problem.__context__, OSError) else problem from None

    def _create_group(self) -> None:
        import zarr

        contents = self._contents
        newer: dict[str, Any] = {} if zarr.__version__.startswith("2.") else {"zarr_format": 2}
        # This keeps the empty folder, which is locked; `open_group` of zarr 3 would replace it.
        self._group = zarr.group(str(self._path), overwrite=False, **newer)
        create = self._group.create_array if newer else self._group.create_dataset
        for name, shape in contents.shapes.items():
            chunks = (*(max(1, length) for length in shape[:-1]), max(1, self._buffers[name].frames))
            array = create(name, shape=shape, chunks=chunks, dtype="<f8", fill_value=_FILL)
            array.attrs.update({"_ARRAY_DIMENSIONS": contents.dimensions(name), "units": contents.units[name]})
        for name, value in contents.fixed.items():
            data = np.asarray(value, np.float64)
            chunks = tuple(min(max(1, length), CHUNK // 8) for length in data.shape)
            array = create(name, shape=data.shape, chunks=chunks, dtype="<f8", fill_value=_FILL)
            array[...] = data
            array.attrs["_ARRAY_DIMENSIONS"] = [name] if data.ndim else []
        self._group.attrs.update(contents.flat())
        self._arrays = {name: self._group[name] for name in contents.shapes}

    def _write(self, name: str, first: int, data: np.ndarray) -> None:
        self._arrays[name][..., first : first + data.shape[-1]] = data

    def _end(self) -> None:
        import zarr

        self._group.attrs.update(self._contents.flat())  # `clipped` is known now
        zarr.consolidate_metadata(str(self._path))
