"""Formats that grow block by block: HDF5, MATLAB's version 7.3 .mat (HDF5 of its own kind), and Zarr."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np

from rosafe.offline.hdf5 import Hdf5
from rosafe.offline.result_metadata import Contents

CHUNK = 2**19  # bytes, about; what is read and written at a time
_MAT_HEAD = b"MATLAB 7.3 MAT-file, written by rosafe"
_FILL = math.nan  # of zarr's arrays: xarray takes each number that equals it for one that is missing, and shows NaN


class _ChunkBuffer:
    """Blocks of one array on their way to whole chunks."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        *rows, count = shape
        self.frames = min(count, max(1, CHUNK // max(1, 8 * math.prod(rows))))  # of a chunk
        self.at = 0
        self._blocks: list[np.ndarray] = []
        self._count = 0

    def add(self, block: np.ndarray) -> np.ndarray | None:
        """Take a block; what is to be written now, at `at`, if it is time."""
        self._blocks.append(block)
        self._count += block.shape[-1]
        return self.rest(self._count // self.frames * self.frames) if self._count >= self.frames > 0 else None

    def rest(self, count: int | None = None) -> np.ndarray | None:
        """The first `count` frames of what waits, all by default; None where nothing does."""
        if not self._count:
            return None
        whole = np.concatenate(self._blocks, axis=-1)
        count = self._count if count is None else count
        left = whole[..., count:]
        self._blocks, self._count = ([left] if left.shape[-1] else []), left.shape[-1]
        return whole[..., :count]


class ChunkedWriter(ABC):
    """Writes whole chunks.

    Parameters
    ----------
    path : Path
        An empty file, or an empty folder.
    contents : Contents
    """

    def __init__(self, path: Path, contents: Contents) -> None:
        self._path = path
        self._contents = contents
        self._waiting = {name: _ChunkBuffer(shape) for name, shape in contents.shapes.items()}
        self._open = ExitStack()
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    @classmethod
    def size(cls, contents: Contents) -> int:
        """Bytes on the disk that it takes at a time."""
        return sum(8 * math.prod(shape) for shape in contents.shapes.values())

    def append(self, name: str, block: np.ndarray) -> None:
        """The next part of an array, of its shape but for the last axis."""
        self._put(name, self._waiting[name].add(block))

    def _put(self, name: str, data: np.ndarray | None) -> None:
        if data is not None:
            waiting = self._waiting[name]
            self._write(name, waiting.at, data)
            waiting.at += data.shape[-1]

    def finish(self) -> None:
        """Write what still waits, and complete the file."""
        for name, waiting in self._waiting.items():
            self._put(name, waiting.rest())
        self._end()

    @abstractmethod
    def _begin(self) -> None:
        """Make the file, with all but the arrays' numbers."""

    @abstractmethod
    def _write(self, name: str, at: int, data: np.ndarray) -> None:
        """Write a part of an array."""

    @abstractmethod
    def _end(self) -> None:
        """Complete the file."""

    def close(self) -> None:
        """Close the file, complete or not."""
        self._open.close()


class _Hdf5Writer(ChunkedWriter):
    """Writes a file of the HDF5 library."""

    USERBLOCK = 0  # bytes before the file of the library

    def _begin(self) -> None:
        self._file = self._open.enter_context(closing(Hdf5(self._path, userblock_size=self.USERBLOCK)))
        self._file.call(self._create)

    def _write(self, name: str, at: int, data: np.ndarray) -> None:
        self._file.call(self._put_into, name, at, data)

    def _end(self) -> None:
        self._file.close()
        self._file.check()

    @abstractmethod
    def _create(self, file: Any) -> None:
        """Put everything in the open file but the arrays' numbers."""

    @abstractmethod
    def _put_into(self, file: Any, name: str, at: int, data: np.ndarray) -> None:
        """Write a part of an array."""


class H5Writer(_Hdf5Writer):
    """HDF5: a dataset for each array, with its axes as labels and its unit; all else are attributes of the file."""

    def _create(self, file: Any) -> None:
        contents = self._contents
        for name, value in contents.fixed.items():
            file[name] = value
        for name, shape in contents.shapes.items():
            chunks = (*shape[:-1], self._waiting[name].frames) if math.prod(shape) else None
            dataset = file.create_dataset(name, shape, np.float64, chunks=chunks)
            dataset.attrs["unit"] = contents.units[name]
            for dimension, axis in zip(dataset.dims, contents.axes[name], strict=True):
                dimension.label = axis
        for name, text in contents.flat().items():
            file.attrs[name] = text

    def _put_into(self, file: Any, name: str, at: int, data: np.ndarray) -> None:
        file[name][..., at : at + data.shape[-1]] = data


class Mat73Writer(_Hdf5Writer):
    """MATLAB's version 7.3: HDF5 behind 512 bytes, axes in the opposite order, types as attributes."""

    USERBLOCK = 512

    def _create(self, file: Any) -> None:
        for name, shape in self._contents.shapes.items():
            if math.prod(shape):
                chunks = (self._waiting[name].frames, *shape[-2::-1])
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
        dataset.attrs["MATLAB_class"] = np.bytes_(kind)
        for attribute, value in attributes.items():
            dataset.attrs[attribute] = value

    def _put_into(self, file: Any, name: str, at: int, data: np.ndarray) -> None:
        file[name][at : at + data.shape[-1]] = data.T

    def _end(self) -> None:
        super()._end()
        with open(self._path, "r+b") as file:  # text, nothing of subsystems, version 2.0, the order of bytes
            file.write(_MAT_HEAD.ljust(116) + bytes(8) + b"\x00\x02IM")


class ZarrWriter(ChunkedWriter):
    """Zarr, format 2, as a folder, with names of dimensions as xarray wants them."""

    SIGN = ".zgroup"  # a file that each such folder holds

    def _begin(self) -> None:
        try:
            self._create()
        except KeyError as problem:  # so zarr says that it cannot make a folder
            raise problem.__context__ if isinstance(problem.__context__, OSError) else problem from None

    def _create(self) -> None:
        import zarr

        contents = self._contents
        newer: dict[str, Any] = {} if zarr.__version__.startswith("2.") else {"zarr_format": 2}
        # The folder is empty, and stays the one that is locked: with mode="w" zarr would make another one.
        self._group = zarr.open_group(str(self._path), mode="a", **newer)
        make = self._group.create_array if newer else self._group.create_dataset
        for name, shape in contents.shapes.items():
            chunks = (*(max(1, length) for length in shape[:-1]), max(1, self._waiting[name].frames))
            array = make(name, shape=shape, chunks=chunks, dtype="<f8", fill_value=_FILL)
            array.attrs.update({"_ARRAY_DIMENSIONS": contents.dimensions(name), "units": contents.units[name]})
        for name, value in contents.fixed.items():
            data = np.asarray(value, np.float64)
            chunks = tuple(min(max(1, length), CHUNK // 8) for length in data.shape)
            array = make(name, shape=data.shape, chunks=chunks, dtype="<f8", fill_value=_FILL)
            array[...] = data
            array.attrs["_ARRAY_DIMENSIONS"] = [name] if data.ndim else []
        self._group.attrs.update(contents.flat())
        self._arrays = {name: self._group[name] for name in contents.shapes}

    def _write(self, name: str, at: int, data: np.ndarray) -> None:
        self._arrays[name][..., at : at + data.shape[-1]] = data

    def _end(self) -> None:
        import zarr

        zarr.consolidate_metadata(str(self._path))
