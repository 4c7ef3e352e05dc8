"""How much memory signals and states take, and what of that is too much: asked before anything of that size is made."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable

from rosafe.dsp.framing import FramedStage
from rosafe.dsp.stage import Stage

MAX_BYTES = (
    2**30
)  # of one output port, of one processor's history, of the samples that it keeps for a frame, of a block
MAX_MEMORY_FRACTION = 0.5  # of the machine's memory, for output ports, histories and states of all processors together

Rows = tuple[int, ...]


def machine_memory() -> int:
    """Bytes that this machine has."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def size(rows: Rows, frames: float) -> float:
    """Bytes of so many frames."""
    return math.prod(rows, start=8.0 * frames)


def state_size(stage: Stage, rows: Rows) -> float:
    """Bytes of what `stage` keeps between blocks of leading shape `rows`."""
    return 8.0 * stage.state_size(rows)


def output_size(stage: Stage, rows: Rows, seconds: float) -> float:
    """Bytes of so many seconds of all that `stage` puts out, given blocks of leading shape `rows`."""
    return sum(size(part, seconds * stage.output_format.rate) for part in stage.part_rows(rows))


def check_memory(limit: float, taken: float, text: str, unit: float = 2**20) -> None:
    """ValueError where `taken` passes `limit`; `text` says so, with {taken} and {limit} in its place, in units."""
    if taken > limit:
        raise ValueError(text.format(taken=taken / unit, limit=limit / unit))


def check_stage(stage: Stage, rows: Rows, seconds: float) -> None:
    """ValueError where `seconds` of one stage's output, a frame of its input, or what it keeps, are too large."""
    for part in stage.part_rows(rows):
        _check_span("port or history", part, seconds, stage.output_format.rate)
    given = stage.input_format
    frames = (stage.output_format.window - given.window) / given.hop + 1
    name = f"{stage.prefix}_wSizeSec" if isinstance(stage, FramedStage) else "window"
    _check_span(name, rows, frames / given.rate, given.rate)
    shape = "x".join(map(str, rows))
    text = f"{stage.REPRESENTATION.kind}: what it keeps of {shape} values takes {{taken:.0f}} MiB"
    check_memory(MAX_BYTES, state_size(stage, rows), f"{text}, more than {{limit:.0f}} MiB")


def _check_span(what: str, rows: Rows, seconds: float, rate: float) -> None:
    span = f"{seconds:g} s of {'x'.join(map(str, rows))} values at {rate:g} Hz"
    text = f"{what}: {span} take {{taken:.0f}} MiB, more than {{limit:.0f}} MiB"
    check_memory(MAX_BYTES, size(rows, seconds * rate), text)


def check_all(stages: Iterable[tuple[Stage, Rows]], seconds: float) -> None:
    """ValueError where `seconds` of output of all stages together, and what they keep, would fill the memory."""
    sizes = [output_size(stage, rows, seconds) + state_size(stage, rows) for stage, rows in stages]
    text = f"{seconds:g} s of output of {len(sizes)} processors, and their states,"
    text = f"{text} take {{taken:.0f}} MiB, more than {{limit:.0f}} MiB"
    check_memory(
        MAX_MEMORY_FRACTION * machine_memory(),
        sum(sizes),
        f"{text}, which is {MAX_MEMORY_FRACTION:.0%} of this machine's memory",
    )
