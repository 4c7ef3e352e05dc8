"""The kernels for each level of processor, and their numpy and scipy twins, to be chosen by tests."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from rosafe.dsp import kernels
from rosafe.dsp.kernels import build, library

TWINS = 0


def levels() -> list[int]:
    """The levels of kernels that run here, ascending; none where they cannot be built."""
    try:
        paths = build.libraries()
    except build.BuildError:
        return []
    return [level for level in paths if level <= library.load(paths[3]).rosafe_processor_level()]


@contextmanager
def using(level: int) -> Iterator[None]:
    """Within this, the stages run on the kernels of this level, or on the twins."""
    loaded: tuple[ctypes.CDLL | None, library.Status] = (None, library.Status(False, "the twins, for a test"))
    if level != TWINS:
        if level not in levels():
            pytest.skip(f"no kernels of level {level} here")
        loaded = (library.load(build.libraries()[level]), library.Status(True, f"level {level}, for a test"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "loaded", lambda: loaded)
        yield
