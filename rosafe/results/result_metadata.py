"""The contents of a result file, independent of its format, and the base class of the writers."""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

# entries by which runs can be compared
ABOUT = (
    *("parameters", "sample_rate", "block_frames", "channels", "topic", "source", "rosafe_version", "axes"),
    *("pad", "clip"),
)
MAX_TEXT = 2**20  # characters of a text in a file
_TEXTS = {"source", "topic", "rosafe_version", "dtype"}  # stored as they are; other texts are JSON


@dataclass
class Contents:
    """The contents of a result file.

    Attributes
    ----------
    shapes : dict of str to tuple of int
        Of the float64 arrays that are written in blocks along their last axis, the time.
    axes, units : dict of str
        Of these arrays.
    fixed : dict of str to ndarray or float
        Coordinates and rates. The times of samples are omitted, because they follow from the sample rate.
    about : dict
        `parameters`, `sample_rate` (Hz), `block_frames`, `source` (the name of the input), `rosafe_version`, further
        options of the run, `clipped` (a number of samples, which may change until `ResultWriter.finish`), and
        coordinates that are names.
    """

    shapes: dict[str, tuple[int, ...]]
    axes: dict[str, tuple[str, ...]]
    units: dict[str, str]
    fixed: dict[str, np.ndarray | float]
    about: dict[str, Any]

    @property
    def size(self) -> int:
        """Bytes of all arrays."""
        return sum(8 * math.prod(shape) for shape in self.shapes.values())

    def dimensions(self, name: str) -> tuple[str, ...]:
        """Return names for the axes of an array that are unique in the file: equal names have equal lengths."""
        if name not in self.axes:
            return (name,)
        kind = name.partition("_")[0]
        return tuple(axis if axis in ("ear", "channel") else f"{kind}_{axis}" for axis in self.axes[name])

    def flat(self) -> dict[str, float | str]:
        """Return everything except arrays, as numbers and texts."""
        everything: dict[str, Any] = {**self.about, "axes": self.axes, "units": self.units}
        return {k: v if isinstance(v, (int, float)) or k in _TEXTS else json.dumps(v) for k, v in everything.items()}


class ResultWriter(ABC):
    """Writes the arrays block by block. Different arrays may be appended concurrently by different threads.

    Parameters
    ----------
    path : Path
        An empty file, or an empty folder.
    contents : Contents
    """

    def __init__(self, path: Path, contents: Contents) -> None:
        self._path = path
        self._contents = contents
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

    @abstractmethod
    def _begin(self) -> None:
        """Prepare for the first block."""

    @abstractmethod
    def append(self, name: str, block: np.ndarray) -> None:
        """Append a block to an array, along the last axis."""

    @abstractmethod
    def finish(self) -> None:
        """Complete the file."""

    def close(self) -> None:
        """Close the file, complete or not, and release all resources."""
        self._open.close()


def parse_metadata(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return `Contents.about` with axes and units from the output of `flat`, which may have numpy types.

    ValueError for values of other types than `flat` writes.
    """
    about: dict[str, Any] = {}
    for name, value in flat.items():
        value = value.item() if isinstance(value, (np.ndarray, np.generic)) else value
        if isinstance(value, bytes):
            value = value.decode()
        about[name] = from_json(value) if isinstance(value, str) and name not in _TEXTS else value
    return checked(about)


def from_json(text: str | bytes, max_length: int = MAX_TEXT) -> Any:
    """Return the value of a JSON text; ValueError if it is longer than `max_length` or invalid."""
    if len(text) > max_length:
        raise ValueError(f"expected a text of at most {max_length} characters, got {len(text)}")
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("a text is nested too deeply") from None


def checked(about: dict[str, Any]) -> dict[str, Any]:
    """Return `about` with Python's types; ValueError for types other than those of `Contents`."""
    for name, (expected, fits) in _TYPES.items():
        if name in about and not fits(about[name]):
            raise ValueError(f"{name}: expected {expected}")
    for name in about.keys() & {"sample_rate", "block_frames", "clipped"}:
        about[name] = int(about[name]) if about[name] == int(about[name]) else float(about[name])
    if "axes" in about:
        about["axes"] = {name: tuple(axes) for name, axes in about["axes"].items()}
    return about


def is_number(value: Any) -> bool:
    """Return whether `value` is a real number, possibly infinite or NaN."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_positive(value: Any) -> bool:
    return is_number(value) and 1 <= value < 2**53


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def is_texts(value: Any) -> bool:
    """Return whether `value` is a list of texts."""
    return isinstance(value, (list, tuple)) and all(map(_is_text, value))


def _is_parameter(value: Any) -> bool:
    return all(isinstance(one, (bool, int, float, str)) for one in (value if isinstance(value, list) else [value]))


def _is_dict_of(fits: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda found: isinstance(found, dict) and all(map(fits, found.values()))


_TYPES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "sample_rate": ("a positive number", lambda found: is_number(found) and 0 < found < 2**53),
    "clipped": ("a number of samples", lambda found: is_number(found) and 0 <= found < 2**53 and found == int(found)),
    "pad": ("true or false", lambda found: isinstance(found, (bool, int, float))),
    "clip": ("true or false", lambda found: isinstance(found, (bool, int, float))),
    "dtype": ("float32 or float64", lambda found: found in ("float32", "float64")),
    "block_frames": ("a positive number", _is_positive),
    "channels": ("numbers of channels", lambda found: isinstance(found, list) and all(map(_is_positive, found))),
    "source": ("a text", _is_text),
    "topic": ("a text", _is_text),
    "rosafe_version": ("a text", _is_text),
    "parameters": ("numbers, texts and lists of these, by name", _is_dict_of(_is_parameter)),
    "axes": ("a list of names for each array", _is_dict_of(is_texts)),
    "units": ("a text for each array", _is_dict_of(_is_text)),
}


def new_array(shape: tuple[int, ...], dtype: np.dtype[Any], order: Literal["C", "F"] = "C") -> np.ndarray:
    """Return an array to be filled; ValueError if it cannot be allocated."""
    try:
        return np.empty(shape, dtype, order)
    except (MemoryError, OverflowError):
        raise ValueError("an array does not fit into the memory") from None


def restored(array: np.ndarray, axes: tuple[str, ...] | None) -> np.ndarray:
    """Return an array in its shape before MATLAB dropped trailing axes of length 1 or added an axis to a vector."""
    if axes is None:
        return array.ravel()
    return array.reshape(array.shape + (1,) * (len(axes) - array.ndim))


def sample_times(count: int, sample_rate: float) -> np.ndarray:
    """Return the time of each sample (s), as `rosafe.processing.signals.frame_times`."""
    return np.arange(count) / sample_rate


def is_scalar(name: str) -> bool:
    """Return whether an entry is a number, in formats that cannot distinguish it from a vector of length 1."""
    return name in ("sample_rate", "block_frames", "clipped", "pad", "clip") or name.endswith("_frameRate")
