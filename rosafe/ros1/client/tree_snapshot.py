"""The processors of a running rosAFE at one moment, with the shapes, times and coordinates of their frames."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rosafe.audio.files.windows import MAX_RATE
from rosafe.interface import KINDS, Representation

MAX_SIZE = 2**20  # largest length along an axis
HOP_TOLERANCE = 1e-9  # relative, within which a hop is a whole number of samples


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

    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Return the shape of a frame of each part, without the ears."""
        return tuple(tuple(self.sizes(part).values()) for part in range(len(KINDS[self.kind].parts)))


class TreeSnapshot:
    """The processors of a component, by name."""

    def __init__(self, processors: Sequence[ProcessorInfo] = ()) -> None:
        self.processors = {processor.name: processor for processor in processors}

    @classmethod
    def of(cls, infos: Iterable[Mapping[str, Any]]) -> TreeSnapshot:
        """Return the tree from the structs of getProcessors; raise ValueError if one is not valid."""
        return cls([ProcessorInfo.of(info) for info in infos])

    @property
    def sample_rate(self) -> float:
        """Sample rate of the audio, Hz; 0 without an input."""
        return next((p.rate for p in self.processors.values() if p.kind == "input"), 0.0)

    def ancestors(self, processor: ProcessorInfo | None) -> Iterator[ProcessorInfo]:
        """Yield the processor, its parent, and so on up to the input."""
        while processor is not None:
            yield processor
            processor = self.processors.get(processor.parent)

    def grid(self, processor: ProcessorInfo) -> tuple[float, int]:
        """Return the hop of the frames of a processor, and their length if it is known, in audio frames."""
        hop = self.sample_rate / processor.rate
        whole = round(hop)
        if whole == 1:
            return 1, 1
        hop = whole if abs(hop - whole) < HOP_TOLERANCE * hop else hop
        for ancestor in self.ancestors(processor):
            for name, value in ancestor.values.items():
                if name.endswith("_wSizeSec"):
                    return hop, 2 * round(float(value) * self.sample_rate / 2)
        return hop, round(hop)

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
