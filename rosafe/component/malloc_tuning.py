"""The C library's memory: kept from growing where many threads take and free blocks of all sizes."""

from __future__ import annotations

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # malloc.h of glibc
ARENAS = 2  # pools that threads take memory from; glibc makes eight for each core, and each keeps holes of its own
LARGE = 8 * 2**20  # bytes; what is larger goes back to the system when it is freed. Blocks by default are 6 MB
KEPT = 64 * 2**20  # bytes of free memory at a pool's end that are kept for the next block


def limit_arenas() -> None:
    """Settle this before there are threads. A C library without such settings is left as it is."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for setting, value in ((_M_ARENA_MAX, ARENAS), (_M_MMAP_THRESHOLD, LARGE), (_M_TRIM_THRESHOLD, KEPT)):
            mallopt(setting, value)


def trim() -> None:
    """Return to the system what is free, holes included."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
