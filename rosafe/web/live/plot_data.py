"""The plots of a processor, and the reduction of its frames to the columns of a plot. Independent of ROS."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rosafe.interface import KINDS
from rosafe.ros1.client.tree_snapshot import ProcessorInfo, TreeSnapshot

MAX_COLUMN_RATE = 100.0  # columns per second
MAX_ROWS = 128  # of an ear: more than the screen shows
FLOOR_POWER = 1e-20  # the lowest level: -200 dB


class PlotLayout:
    """The plot of one part of a processor's output, and the reduction of frames to its columns.

    Parameters
    ----------
    tree : TreeSnapshot
    processor : ProcessorInfo
        Its kind must be known here.
    part : int
        Index of the part of the representation.
    row : int
        The channel, if there are lags or filters as well, or the feature; -1 for the mean over the channels.

    Attributes
    ----------
    part : int
    mode : str
        ``wave`` (two rows for each ear: minimum and maximum), ``line`` (one row for each ear) or ``heat``.
    group : int
        Frames in a column.
    rate : float
        Columns per second.
    rows, ears : int
        Shape of a column: all rows of the left ear from the lowest, then those of the right ear.
    """

    def __init__(self, tree: TreeSnapshot, processor: ProcessorInfo, part: int, row: int) -> None:
        kind = KINDS[processor.kind]
        if not 0 <= part < len(kind.parts):
            raise ValueError(f"{processor.name} has no part {part}")
        self._processor, self.part, self._row = processor, part, row
        self.ears = 2 if "ear" in kind.parts[part].axes else 1
        self.group = max(1, math.ceil(processor.rate / MAX_COLUMN_RATE - 1e-9))
        self.rate = processor.rate / self.group
        self._decibels = kind.decibels(processor.values)
        self._bundle = 1  # rows of the output in one row of the plot
        self._axis = ""  # of the rows of an ear
        self._labels: list[Any] = []  # of these rows
        self._choices: list[Any] = []  # labels of the values of `row`
        sizes = processor.sizes(part)
        if not sizes:
            self.mode, self.rows = "wave", 2
        elif [*sizes] == ["feature"] and (kind.features or kind.coordinates):
            self.mode, self.rows = "line", 1
            self._choices = list(kind.features) or tree.coordinates(processor, "feature", sizes["feature"])
            self._row = row if 0 <= row < sizes["feature"] else 0
            self._decibels = 0.0
        else:
            self.mode, self.rows = "heat", self._set_rows(tree, sizes, row)

    def _set_rows(self, tree: TreeSnapshot, sizes: Mapping[str, int], row: int) -> int:
        """Set axis and labels of the rows of an ear, and the choices of the other axis; return the number of rows."""

        def labels(axis: str) -> list[Any]:
            return tree.coordinates(self._processor, axis, sizes[axis]) or list(range(sizes[axis]))

        *others, self._axis = sizes
        for axis in others:  # at most one
            self._choices = labels(axis)
            self._row = row if 0 <= row < sizes[axis] else -1
        size, coordinates = sizes[self._axis], labels(self._axis)
        self._bundle = max(1, math.ceil(size / MAX_ROWS))
        self._labels = [_mean_label(coordinates[at : at + self._bundle]) for at in range(0, size, self._bundle)]
        return len(self._labels)

    def describe(self) -> dict[str, Any]:
        """Return the description of the plot for the page."""
        kind = KINDS[self._processor.kind]
        part = kind.parts[self.part]
        return {
            "name": self._processor.name,
            "kind": kind.kind,
            "doc": kind.doc,
            "part": self.part,
            "partName": part.name,
            "mode": self.mode,
            "axis": self._axis,
            "along": self._labels,
            "choices": self._choices,
            "row": self._row,
            "ears": self.ears,
            "rows": self.rows,
            "rate": self.rate,
            "unit": "dB" if self._decibels else part.unit,
            "level": bool(self._decibels),
        }

    @property
    def size(self) -> int:
        """Numbers in a column."""
        return self.ears * self.rows

    # --- frames to columns ---

    def columns(self, frames: np.ndarray) -> np.ndarray:
        """Return columns (size, n), float32, of frames (..., n * group) with the axes of the part."""
        ears = frames if self.ears == 2 else [frames]
        return np.concatenate([self._reduce(ear) for ear in ears]).astype(np.float32)

    def _reduce(self, array: np.ndarray) -> np.ndarray:
        frames = array.shape[-1]
        if self.mode == "wave":
            grouped = array.reshape(frames // self.group, self.group)
            return np.stack((grouped.min(axis=1), grouped.max(axis=1)))
        if self.mode == "line":
            return array[self._row : self._row + 1, self.group - 1 :: self.group]
        if array.ndim == 3:  # (channel, lag or filter, frame)
            array = array.mean(axis=0) if self._row < 0 else array[self._row]
        if self.group > 1:
            grouped = array.reshape(len(array), frames // self.group, self.group)
            if self._decibels == 20.0:  # amplitudes: the level of the mean power in the column
                array = np.sqrt(np.einsum("rcg,rcg->rc", grouped, grouped) / self.group)
            else:
                array = grouped.mean(axis=2)
        if self._bundle > 1:
            starts = np.arange(0, len(array), self._bundle)
            array = np.add.reduceat(array, starts, axis=0)
            array /= np.diff([*starts, starts[-1] + self._bundle])[:, np.newaxis]
        if self._decibels:
            floor = FLOOR_POWER ** (10.0 / self._decibels)
            array = self._decibels * np.log10(np.maximum(np.abs(array), floor))
        return array


def _mean_label(labels: Sequence[Any]) -> Any:
    return labels[0] if isinstance(labels[0], str) else float(np.mean(labels))


# --- columns to bytes ---


def quantize(columns: np.ndarray) -> tuple[float, float, bytes]:
    """Return the minimum, the maximum, and a byte for each number, column by column.

    The bytes 0 and 254 stand for the minimum and the maximum, 255 for NaN.
    """
    finite = np.isfinite(columns)
    if not finite.any():
        return 0.0, 0.0, np.full(columns.shape, 255, np.uint8).tobytes()
    low = float(np.min(columns, where=finite, initial=np.inf))
    high = float(np.max(columns, where=finite, initial=-np.inf))
    scale = 254.0 / (high - low) if high > low else 0.0
    steps = np.where(finite, np.rint((columns - low) * scale), 255.0)
    return low, high, np.ascontiguousarray(steps.T.astype(np.uint8)).tobytes()
