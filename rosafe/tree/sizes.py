"""The memory that signals and states take, and its limits, which are checked before the memory is allocated."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable

from rosafe.dsp.framing import FramedStage
from rosafe.dsp.stage import Stage

MAX_BYTES = 2**30  # of a port, of a processor's history, of its state, of the samples that it keeps for a frame
MAX_MEMORY_FRACTION = 0.5  # of the machine's memory, for ports, histories and states of all processors together

Rows = tuple[int, ...]  # leading shape of blocks


def machine_memory() -> int:
    """Return the size of this machine's memory in bytes."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def size(rows: Rows, frames: float) -> float:
    """Return the bytes of `frames` frames."""
    return math.prod(rows, start=8.0 * frames)


def state_size(stage: Stage, rows: Rows) -> float:
    """Return the bytes that `stage` keeps between blocks of leading shape `rows`."""
    return 8.0 * stage.state_size(rows)


def output_size(stage: Stage, rows: Rows, seconds: float) -> float:
    """Return the bytes of `seconds` of the output of `stage` for blocks of leading shape `rows`."""
    return sum(size(part, seconds * stage.output_format.rate) for part in stage.part_rows(rows))


def check_memory(limit: float, taken: float, text: str, unit: float = 2**20) -> None:
    """Raise ValueError if `taken` exceeds `limit` (bytes). `text` has the fields {taken} and {limit}, in units."""
    if taken > limit:
        raise ValueError(text.format(taken=taken / unit, limit=limit / unit))


def check_stage(stage: Stage, rows: Rows, seconds: float) -> None:
    """Raise ValueError if `seconds` of a stage's output, a frame of its input, or its state is too large."""
    for part in stage.part_rows(rows):
        _check_signal("port or history", part, seconds, stage.output_format.rate)
    source = stage.input_format
    frames = (stage.output_format.window - source.window) / source.hop + 1
    name = f"{stage.prefix}_wSizeSec" if isinstance(stage, FramedStage) else "window"
    _check_signal(name, rows, frames / source.rate, source.rate)
    text = f"{stage.REPRESENTATION.kind}: the state for {_shape(rows)} values takes {{taken:.0f}} MiB"
    check_memory(MAX_BYTES, state_size(stage, rows), f"{text}, more than {{limit:.0f}} MiB")


def _check_signal(name: str, rows: Rows, seconds: float, rate: float) -> None:
    text = f"{name}: {seconds:g} s of {_shape(rows)} values at {rate:g} Hz take {{taken:.0f}} MiB"
    check_memory(MAX_BYTES, size(rows, seconds * rate), f"{text}, more than {{limit:.0f}} MiB")


def _shape(rows: Rows) -> str:
    return "x".join(map(str, rows))


def check_all(stages: Iterable[tuple[Stage, Rows]], seconds: float) -> None:
    """Raise ValueError if `seconds` of output and the states of all stages exceed their share of the memory."""
    sizes = [output_size(stage, rows, seconds) + state_size(stage, rows) for stage, rows in stages]
    text = (
        f"{seconds:g} s of output of {len(sizes)} processors, and their states, take {{taken:.0f}} MiB, more than "
        f"{{limit:.0f}} MiB, which is {MAX_MEMORY_FRACTION:.0%} of this machine's memory"
    )
    check_memory(MAX_MEMORY_FRACTION * machine_memory(), sum(sizes), text)
