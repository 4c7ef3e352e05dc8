"""The plots of a processor, and the reduction of its frames to the columns of a plot. Independent of ROS."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rosafe.audio.files.windows import MAX_RATE
from rosafe.interface import KINDS, LAYOUTS, Representation

MAX_COLUMN_RATE = 100.0  # columns per second
MAX_ROWS = 128  # of an ear: more than the screen shows
FLOOR_POWER = 1e-20  # the lowest level: -200 dB
MAX_SIZE = 2**20  # of an axis


@dataclass(frozen=True)
class ProcessorInfo:
    """A processor as listed by getProcessors; the values of its parameters are texts."""

    name: str
    kind: str
    parent: str
    topic: str
    rate: float  # of its frames, Hz
    shape: tuple[int, ...]
    values: Mapping[str, str] = field(hash=False)

    @classmethod
    def of(cls, info: Mapping[str, Any]) -> ProcessorInfo:
        """Return a processor from the struct of getProcessors; raise ValueError if its rate or shape is not valid."""
        name, rate, shape = info["name"], info["rate"], info["shape"]
        if not 0 <= rate <= MAX_RATE:
            raise ValueError(f"{name}: expected a frame rate up to {MAX_RATE} Hz, got {rate}")
        if max(shape, default=0) > MAX_SIZE:
            raise ValueError(f"{name}: expected a shape of at most {MAX_SIZE} along an axis, got {max(shape)}")
        values = {entry["name"]: entry["value"] for entry in info["parameters"]}
        return cls(name, info["kind"], info["upperDepName"], info["topic"], float(rate), tuple(map(int, shape)), values)

    def sizes(self, part: int) -> dict[str, int]:
        """Return the sizes of the axes of a part except ear and time; getProcessors lists those of the largest part."""
        parts = KINDS[self.kind].parts
        largest = max(parts, key=lambda part: len(part.axes))
        known = dict(zip([axis for axis in largest.axes if axis != "time"], self.shape, strict=False))
        return {axis: known.get(axis, 1) for axis in parts[part].axes if axis not in ("ear", "time")}

    def output_shape(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of one frame of each field of its messages. Of two axes, the second one is first."""
        places = [place for place in LAYOUTS[self.kind].places if place.present]
        sizes = [tuple(self.sizes(place.part).values()) for place in places]
        return {place.field: (*size[1:], *size[:1]) for place, size in zip(places, sizes, strict=True)}


class TreeSnapshot:
    """The processors of a component, by name."""

    def __init__(self, processors: Sequence[ProcessorInfo] = ()) -> None:
        self.processors = {processor.name: processor for processor in processors}

    @property
    def sample_rate(self) -> float:
        """Sample rate of the audio, Hz; 0 without an input."""
        return next((p.rate for p in self.processors.values() if p.kind == "input"), 0.0)

    def ancestors(self, processor: ProcessorInfo | None) -> Iterator[ProcessorInfo]:
        """Yield the processor, its parent, and so on up to the input."""
        while processor is not None:
            yield processor
            processor = self.processors.get(processor.parent)

    def coordinates(self, processor: ProcessorInfo, axis: str, size: int) -> list[Any]:
        """Return the coordinates along an axis (Hz, s or texts).

        They are declared by the processor or by an ancestor; without a declaration, the result is empty.
        """
        unit = {"channel": "Hz", "filter": "Hz", "lag": "s"}.get(axis, "")
        for ancestor in self.ancestors(processor):
            kind = KINDS.get(ancestor.kind)
            if kind is None:
                break
            for name in kind.coordinates:
                values = _parse_list(kind, name, ancestor.values.get(name, ""))
                if kind.units[name] == unit and len(values) == size:
                    return values
        return []


def _parse_list(kind: Representation, name: str, text: str) -> list[Any]:
    try:
        return list(kind.parameter(name).parse(text))
    except KeyError:  # a derived value: numbers, as written by text_of
        return list(json.loads(text or "[]"))
    except (ValueError, TypeError):
        return []


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
        self._processor, self._index, self._row = processor, part, row
        self.fields = [place.field for place in LAYOUTS[kind.kind].places if place.part == part and place.present]
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
        part = kind.parts[self._index]
        return {
            "name": self._processor.name,
            "kind": kind.kind,
            "doc": kind.doc,
            "part": self._index,
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

    def columns(self, arrays: Sequence[np.ndarray]) -> np.ndarray:
        """Return columns (size, n), float32, of the frames (..., n * group) of each field."""
        return np.concatenate([self._reduce(array) for array in arrays]).astype(np.float32)

    def _reduce(self, array: np.ndarray) -> np.ndarray:
        frames = array.shape[-1]
        if self.mode == "wave":
            grouped = array.reshape(frames // self.group, self.group)
            return np.stack((grouped.min(axis=1), grouped.max(axis=1)))
        if self.mode == "line":
            return array[self._row : self._row + 1, self.group - 1 :: self.group]
        if array.ndim == 3:  # (lag or filter, channel, frame)
            array = array.mean(axis=1) if self._row < 0 else array[:, self._row]
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
