"""Find and load the compiled library, or report why numpy and scipy are used instead."""

from __future__ import annotations

import ctypes
import functools
import os
from pathlib import Path
from typing import NamedTuple

from rosafe.dsp.kernels import build

# Environment variable: 0 for numpy and scipy, 2, 3... for at most this level of instruction set
KERNELS_VARIABLE = "ROSAFE_KERNELS"

INSTRUCTIONS = {2: "SSE4.2", 3: "AVX2 and FMA", 4: "AVX-512", 8: "NEON"}  # by level

_INTEGER, _REAL, _ARRAY, _BITS = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p, ctypes.c_uint32
_FRAMES = _CUES = ctypes.c_char_p  # `FRAMES`, packed: one argument is ten times as fast as one for each field
FRAMES = "PqqPqPqqqqPqqqq"  # for the module struct: `framed` of framed.h; P is an address
CUES = "qPPPPPPPPPqqq"  # for the module struct: `cues` of evidence.c
_ARGUMENTS = {
    "rosafe_gammatone": (_ARRAY, *[_INTEGER] * 4, *[_ARRAY] * 2, _INTEGER, _ARRAY, _INTEGER, _ARRAY),
    "rosafe_biquads": (_INTEGER, _ARRAY, _ARRAY, _INTEGER, _INTEGER, _ARRAY, _INTEGER, _ARRAY, _ARRAY, _INTEGER),
    "rosafe_adaptation": (_ARRAY, _INTEGER, _INTEGER, _REAL, *[_ARRAY, _INTEGER] * 2, _INTEGER, _ARRAY, _ARRAY),
    "rosafe_level_differences": (_FRAMES, _REAL, _ARRAY, _ARRAY),
    "rosafe_ratemap": (_FRAMES, _INTEGER, _REAL, _ARRAY, _ARRAY),
    "rosafe_modulation": (_FRAMES, _INTEGER, *[_ARRAY] * 3),
    "rosafe_gabor_responses": (_ARRAY, *[_INTEGER] * 4, _ARRAY, _INTEGER, _ARRAY, _ARRAY),
    "rosafe_concatenate": (_INTEGER, _ARRAY, _ARRAY, _INTEGER, _ARRAY, _INTEGER),
    "rosafe_mixture": (_INTEGER, _ARRAY, _INTEGER, _ARRAY, _ARRAY),
    "rosafe_add_evidence": (_CUES, _REAL, _ARRAY, _INTEGER, _ARRAY, _REAL, _ARRAY),
    "rosafe_unit_evidence": (_CUES, _REAL, _ARRAY, _INTEGER, _ARRAY, _INTEGER, _ARRAY),
    "rosafe_denormals_off": (),
    "rosafe_denormals_as": (_BITS,),
    "rosafe_correlations": (_FRAMES, _INTEGER, _REAL, _ARRAY, _INTEGER),
    "rosafe_spectral_features": (_ARRAY, _ARRAY, *[_INTEGER] * 3, _ARRAY, _REAL, _REAL, _ARRAY, _ARRAY),
    "rosafe_transient_map": (
        *(_ARRAY, _ARRAY, *[_INTEGER] * 7, _REAL, _REAL, _INTEGER, _INTEGER),
        *(_ARRAY, _INTEGER, *[_ARRAY] * 5),
    ),
    # clipping, alpha, exponent; points, twiddles, places, turns; corrections, lags; output
    "rosafe_autocorrelations": (_FRAMES, _INTEGER, _REAL, _REAL, _INTEGER, *[_ARRAY] * 4, _INTEGER, _ARRAY),
    "rosafe_windowed": (_FRAMES, *[_ARRAY] * 4),
    "rosafe_correlate_filtered": (*(_ARRAY, _INTEGER, _INTEGER, _ARRAY, _ARRAY) * 2, *[_INTEGER] * 6, *[_ARRAY] * 3),
    "rosafe_add_spectra": (_ARRAY, *[_INTEGER] * 3, _ARRAY, _ARRAY, _INTEGER, *[_ARRAY] * 5),
}


class Status(NamedTuple):
    """The implementation in use, and the reason."""

    compiled: bool
    detail: str

    def __str__(self) -> str:
        return self.detail


@functools.cache  # without a lock: two threads may both load it, with the same result
def loaded() -> tuple[ctypes.CDLL | None, Status]:
    """Return the library with its functions declared, or None; the result is fixed for this process.

    It takes a fraction of a millisecond, or a second if the library must be built first.
    """
    switch = os.environ.get(KERNELS_VARIABLE, "").strip()
    if switch == "0":
        return None, Status(False, f"numpy and scipy, because {KERNELS_VARIABLE} is 0")
    try:
        paths = build.libraries()
        lowest = min(paths)
        level = load(paths[lowest]).rosafe_processor_level()  # this function runs on any processor
        if level not in paths:
            raise build.BuildError(f"the kernels need a processor with {INSTRUCTIONS[lowest]} ({paths[lowest].stem})")
        reason = f"the processor has {INSTRUCTIONS[level]}"
        if switch not in ("", *map(str, paths)):
            choices = ", ".join(map(str, (0, *list(paths)[:-1])))
            reason += f" ({KERNELS_VARIABLE}: expected {choices} or {max(paths)}, got {switch[:20]!r}; it is ignored)"
        elif switch and int(switch) < level:
            level, reason = int(switch), f"{reason}, but {KERNELS_VARIABLE} is {switch}"
        path = paths[level]
        library = load(path)
        compiler = library.rosafe_compiler().decode().strip()
        return library, Status(True, f"compiled for {path.stem} by {compiler}: {reason}; {path}")
    except (build.BuildError, OSError) as problem:
        return None, Status(False, f"numpy and scipy: {problem}")


def load(path: Path) -> ctypes.CDLL:
    """Load a library and declare its functions."""
    library = ctypes.CDLL(str(path))  # releases the GIL during calls
    for name, arguments in _ARGUMENTS.items():
        function = getattr(library, name)
        function.argtypes, function.restype = arguments, None
    library.rosafe_denormals_off.restype = _BITS
    library.rosafe_compiler.restype = ctypes.c_char_p
    return library
