"""rosAFE: the Two!Ears auditory front-end for ROS 1, in Python.

For arrays and pictures: `process` computes auditory representations of a signal in memory, `Stream` of sound that comes
block by block; `plot` draws them, `to_xarray` names their axes; `load` reads what `rosafe process` has written.
docs/tutorial.md begins with a sound file.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from rosafe.version import VERSION as __version__

__all__ = ["Stream", "__version__", "load", "plot", "process", "to_xarray"]

if TYPE_CHECKING:
    from rosafe.offline.formats import load
    from rosafe.offline.process import process
    from rosafe.offline.stream import Stream
    from rosafe.view.dataset import to_xarray
    from rosafe.view.plot import plot

# The numerics load numpy and scipy, which programs that only speak ROS need not wait for.
_WHERE = {
    "Stream": "rosafe.offline.stream",
    "load": "rosafe.offline.formats",
    "plot": "rosafe.view.plot",
    "process": "rosafe.offline.process",
    "to_xarray": "rosafe.view.dataset",
}


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(_WHERE[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({"__doc__", *__all__})
