"""The formats of result files, by the suffix of the name, and `load`, which reads all of them."""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rosafe.declarations.text import short_repr
from rosafe.interface import KINDS, Representation
from rosafe.results.containers import read_h5, read_mat73, read_zarr
from rosafe.results.in_memory_formats import CsvWriter, Mat5Writer, NpzWriter
from rosafe.results.mat5 import read_mat5
from rosafe.results.readers import read_csv, read_npz
from rosafe.results.result import Result
from rosafe.results.result_metadata import Contents, ResultWriter, checked, is_number, is_texts, sample_times
from rosafe.results.streaming_formats import H5Writer, Mat73Writer, ZarrWriter
from rosafe.system.input import open_regular
from rosafe.system.missing import require
from rosafe.system.output import new_folder, new_path

MAX_MAT5 = 2**30  # bytes of a variable; the limit of MATLAB's version 5 is 2**31, and scipy copies an array
_MAX_EMPTY = 2**20  # along each axis of an array without numbers
_MAT73_MAGIC = b"MATLAB 7.3"


@dataclass(frozen=True)
class Format:
    """A format of result files.

    Attributes
    ----------
    extension : str
    writer : callable
        Returns the class of its writer for given contents.
    read : callable
        Takes the path, and whether to read the arrays.
    begins : bytes
        The first bytes of its files.
    module : str
        A package that must be installed.
    folder : str
        If results are folders: the name of a file that each of them contains.
    """

    extension: str
    writer: Callable[[Contents], type[ResultWriter]]
    read: Callable[..., dict[str, Any]]
    begins: bytes = b""
    module: str = ""
    folder: str = ""

    def is_one(self, path: Path) -> bool:
        """Return whether an existing file looks like a result of this format, or the beginning of one."""
        if self.folder:
            return path.is_dir() and ((path / self.folder).exists() or not any(path.iterdir()))
        if not path.is_file():
            return False
        with open_regular(path) as file:
            begin = file.read(len(self.begins))
        return self.begins.startswith(begin) or (self.begins.startswith(b"MATLAB") and not any(begin))


def _mat_writer(contents: Contents) -> type[ResultWriter]:
    largest = max((8 * math.prod(shape) for shape in contents.shapes.values()), default=0)
    if largest > MAX_MAT5:
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
        Format(".zarr", lambda contents: ZarrWriter, read_zarr, module="zarr", folder=ZarrWriter.MARKER_FILE),
        Format(".csv", lambda contents: CsvWriter, read_csv, b"# rosafe"),
    )
}


def format_of(path: str | os.PathLike[str]) -> Format:
    """Return the format of a result file by the suffix of its name; ValueError if the suffix is unknown."""
    extension = Path(path).suffix.lower()
    if extension not in FORMATS:
        raise ValueError(f"{path}: expected a name that ends in {', '.join(FORMATS)}")
    return FORMATS[extension]


def check_format(file_format: Format, outputs: Collection[str]) -> None:
    """Raise ValueError if a format cannot store these outputs, or ModuleNotFoundError if its package is missing."""
    if file_format.module:
        require(file_format.module, f"{file_format.extension} files")
    if file_format.extension == ".csv":
        parts = [part for kind in outputs for part in KINDS[kind].outputs.values()]
        if len(parts) != 1 or len(parts[0].axes) != 2:
            possible = [kind for kind, one in KINDS.items() if [len(p.axes) for p in one.outputs.values()] == [2]]
            raise ValueError(
                f"outputs: expected for a .csv one output of two axes ({', '.join(possible)}), got {', '.join(outputs)}"
            )


def load(path: str | os.PathLike[str]) -> Result:
    """Read a file that `rosafe process` has written.

    Parameters
    ----------
    path : path
        It ends in .npz, .h5, .mat, .zarr or .csv.

    Returns
    -------
    Result
        The result of `rosafe.process` for the same samples, with the same bits, keys and attributes. If
        `rosafe process` has written it, it also has the keys `block_frames`, `source` (name of the input), `channels`
        and `topic` if they were given, `pad` and `clip`.

    Raises
    ------
    ValueError
        It is not a result file, or it is damaged.
    OSError
        It does not exist, or cannot be read.
    ModuleNotFoundError
        h5py or zarr is not installed.
    """
    file_format = format_of(path)
    result = read(file_format, Path(path))
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


def save(result: Result, path: str | os.PathLike[str]) -> None:
    """Write a result to a file, which is replaced if it exists; see `Result.save`."""
    file_format = format_of(path)
    check_format(file_format, result.kinds)
    axes, units = result.axes, result.units
    times = {f"{kind}_time" for kind in result.kinds if f"{kind}_frameRate" not in result}  # of samples: not stored
    coordinates = {name: value for name, value in result.items() if name in units.keys() - axes.keys() - times}
    names = {name: value for name, value in coordinates.items() if isinstance(value, list)}
    options = ("source", "block_frames", "channels", "topic", "pad", "clip")
    about = {name: result[name] for name in options if name in result}
    about |= {"rosafe_version": result.version, "sample_rate": result.sample_rate, "parameters": result.parameters}
    about |= {"clipped": result.clipped, **names}
    if any(result[name].dtype == np.float32 for name in axes):
        about["dtype"] = "float32"
    contents = Contents(
        {name: result[name].shape for name in axes},
        axes,
        {name: units[name] for name in axes},
        {name: value for name, value in coordinates.items() if name not in names},
        about,
    )
    writer_class = file_format.writer(contents)
    with new_output(file_format, path, replace=True) as place, closing(writer_class(place, contents)) as writer:
        for name in axes:
            writer.append(name, np.asarray(result[name], np.float64))
        writer.finish()


def new_output(file_format: Format, path: str | os.PathLike[str], replace: bool) -> AbstractContextManager[Path]:
    """Return a context that yields an empty file or folder, which becomes `path` on success."""
    return new_folder(Path(path), replace, file_format.folder) if file_format.folder else new_path(Path(path), replace)


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


def _damaged(path: str | os.PathLike[str], reason: object) -> ValueError:
    return ValueError(
        f"{path}: expected a result of rosafe process, got another or damaged file: {reason}; compute the result again"
    )


def read(file_format: Format, path: Path, arrays: bool = True) -> dict[str, Any]:
    """Return the contents of a file; without `arrays`, only the metadata. Raises the errors of `load`."""
    if not path.exists():
        raise FileNotFoundError(2, os.strerror(2), str(path))
    if file_format.module and not importlib.util.find_spec(file_format.module):  # the child process imports it
        require(file_format.module, f"{file_format.extension} files")
    if file_format.folder and not path.is_dir():
        raise ValueError(f"{path}: expected a directory, got a file")
    try:
        result = checked(file_format.read(path, arrays))
    except (ValueError, OverflowError, RecursionError, MemoryError) as problem:  # json.JSONDecodeError, too
        raise _damaged(path, problem) from None
    for name in ("axes", "parameters", "sample_rate"):
        if name not in result:
            raise _damaged(path, f"it lacks {name}")
    return result
