"""Whether what is to be made fits into the memory, asked before it is made."""

from __future__ import annotations

import re
from pathlib import Path

from rosafe.offline.isolated import check_size
from rosafe.tree import sizes

_MEMINFO = Path("/proc/meminfo")


def available() -> int:
    """Bytes that this process can fill; what the machine has, where the system does not tell how much others hold."""
    try:
        found = re.search(r"^MemAvailable: +(\d+) kB", _MEMINFO.read_text(), re.MULTILINE)
    except OSError:  # a chroot without /proc, or another system
        found = None
    return min(sizes.machine_memory(), int(found[1]) * 1024) if found else sizes.machine_memory()


def refuse_over_available(taken: float, what: str, advice: str = "") -> None:
    """ValueError, with `advice`, where so many bytes are more than there are: the system would end the process."""
    text = f"{what} would take {{taken:.1f}} GB of memory, this machine has {{limit:.1f}} GB left{advice}"
    sizes.check_memory(available(), taken, text, 1e9)


def check_arrays(before: int, size: int, taken: float) -> None:
    """ValueError where arrays of `taken` bytes, after `before` bytes, are too large for a file of `size` bytes, or for
    the memory that is left."""
    check_size(before + taken, size)
    refuse_over_available(taken, "its arrays")
