"""Checks that data will fit into the memory, made before anything of that size is allocated."""

from __future__ import annotations

import re
from pathlib import Path

from rosafe.results.isolated import check_size
from rosafe.tree import sizes

LESS = "close other programs, or use a machine with more memory"  # advice
_MEMINFO = Path("/proc/meminfo")


def available() -> int:
    """Return the bytes that this process can use; all of the machine's if the system does not report what is free."""
    try:
        found = re.search(r"^MemAvailable: +(\d+) kB", _MEMINFO.read_text(), re.MULTILINE)
    except OSError:  # a chroot without /proc, or another system
        found = None
    return min(sizes.machine_memory(), int(found[1]) * 1024) if found else sizes.machine_memory()


def refuse_over_available(size: float, name: str, advice: str) -> None:
    """Raise ValueError, with `advice`, if `size` bytes are more than available: the system would end the process."""
    sizes.check_memory(name, available(), size, advice, "free on this machine")


def check_arrays(before: int, file_size: int, size: float) -> None:
    """Raise ValueError if arrays of `size` bytes, after `before` bytes, are too large for the file or the memory."""
    check_size(before + size, file_size)
    refuse_over_available(size, "its arrays", LESS)
