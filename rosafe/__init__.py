"""rosAFE: the Two!Ears auditory front-end for ROS 1, in Python.

`rosafe.process` computes auditory representations of a signal in memory, `rosafe.plot` draws them; everything else is
reached through the nodes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rosafe.version import VERSION as __version__

__all__ = ["__version__", "load", "plot", "process"]

if TYPE_CHECKING:
    from rosafe.offline.formats import load
    from rosafe.offline.process import process
    from rosafe.view.plot import plot


def __getattr__(name: str) -> Any:
    # The numerics load numpy and scipy, which programs that only speak ROS need not wait for.
    if name == "process":
        from rosafe.offline.process import process

        return process
    if name == "load":
        from rosafe.offline.formats import load

        return load
    if name == "plot":
        from rosafe.view.plot import plot

        return plot
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
