"""What a file of results holds, whatever its format."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

# what tells runs apart
ABOUT = ("parameters", "sample_rate", "block_frames", "channels", "topic", "source", "rosafe_version", "axes")
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


class Writer(Protocol):
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


def told(flat: Mapping[str, Any]) -> dict[str, Any]:
    """`Contents.about`, with axes and units, from what `flat` has made of it, numpy's types included."""
    about: dict[str, Any] = {}
    for name, value in flat.items():
        value = value.item() if isinstance(value, (np.ndarray, np.generic)) else value
        if isinstance(value, bytes):
            value = value.decode()
        if isinstance(value, float) and name in ("sample_rate", "block_frames"):
            value = int(value)
        about[name] = json.loads(value) if isinstance(value, str) and name not in _TEXTS else value
    if "axes" in about:
        about["axes"] = {name: tuple(axes) for name, axes in about["axes"].items()}
    return about


def sample_times(count: int, sample_rate: float) -> np.ndarray:
    """When each sample is (s), as `rosafe.offline.signals.frame_times` tells it."""
    return np.arange(count) / sample_rate


def is_scalar(name: str) -> bool:
    """Whether this is a single number, in formats that cannot tell it from a vector of one."""
    return name in ("sample_rate", "block_frames") or name.endswith("_frameRate")
