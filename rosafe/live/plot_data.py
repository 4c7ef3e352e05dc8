"""What can be shown of a processor, and how its frames become the columns of a picture. No ROS in here."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rosafe.interface import KINDS, LAYOUTS, Representation
from rosafe.sound.windows import MAX_RATE
from rosafe.view.levels import LEVELS

COLUMNS = 100.0  # per second, at most
ROWS = 128  # of an ear, at most: more than the screen shows
FLOOR_POWER = 1e-20  # levels end there: -200 dB
MAX_SIZE = 2**20  # of an axis


@dataclass(frozen=True)
class ProcessorInfo:
    """A processor as getProcessors tells of it, its parameters as texts."""

    name: str
    kind: str
    parent: str
    topic: str
    rate: float  # of its frames, Hz
    shape: tuple[int, ...]
    values: Mapping[str, str] = field(hash=False)

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> ProcessorInfo:
        """Return a processor from the struct of getProcessors; ValueError if its numbers make no sense."""
        if not 0 <= told["rate"] <= MAX_RATE:
            raise ValueError(f"{told['name']}: expected a frame rate up to {MAX_RATE} Hz, got {told['rate']}")
        if max(told["shape"], default=0) > MAX_SIZE:
            raise ValueError(
                f"{told['name']}: expected a shape of at most {MAX_SIZE} along an axis, got {max(told['shape'])}"
            )
        return cls(
            told["name"],
            told["kind"],
            told["upperDepName"],
            told["topic"],
            float(told["rate"]),
            tuple(map(int, told["shape"])),
            {entry["name"]: entry["value"] for entry in told["parameters"]},
        )

    def sizes(self, part: int) -> dict[str, int]:
        """Return the sizes of the axes of a part, less ear and time; getProcessors has those of the largest part."""
        parts = KINDS[self.kind].parts
        largest = max(parts, key=lambda one: len(one.axes))
        known = dict(zip([axis for axis in largest.axes if axis != "time"], self.shape, strict=False))
        return {axis: known.get(axis, 1) for axis in parts[part].axes if axis not in ("ear", "time")}

    def output_shape(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of one frame of each field of its messages: of two axes, the second one is outermost."""
        places = [place for place in LAYOUTS[self.kind].places if place.present]
        sizes = [tuple(self.sizes(place.part).values()) for place in places]
        return {place.field: (*size[1:], *size[:1]) for place, size in zip(places, sizes, strict=True)}


class TreeSnapshot:
    """The processors of a component, by name."""

    def __init__(self, processors: Sequence[ProcessorInfo] = ()) -> None:
        self.processors = {processor.name: processor for processor in processors}

    @property
    def sample_rate(self) -> float:
        """Of the audio, Hz; 0 without an input."""
        return next((p.rate for p in self.processors.values() if p.kind == "input"), 0.0)

    def child(self, parent: str, kind: str) -> ProcessorInfo | None:
        """The first processor of `kind` that hangs on `parent`."""
        return next((p for p in self.processors.values() if p.parent == parent and p.kind == kind), None)

    def coordinates(self, processor: ProcessorInfo, axis: str, size: int) -> list[Any] | None:
        """What lies along an axis: Hz, s or words, as it or a processor above it declares; None where nobody does."""
        unit = {"channel": "Hz", "filter": "Hz", "lag": "s"}.get(axis, "")
        one: ProcessorInfo | None = processor
        while one is not None and one.kind in KINDS:
            kind = KINDS[one.kind]
            units = {p.name: p.unit for p in kind.parameters} | {d.name: d.unit for d in kind.derived}
            for name in kind.coordinates:
                values = _list(kind, name, one.values.get(name, ""))
                if units[name] == unit and len(values) == size:
                    return values
            one = self.processors.get(one.parent)
        return None


def _list(kind: Representation, name: str, text: str) -> list[Any]:
    try:
        return list(kind.parameter(name).parse(text))
    except KeyError:  # a derived one: numbers, as text_of writes them
        return list(json.loads(text or "[]"))
    except (ValueError, TypeError):
        return []


class PlotLayout:
    """One picture of a processor's output, and the way from the port's arrays to its columns.

    Parameters
    ----------
    tree : Tree
    processor : Processor
        Of a kind that is known here.
    part : int
        Which of the representation's arrays.
    row : int
        Which channel, of arrays that have lags or filters too, or which feature; -1 for the mean over the channels.

    Attributes
    ----------
    mode : str
        ``wave`` (two rows for each ear: the least and the greatest), ``line`` (one row for each ear) or ``heat``.
    group : int
        Frames in a column.
    rate : float
        Columns per second.
    rows, ears : int
        Of a column: all rows of the left ear from below, then those of the right one.
    """

    def __init__(self, tree: TreeSnapshot, processor: ProcessorInfo, part: int, row: int) -> None:
        kind = KINDS[processor.kind]
        if not 0 <= part < len(kind.parts):
            raise ValueError(f"{processor.name} has no part {part}")
        self.part, self.row = kind.parts[part], row
        self.processor, self.kind, self.index = processor, kind, part
        self.fields = [place.field for place in LAYOUTS[kind.kind].places if place.part == part and place.present]
        self.ears = 2 if "ear" in self.part.axes else 1
        named_sizes = processor.sizes(part)
        axes, sizes = list(named_sizes), list(named_sizes.values())
        named = axes == ["feature"] and bool(kind.features or kind.coordinates)
        self.group = max(1, math.ceil(processor.rate / COLUMNS - 1e-9))
        self.rate = processor.rate / self.group
        self.decibels = LEVELS.get(kind.kind, 0.0)
        if kind.kind == "ratemap" and processor.values.get("rm_scaling") == "magnitude":
            self.decibels *= 2
        self.choices: list[Any] = []  # of `row`
        self.along: list[Any] = []  # what the rows of an ear are
        self.axis = ""
        if not axes:
            self.mode, self.rows = "wave", 2
        elif named:
            self.mode, self.rows = "line", 1
            self.choices = list(kind.features) or tree.coordinates(processor, "feature", sizes[0]) or []
            self.row = row if 0 <= row < sizes[0] else 0
            self.decibels = 0.0
        else:
            self.mode, self.axis = "heat", axes[-1]
            if len(axes) > 1:
                self.choices = tree.coordinates(processor, axes[0], sizes[0]) or list(range(sizes[0]))
                self.row = row if 0 <= row < sizes[0] else -1
            labels = tree.coordinates(processor, axes[-1], sizes[-1]) or list(range(sizes[-1]))
            self.bundle = max(1, math.ceil(sizes[-1] / ROWS))
            self.rows = math.ceil(sizes[-1] / self.bundle)
            starts = range(0, sizes[-1], self.bundle)
            self.along = [_middle(labels[first : first + self.bundle]) for first in starts]

    def describe(self) -> dict[str, Any]:
        """What the page needs to draw it."""
        return {
            "name": self.processor.name,
            "kind": self.kind.kind,
            "doc": self.kind.doc,
            "part": self.index,
            "partName": self.part.name,
            "mode": self.mode,
            "axis": self.axis,
            "along": self.along,
            "choices": self.choices,
            "row": self.row,
            "ears": self.ears,
            "rows": self.rows,
            "rate": self.rate,
            "unit": "dB" if self.decibels else self.part.unit,
            "level": bool(self.decibels),
        }

    @property
    def size(self) -> int:
        """Numbers in a column."""
        return self.ears * self.rows

    # --- frames to columns ---

    def columns(self, arrays: Sequence[np.ndarray]) -> np.ndarray:
        """Whole columns (size, n), float32, of frames (..., n * group) of each field."""
        return np.concatenate([self._of_ear(array) for array in arrays]).astype(np.float32)

    def _of_ear(self, array: np.ndarray) -> np.ndarray:
        frames = array.shape[-1]
        if self.mode == "wave":
            grouped = array.reshape(frames // self.group, self.group)
            return np.stack((grouped.min(axis=1), grouped.max(axis=1)))
        if self.mode == "line":
            return array[self.row : self.row + 1, self.group - 1 :: self.group]
        if array.ndim == 3:  # (lag or filter, channel, frame)
            array = array.mean(axis=1) if self.row < 0 else array[:, self.row]
        if self.group > 1:
            grouped = array.reshape(len(array), frames // self.group, self.group)
            if self.decibels == 20.0:  # amplitudes: the level of the column's mean power
                array = np.sqrt(np.einsum("rcg,rcg->rc", grouped, grouped) / self.group)
            else:
                array = grouped.mean(axis=2)
        if self.bundle > 1:
            starts = np.arange(0, len(array), self.bundle)
            array = np.add.reduceat(array, starts, axis=0)
            array /= np.diff([*starts, starts[-1] + self.bundle])[:, np.newaxis]
        if self.decibels:
            floor = FLOOR_POWER ** (10.0 / self.decibels)
            array = self.decibels * np.log10(np.maximum(np.abs(array), floor))
        return array


def _middle(labels: Sequence[Any]) -> Any:
    if isinstance(labels[0], str):
        return labels[0]
    return float(np.mean(labels))


# --- columns to bytes ---


def quantize(columns: np.ndarray) -> tuple[float, float, bytes]:
    """The least and the greatest value, and a byte for each number, column by column: 0 to 254 between these two.

    255 is none (NaN).
    """
    finite = np.isfinite(columns)
    if not finite.any():
        return 0.0, 0.0, np.full(columns.shape, 255, np.uint8).tobytes()
    low = float(np.min(columns, where=finite, initial=np.inf))
    high = float(np.max(columns, where=finite, initial=-np.inf))
    scale = 254.0 / (high - low) if high > low else 0.0
    steps = np.where(finite, np.rint((columns - low) * scale), 255.0)
    return low, high, np.ascontiguousarray(steps.T.astype(np.uint8)).tobytes()
