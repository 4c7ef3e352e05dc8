"""Settings of the C library's allocator, which limit the memory of many threads that allocate blocks of all sizes."""

from __future__ import annotations

import ctypes

_SETTINGS = {  # by the parameter of mallopt, from malloc.h of glibc
    -8: 2,  # M_ARENA_MAX: pools of the allocator; by default there are eight per core, and each becomes fragmented
    -3: 8 * 2**20,  # M_MMAP_THRESHOLD: larger blocks return to the system when freed; default blocks have 6 MB
    -1: 64 * 2**20,  # M_TRIM_THRESHOLD: free memory at the end of a pool that is kept for the next block
}


def limit_arenas() -> None:
    """Apply the settings; called before threads are started. A C library without these settings is not changed."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for parameter, value in _SETTINGS.items():
            mallopt(parameter, value)


def trim() -> None:
    """Return free memory to the system, including gaps between blocks."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
