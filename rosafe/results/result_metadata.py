"""The contents of a result file, independent of its format."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from rosafe.declarations.checks import is_number

# entries by which runs can be compared
ABOUT = (
    *("parameters", "sample_rate", "block_frames", "channels", "topic", "source", "rosafe_version", "axes"),
    *("pad", "clip"),
)
MAX_TEXT = 2**20  # characters of a text in a file
_TEXTS = {"source", "topic", "rosafe_version", "dtype", "options"}  # stored as they are; other texts are JSON


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
        options of the run, `clipped` (a number of samples, which may change until `ResultWriter.finish`),
        coordinates that are names, and, for formats that are written only, `options` (a digest of the options).
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

    def flat(self) -> dict[str, float | str]:
        """Return everything except arrays, as numbers and texts."""
        everything: dict[str, Any] = {**self.about, "axes": self.axes, "units": self.units}
        return {k: v if isinstance(v, (int, float)) or k in _TEXTS else json.dumps(v) for k, v in everything.items()}


def parse_metadata(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return `Contents.about` with axes and units from the output of `flat`, which may have numpy types.

    ValueError for values of other types than `flat` writes.
    """
    about: dict[str, Any] = {}
    for name, value in flat.items():
        value = value.item() if isinstance(value, (np.ndarray, np.generic)) else value
        about[name] = from_json(value) if isinstance(value, str) and name not in _TEXTS else value
    for name, (expected, fits) in _TYPES.items():
        if name in about and not fits(about[name]):
            raise ValueError(f"{name}: expected {expected}")
    for name in about.keys() & {"sample_rate", "block_frames", "clipped"}:
        about[name] = int(about[name]) if about[name] == int(about[name]) else float(about[name])
    if "axes" in about:
        about["axes"] = {name: tuple(axes) for name, axes in about["axes"].items()}
    return about


def from_json(text: str) -> Any:
    """Return the value of a JSON text; ValueError if it is longer than `MAX_TEXT` or invalid."""
    if len(text) > MAX_TEXT:
        raise ValueError(f"expected a text of at most {MAX_TEXT} characters, got {len(text)}")
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("a text is nested too deeply") from None


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


def sample_times(count: int, sample_rate: float) -> np.ndarray:
    """Return the time of each sample (s), as `rosafe.processing.signals.frame_times`."""
    return np.arange(count) / sample_rate
