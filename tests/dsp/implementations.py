"""Implementations that tests can select: kernels for each instruction set, other processors and clang, and numpy."""

from __future__ import annotations

import ctypes
import functools
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rosafe.dsp import kernels
from rosafe.dsp.kernels import build, loader

from . import foreign

NUMPY = 0
CLANG = "clang"  # its kernels for the highest level of this processor

Choice = int | str  # a level, CLANG, or one of `foreign.MACHINES`


@functools.cache
def _libraries() -> dict[int, Path]:
    """Return the kernels for this processor by level, ascending; none if they cannot be built."""
    try:
        paths = build.libraries()
    except build.BuildError:
        return {}
    highest = loader.load(paths[min(paths)]).rosafe_processor_level()
    return {level: path for level, path in paths.items() if level <= highest}


def levels() -> list[int]:
    """Return the levels of kernels for this processor, ascending; none if they cannot be built."""
    return list(_libraries())


@functools.cache
def _by_clang() -> ctypes.CDLL:
    if shutil.which("clang") is None:
        pytest.skip("no clang here: scripts/install --tests brings it")
    level, machine = levels()[-1], platform.machine()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "ISA_LEVELS", {machine: {level: build.ISA_LEVELS[machine][level]}})
        patch.setenv(build.COMPILER, "clang")
        return loader.load(build.libraries(build.place() / "clang")[level])


@contextmanager
def using(choice: Choice) -> Iterator[None]:
    """Make the stages use these kernels, or numpy."""
    loaded: tuple[Any, loader.Status] = (None, loader.Status(False, "numpy, for a test"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels.PinnedArray, "of", foreign.pin)
        if choice in foreign.MACHINES:
            elsewhere = foreign.running(str(choice))
            loaded = (elsewhere, loader.Status(True, f"{choice}, for a test"))
            patch.setattr(kernels, "_address", elsewhere.address)
        elif choice == CLANG:
            loaded = (_by_clang(), loader.Status(True, "clang's, for a test"))
        elif isinstance(choice, int) and choice != NUMPY:
            if choice not in levels():
                pytest.skip(f"no kernels of level {choice} here")
            loaded = (loader.load(_libraries()[choice]), loader.Status(True, f"level {choice}, for a test"))
        patch.setattr(kernels, "loaded", lambda: loaded)
        yield
