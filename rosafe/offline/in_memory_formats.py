"""Formats that want each array whole: .npz, MATLAB's version 5 .mat, and .csv. Large arrays wait on the disk."""

from __future__ import annotations

import json
import math
import os
import tempfile
import zipfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from rosafe.offline.result_metadata import Contents, sample_times

HEAD = 2**10  # bytes at most in a file for each thing in it, and once more, beside its numbers or letters
IN_MEMORY = 2**28  # bytes of all arrays together; from there on they are on the disk
CSV_HEAD = "# rosafe "


class WholeWriter:
    """Gathers the arrays, and writes all at the end. Subclasses say how, in `_write`.

    Parameters
    ----------
    path : Path
        An empty file.
    contents : Contents
    """

    def __init__(self, path: Path, contents: Contents) -> None:
        self._path = path
        self._contents = contents
        self._at = dict.fromkeys(contents.shapes, 0)
        self._open = ExitStack()
        try:
            self._arrays = {name: self._array(shape) for name, shape in contents.shapes.items()}
        except BaseException:
            self.close()
            raise

    @classmethod
    def size(cls, contents: Contents) -> int:
        """Bytes on the disk that it takes at a time."""
        taken = sum(8 * math.prod(shape) for shape in contents.shapes.values())
        return taken if taken <= IN_MEMORY else 2 * taken

    def _array(self, shape: tuple[int, ...]) -> np.ndarray:
        count = math.prod(shape)
        if self.size(self._contents) <= IN_MEMORY or not count:
            return np.empty(shape)
        file = self._open.enter_context(tempfile.TemporaryFile(dir=self._path.parent))  # noqa: SIM115
        os.posix_fallocate(file.fileno(), 0, 8 * count)  # a full disk must show here: in a map, it kills
        return np.memmap(file, np.float64, "r+", 0, shape, "F")

    def append(self, name: str, block: np.ndarray) -> None:
        """The next part of an array, of its shape but for the last axis."""
        at = self._at[name]
        self._at[name] = at + block.shape[-1]
        self._arrays[name][..., at : at + block.shape[-1]] = block

    def finish(self) -> None:
        """Write the file."""
        with open(self._path, "r+b") as file:
            # A full disk must show before numpy and scipy write, who leave files open that they cannot complete.
            sizes = [np.asarray(value).nbytes for value in self._everything().values()]
            os.posix_fallocate(file.fileno(), 0, sum(sizes) + HEAD * (len(sizes) + 1))
            self._write(file)
            file.truncate()

    def _everything(self) -> dict[str, Any]:
        return {**self._arrays, **self._contents.fixed, **self._contents.flat()}

    def _write(self, file: BinaryIO) -> None:
        raise NotImplementedError

    def close(self) -> None:
        """Let go of what waited on the disk."""
        self._arrays = {}
        self._open.close()


class NpzWriter(WholeWriter):
    """For numpy.load."""

    def _write(self, file: BinaryIO) -> None:
        # As numpy.savez, which leaves an archive that it cannot complete to the garbage collector, and that complains.
        with zipfile.ZipFile(file, "w") as archive:
            for name, value in self._everything().items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    np.lib.format.write_array(entry, np.asanyarray(value), allow_pickle=False)


class Mat5Writer(WholeWriter):
    """MATLAB's version 5, which Octave reads as well."""

    def _write(self, file: BinaryIO) -> None:
        from scipy.io import savemat

        savemat(file, self._everything(), long_field_names=True, oned_as="column")


class CsvWriter(WholeWriter):
    """One output of two axes: a row for each moment, which is its first column; what else there is, as JSON above."""

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
