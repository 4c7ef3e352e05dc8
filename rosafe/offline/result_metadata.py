"""What a file of results holds, whatever its format."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

# what tells runs apart
ABOUT = ("parameters", "sample_rate", "block_frames", "channels", "topic", "source", "rosafe_version", "axes")
MAX_TEXT = 2**20  # characters of a text in a file
_TEXTS = {"source", "topic", "rosafe_version"}  # what is told as it is; other texts are JSON


@dataclass
class Contents:
    """What is to be written.

    Attributes
    ----------
    shapes : dict of str to tuple of int
        Of the float64 arrays that come in blocks along their last axis, the time.
    axes, units : dict of str
        Of these arrays.
    fixed : dict of str to ndarray or float
        What lies along the axes, and rates. The times of samples, which go without saying, are none of it.
    about : dict
        `parameters`, `sample_rate` (Hz), `block_frames`, `source` (the input's name), `rosafe_version`, and what else
        was chosen; words along an axis.
    """

    shapes: dict[str, tuple[int, ...]]
    axes: dict[str, tuple[str, ...]]
    units: dict[str, str]
    fixed: dict[str, np.ndarray | float]
    about: dict[str, Any]

    def dimensions(self, name: str) -> tuple[str, ...]:
        """Names of an array's axes that go together with those of all others: equal names, equal lengths."""
        if name not in self.axes:
            return (name,)
        kind = name.partition("_")[0]
        return tuple(axis if axis in ("ear", "channel") else f"{kind}_{axis}" for axis in self.axes[name])

    def flat(self) -> dict[str, float | str]:
        """All that is no array of numbers, as numbers and texts."""
        everything: dict[str, Any] = {**self.about, "axes": self.axes, "units": self.units}
        return {k: v if isinstance(v, (int, float)) or k in _TEXTS else json.dumps(v) for k, v in everything.items()}


class ResultWriter(Protocol):
    """Takes the arrays as they come; different ones from different threads at the same time.

    Parameters
    ----------
    path : Path
        An empty file, or an empty folder.
    contents : Contents
    """

    def __init__(self, path: Path, contents: Contents) -> None: ...

    @classmethod
    def size(cls, contents: Contents) -> int:
        """Bytes on the disk that it takes at a time."""

    def append(self, name: str, block: np.ndarray) -> None:
        """The next part of an array, of its shape but for the last axis."""

    def finish(self) -> None:
        """All has come: complete the file."""

    def close(self) -> None:
        """Give back what is open; the file need not be complete."""


def parse_metadata(flat: Mapping[str, Any]) -> dict[str, Any]:
    """`Contents.about`, with axes and units, from what `flat` has made of it, numpy's types included.

    ValueError for values of other types than `flat` writes.
    """
    about: dict[str, Any] = {}
    for name, value in flat.items():
        value = value.item() if isinstance(value, (np.ndarray, np.generic)) else value
        if isinstance(value, bytes):
            value = value.decode()
        about[name] = from_json(value) if isinstance(value, str) and name not in _TEXTS else value
    return checked(about)


def from_json(text: str | bytes, most: int = MAX_TEXT) -> Any:
    """The value of a JSON text of at most `most` characters; ValueError if it is none."""
    if len(text) > most:
        raise ValueError(f"a text of {len(text)} characters, expected at most {most}")
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("a text is nested too deeply") from None


def checked(about: dict[str, Any]) -> dict[str, Any]:
    """The same as Python has it, of the types that `Contents` says; ValueError if it is of other types."""
    for name, (expected, fits) in _TYPES.items():
        if name in about and not fits(about[name]):
            raise ValueError(f"{name}: expected {expected}")
    for name in about.keys() & {"sample_rate", "block_frames"}:
        about[name] = int(about[name])
    if "axes" in about:
        about["axes"] = {name: tuple(axes) for name, axes in about["axes"].items()}
    return about


def is_number(value: Any) -> bool:
    """Whether this is a real number, which may be infinite or NaN."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_positive(value: Any) -> bool:
    return is_number(value) and 1 <= value < 2**53


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def is_texts(value: Any) -> bool:
    """Whether this is a list of texts."""
    return isinstance(value, (list, tuple)) and all(isinstance(one, str) for one in value)


def _is_parameter(value: Any) -> bool:
    return all(isinstance(one, (bool, int, float, str)) for one in (value if isinstance(value, list) else [value]))


_TYPES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "sample_rate": ("a positive number", _is_positive),
    "block_frames": ("a positive number", _is_positive),
    "channels": ("numbers of channels", lambda found: isinstance(found, list) and all(map(_is_positive, found))),
    "source": ("a text", _is_text),
    "topic": ("a text", _is_text),
    "rosafe_version": ("a text", _is_text),
    "parameters": (
        "numbers, texts and lists of these, by name",
        lambda found: isinstance(found, dict) and all(map(_is_parameter, found.values())),
    ),
    "axes": (
        "a list of names for each array",
        lambda found: isinstance(found, dict) and all(map(is_texts, found.values())),
    ),
    "units": ("a text for each array", lambda found: isinstance(found, dict) and all(map(_is_text, found.values()))),
}


def new_array(shape: tuple[int, ...], dtype: np.dtype[Any], order: Literal["C", "F"] = "C") -> np.ndarray:
    """An array to be filled; ValueError for a shape that cannot be."""
    try:
        return np.empty(shape, dtype, order)
    except (MemoryError, OverflowError):
        raise ValueError("an array does not fit into the memory") from None


def restored(array: np.ndarray, axes: tuple[str, ...] | None) -> np.ndarray:
    """An array as it was before MATLAB has left out axes of length 1 at its end, or has made two axes of one."""
    if axes is None:
        return array.ravel()
    return array.reshape(array.shape + (1,) * (len(axes) - array.ndim))


def sample_times(count: int, sample_rate: float) -> np.ndarray:
    """When each sample is (s), as `rosafe.offline.signals.frame_times` tells it."""
    return np.arange(count) / sample_rate


def is_scalar(name: str) -> bool:
    """Whether this is a single number, in formats that cannot tell it from a vector of one."""
    return name in ("sample_rate", "block_frames") or name.endswith("_frameRate")
