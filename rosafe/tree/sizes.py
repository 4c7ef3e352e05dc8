"""How much memory signals take, and what of that is too much: asked before anything of that size is made."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable

from rosafe.dsp.framing import FramedStage
from rosafe.dsp.stage import Stage

MAX_BYTES = (
    2**30
)  # of one output port, of one processor's history, of the samples that it keeps for a frame, of a block
SHARE = 0.5  # of the machine's memory, for the output ports and histories of all processors together

Rows = tuple[int, ...]


def machine_memory() -> int:
    """Bytes that this machine has."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def size(rows: Rows, frames: float) -> float:
    """Bytes of so many frames."""
    return math.prod(rows, start=8.0 * frames)


def output_size(stage: Stage, rows: Rows, seconds: float) -> float:
    """Bytes of so many seconds of all that `stage` puts out, given blocks of leading shape `rows`."""
    return sum(size(part, seconds * stage.output.rate) for part in stage.part_rows(rows))


def refuse_over(limit: float, taken: float, what: str, whose: str = "") -> None:
    """ValueError where what is `taken` passes the limit."""
    if taken > limit:
        raise ValueError(f"{what} take {taken / 2**20:.0f} MiB, more than {limit / 2**20:.0f} MiB{whose}")


def check_stage(stage: Stage, rows: Rows, seconds: float) -> None:
    """ValueError where `seconds` of one stage's output, or what it keeps of its input for a frame, are too large."""
    for part in stage.part_rows(rows):
        rate = stage.output.rate
        refuse_over(
            MAX_BYTES, size(part, seconds * rate), f"port or history: {seconds:g} s of {_shape(part)} at {rate:g} Hz"
        )
    given = stage.given
    frames = (stage.output.window - given.window) / given.hop + 1
    name = f"{stage.PREFIX}_wSizeSec" if isinstance(stage, FramedStage) else "window"
    what = f"{name}: {frames / given.rate:g} s of {_shape(rows)} at {given.rate:g} Hz"
    refuse_over(MAX_BYTES, size(rows, frames), what)


def _shape(rows: Rows) -> str:
    return f"{'x'.join(map(str, rows))} values"


def check_all(stages: Iterable[tuple[Stage, Rows]], seconds: float) -> None:
    """ValueError where `seconds` of output of all stages together would fill the machine's memory."""
    sizes = [output_size(stage, rows, seconds) for stage, rows in stages]
    what = f"{seconds:g} s of output of {len(sizes)} processors"
    refuse_over(SHARE * machine_memory(), sum(sizes), what, f", which is {SHARE:.0%} of this machine's memory")
