"""Formats written from whole arrays: .npz, version 5 .mat of MATLAB, and .csv. Large arrays are kept on the disk."""

from __future__ import annotations

import json
import math
import os
import tempfile
import zipfile
from abc import abstractmethod
from typing import Any, BinaryIO

import numpy as np

from rosafe.results.result_metadata import Contents, ResultWriter, sample_times

MAX_OVERHEAD = 2**10  # bytes in a file for each entry, and once for the file, in addition to numbers and letters
IN_MEMORY = 2**28  # bytes of all arrays together; larger ones are kept on the disk
CSV_HEAD = "# rosafe "


class InMemoryWriter(ResultWriter):
    """Collects the arrays, and writes them all at the end. Subclasses implement `_write`."""

    def _begin(self) -> None:
        self._ends = dict.fromkeys(self._contents.shapes, 0)  # of the frames that have been appended
        self._arrays = {name: self._array(shape) for name, shape in self._contents.shapes.items()}

    @classmethod
    def size(cls, contents: Contents) -> int:
        """Return the maximum number of bytes on the disk while it is written."""
        return contents.size if contents.size <= IN_MEMORY else 2 * contents.size

    def _array(self, shape: tuple[int, ...]) -> np.ndarray:
        count = math.prod(shape)
        if self.size(self._contents) <= IN_MEMORY or not count:
            return np.empty(shape)
        file = self._open.enter_context(tempfile.TemporaryFile(dir=self._path.parent))  # noqa: SIM115
        os.posix_fallocate(file.fileno(), 0, 8 * count)  # fails on a full disk; a write to the map would be fatal
        return np.memmap(file, np.float64, "r+", 0, shape, "F")

    def append(self, name: str, block: np.ndarray) -> None:
        """Append a block to an array, along the last axis."""
        first = self._ends[name]
        end = self._ends[name] = first + block.shape[-1]
        self._arrays[name][..., first:end] = block

    def finish(self) -> None:
        """Write the file."""
        with open(self._path, "r+b") as file:
            # On a full disk this fails. numpy and scipy would leave files open that they cannot complete.
            sizes = [np.asarray(value).nbytes for value in self._everything().values()]
            os.posix_fallocate(file.fileno(), 0, sum(sizes) + MAX_OVERHEAD * (len(sizes) + 1))
            self._write(file)
            file.truncate()

    def _everything(self) -> dict[str, Any]:
        return {**self._arrays, **self._contents.fixed, **self._contents.flat()}

    @abstractmethod
    def _write(self, file: BinaryIO) -> None:
        """Write the contents to the open file."""

    def close(self) -> None:
        """Release the arrays."""
        self._arrays = {}
        super().close()


class NpzWriter(InMemoryWriter):
    """Writes .npz for numpy.load."""

    def _write(self, file: BinaryIO) -> None:
        # Not numpy.savez: the garbage collector would report the archive that it leaves open on failure.
        with zipfile.ZipFile(file, "w") as archive:
            for name, value in self._everything().items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    np.lib.format.write_array(entry, np.asanyarray(value), allow_pickle=False)


class Mat5Writer(InMemoryWriter):
    """Writes MATLAB's version 5, which Octave reads too."""

    def _write(self, file: BinaryIO) -> None:
        from scipy.io import savemat

        savemat(file, self._everything(), long_field_names=True, oned_as="column")


class CsvWriter(InMemoryWriter):
    """Writes one output of two axes: a row per frame, with the time first. The other entries are JSON in line 1."""

    def _write(self, file: BinaryIO) -> None:
        contents = self._contents
        (name,) = contents.shapes
        time = f"{name}_time"
        fixed = {k: v if isinstance(v, float) else v.tolist() for k, v in contents.fixed.items() if k != time}
        rows = self._arrays[name].T
        head = {**contents.about, "axes": contents.axes, "units": contents.units, "fixed": fixed, "rows": len(rows)}
        lines = [f"{CSV_HEAD}{json.dumps(head)}", ",".join([time, *self._columns(name, rows.shape[1])])]
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
