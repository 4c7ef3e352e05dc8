"""The memory that signals and states take, and its limits, which are checked before the memory is allocated."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Collection
from pathlib import Path

from rosafe.dsp.framing import FramedStage
from rosafe.dsp.stage import Stage

MAX_BYTES = 2**30  # of a port, of a processor's history, of its state, of the samples that it keeps for a frame
MAX_MEMORY_FRACTION = 0.5  # of the machine's memory, for ports, histories and states of all processors together
_MEMINFO = Path("/proc/meminfo")

Rows = tuple[int, ...]  # leading shape of blocks


def machine_memory() -> int:
    """Return the size of this machine's memory in bytes."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def available_memory() -> int:
    """Return the bytes that are free for this process, or those of the machine if /proc does not report them."""
    try:
        found = re.search(r"^MemAvailable: +(\d+) kB", _MEMINFO.read_text(), re.MULTILINE)
    except OSError:  # a chroot without /proc, or another system
        found = None
    return min(machine_memory(), int(found[1]) * 1024) if found else machine_memory()


def size(rows: Rows, frames: float) -> float:
    """Return the bytes of `frames` frames."""
    return math.prod(rows, start=8.0 * frames)


def state_size(stage: Stage, rows: Rows) -> float:
    """Return the bytes that `stage` keeps between blocks of leading shape `rows`."""
    return 8.0 * stage.state_size(rows)


def output_size(stage: Stage, rows: Rows, seconds: float) -> float:
    """Return the bytes of `seconds` of the output of `stage` for blocks of leading shape `rows`."""
    return sum(size(part, seconds * stage.output_format.rate) for part in stage.part_rows(rows))


def check_memory(name: str, limit: float, taken: float, advice: str, whose: str = "", content: str = "") -> None:
    """Raise ValueError with `advice` if the bytes `taken` by the `content` of `name` exceed `limit`.

    `whose` names the memory of which `limit` is a part.
    """
    if taken > limit:
        expected, got = (f"{n / 2**20:.{0 if n >= 2**20 else 2}f} MiB" for n in (limit, taken))
        whose, content = whose and f" ({whose})", content and f" for {content}"
        raise ValueError(f"{name}: expected at most {expected}{whose}, got {got}{content}; {advice}")


def refuse_over_available(size: float, name: str, advice: str) -> None:
    """Raise ValueError, with `advice`, if `size` bytes are more than available: the system would end the process."""
    check_memory(name, available_memory(), size, advice, "free on this machine")


def check_stage(stage: Stage, rows: Rows, seconds: float) -> None:
    """Raise ValueError if `seconds` of a stage's output, a frame of its input, or its state is too large."""
    for part in stage.part_rows(rows):
        _check_signal("port or history", part, seconds, stage.output_format.rate, "shorter buffers")
    source = stage.input_format
    frames = (stage.output_format.window - source.window) / source.hop + 1
    name = f"{stage.prefix}_wSizeSec" if isinstance(stage, FramedStage) else "window"
    _check_signal(name, rows, frames / source.rate, source.rate, "a shorter window")
    content = f"the state of {_shape(rows)} values"
    name = stage.REPRESENTATION.kind
    check_memory(name, MAX_BYTES, state_size(stage, rows), "take fewer channels", content=content)


def _check_signal(name: str, rows: Rows, seconds: float, rate: float, advice: str) -> None:
    content = f"{seconds:g} s of {_shape(rows)} values at {rate:g} Hz"
    taken = size(rows, seconds * rate)
    check_memory(name, MAX_BYTES, taken, f"take {advice}, or fewer channels", content=content)


def _shape(rows: Rows) -> str:
    return "x".join(map(str, rows))


def total_size(stage: Stage, rows: Rows, seconds: float) -> float:
    """Return the bytes of `seconds` of the output of `stage` and of its state."""
    return output_size(stage, rows, seconds) + state_size(stage, rows)


def check_all(taken: Collection[float], seconds: float) -> None:
    """Raise ValueError if the bytes `taken` by all processors, for each its `total_size`, exceed their share."""
    check_memory(
        f"{len(taken)} processors",
        MAX_MEMORY_FRACTION * machine_memory(),
        sum(taken),
        "remove processors, or take shorter buffers",
        f"{MAX_MEMORY_FRACTION:.0%} of this machine's memory",
        f"{seconds:g} s of output, and the states",
    )
