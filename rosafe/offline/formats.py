"""The formats of result files, by the ends of their names; `load` reads any of them."""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rosafe.declarations.parameter import short_repr
from rosafe.input import open_descriptor, open_regular
from rosafe.interface import KINDS, Representation
from rosafe.missing import require
from rosafe.offline.containers import read_h5, read_mat73, read_zarr
from rosafe.offline.in_memory_formats import CsvWriter, Mat5Writer, NpzWriter
from rosafe.offline.mat5 import read_mat5
from rosafe.offline.readers import read_csv, read_npz
from rosafe.offline.result_metadata import Contents, ResultWriter, checked, is_number, is_texts, sample_times
from rosafe.offline.streaming_formats import H5Writer, Mat73Writer, ZarrWriter

MAT5_MOST = 2**30  # bytes of a variable; MATLAB's version 5 ends at 2**31, and scipy needs an array twice
_MAX_EMPTY = 2**20  # along each axis of an array without numbers
_MAT73_MAGIC = b"MATLAB 7.3"


@dataclass(frozen=True)
class Format:
    """One of them.

    Attributes
    ----------
    extension : str
    writer : callable
        The class of its writer, given the contents.
    read : callable
        Of a path, and whether the arrays are wanted.
    begins : bytes
        What its files begin with.
    module : str
        What must be installed.
    folder : str
        The name of a file that each has in it, where it is a folder.
    """

    extension: str
    writer: Callable[[Contents], type[ResultWriter]]
    read: Callable[..., dict[str, Any]]
    begins: bytes = b""
    module: str = ""
    folder: str = ""

    def is_one(self, path: Path) -> bool:
        """Whether what is there looks as if it were one, or the beginning of one."""
        if self.folder:
            return path.is_dir() and ((path / self.folder).exists() or not any(path.iterdir()))
        if not path.is_file():
            return False
        with open_regular(path) as file:
            begin = file.read(len(self.begins))
        return self.begins.startswith(begin) or (self.begins.startswith(b"MATLAB") and not any(begin))


def _mat_writer(contents: Contents) -> type[ResultWriter]:
    largest = max((8 * math.prod(shape) for shape in contents.shapes.values()), default=0)
    if largest > MAT5_MOST:
        return Mat73Writer
    return Mat5Writer


def _read_mat(path: Path, arrays: bool = True) -> dict[str, Any]:
    with open_regular(path) as file:
        new = file.read(len(_MAT73_MAGIC)) == _MAT73_MAGIC
    return (read_mat73 if new else read_mat5)(path, arrays)


FORMATS = {
    one.extension: one
    for one in (
        Format(".npz", lambda contents: NpzWriter, read_npz, b"PK"),
        Format(".h5", lambda contents: H5Writer, read_h5, b"\x89HDF", "h5py"),
        Format(".mat", _mat_writer, _read_mat, b"MATLAB"),
        Format(".zarr", lambda contents: ZarrWriter, read_zarr, module="zarr", folder=ZarrWriter.SIGN),
        Format(".csv", lambda contents: CsvWriter, read_csv, b"# rosafe"),
    )
}


def format_of(path: str | os.PathLike[str]) -> Format:
    """The format of a result file by its name; ValueError where it is none."""
    extension = Path(path).suffix.lower()
    if extension not in FORMATS:
        raise ValueError(f"{path}: results end in {', '.join(FORMATS)}")
    return FORMATS[extension]


def check_format(form: Format, outputs: Iterable[str]) -> None:
    """ValueError where a format cannot hold these outputs; ModuleNotFoundError where what it needs is not installed."""
    if form.module:
        require(form.module, f"{form.extension} files")
    if form.extension == ".csv":
        parts = [part for kind in outputs for part in KINDS[kind].outputs.values()]
        if len(parts) != 1 or len(parts[0].axes) != 2:
            able = [kind for kind, one in KINDS.items() if [len(p.axes) for p in one.outputs.values()] == [2]]
            raise ValueError(f"a .csv holds one output of two axes: name one of {', '.join(able)} with --outputs")


def load(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a file that `rosafe process` has written.

    Parameters
    ----------
    path : path
        It ends in .npz, .h5, .mat, .zarr or .csv.

    Returns
    -------
    dict
        What `rosafe.process` returns for the same samples, number for number; beside that `sample_rate` (Hz),
        `block_frames`, `parameters` (dict: all of them, for `rosafe.process`), `source` (name of the input),
        `channels` and `topic` where some were chosen, `rosafe_version`, and `axes` and `units` of each output.

    Raises
    ------
    ValueError
        It is no such file, or damaged.
    OSError
        It is not there, or cannot be read.
    ModuleNotFoundError
        h5py or zarr is not installed.
    """
    form = format_of(path)
    result = read(form, Path(path))
    try:
        _check_arrays(result)
    except ValueError as problem:
        raise ValueError(f"{path} is damaged: {problem}") from None
    for kind in KINDS.values():  # what has no frames has a number for each sample
        there = [name for name in kind.outputs if name in result["axes"]]
        if there and f"{kind.kind}_time" not in result:
            result[f"{kind.kind}_time"] = sample_times(result[there[0]].shape[-1], result["sample_rate"])
    return result


def _check_arrays(result: Mapping[str, Any]) -> None:
    """ValueError where outputs, or what lies along their axes, are missing or of another type."""
    missing = result["axes"].keys() - result.keys()
    if missing:
        raise ValueError(f"{', '.join(map(short_repr, sorted(missing)))} is not in it")
    for name, axes in result["axes"].items():
        _check_array(name, result[name], len(axes))
    for kind in KINDS.values():
        _check_kind(kind, result)


def _check_kind(kind: Representation, result: Mapping[str, Any]) -> None:
    """ValueError where an output of a kind, or what lies along its axes, is not what its declaration says."""
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
            raise ValueError(f"{time}: its length is not that of {outputs[0]}")
    rate = result.get(f"{kind.kind}_frameRate", 1.0)
    if not is_number(rate) or not 0 < rate < math.inf:
        raise ValueError(f"{kind.kind}_frameRate: expected a positive number")
    units = {one.name: one.unit for one in kind.parameters} | {one.name: one.unit for one in kind.derived}
    for name in kind.coordinates:
        if units[name]:
            _check_array(name, result.get(name, np.empty(0)), 1)
        elif not is_texts(result.get(name, ())):
            raise ValueError(f"{name}: expected texts")


def _check_array(name: str, value: Any, dimensions: int) -> None:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu" or value.dtype.itemsize < 4:
        raise ValueError(f"{short_repr(name)}: expected an array of numbers of 32 or 64 bits")
    if value.ndim != dimensions or (not value.size and max(value.shape) > _MAX_EMPTY):
        raise ValueError(f"{short_repr(name)}: expected {dimensions} axes, got the shape {value.shape}")


def read(form: Format, path: Path, arrays: bool = True) -> dict[str, Any]:
    """What is in a file; without its arrays, only what tells runs apart. Errors as those of `load`."""
    if not path.exists():
        raise FileNotFoundError(2, os.strerror(2), str(path))
    if form.module and not importlib.util.find_spec(form.module):  # it need not be imported here
        require(form.module, f"{form.extension} files")
    if form.folder and not path.is_dir():
        raise ValueError(f"{path}: expected a directory, got a file")
    if not form.folder:
        os.close(open_descriptor(path))  # HDF5 opens whatever it is given
    try:
        result = checked(form.read(path, arrays))
    except (ValueError, OverflowError, RecursionError, MemoryError) as problem:  # json.JSONDecodeError, too
        raise ValueError(f"{path} is no result of rosafe process, or damaged: {problem}") from None
    for name in ("axes", "parameters", "sample_rate"):
        if name not in result:
            raise ValueError(f"{path} is no result of rosafe process: {name} is not in it")
    return result
