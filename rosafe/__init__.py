"""rosAFE: the Two!Ears auditory front-end for ROS 1, in Python.

`process` computes auditory representations of a signal in memory, `Stream` those of sound that arrives block by block.
`plot` draws them, `to_xarray` converts them to an xarray Dataset, and `load` reads result files. `to_db` and `deltas`
compute features from them, `process_batch` processes several sounds, and `PRESETS` are parameters for a purpose.
`resynthesize` and `Resynthesizer` return from the filterbank to sound; `enhance` selects the sound from a direction.
docs/tutorial.md begins with a sound file.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from rosafe.system.version import VERSION as __version__

__all__ = [
    "PRESETS",
    "Head",
    "Localizer",
    "Result",
    "Resynthesizer",
    "Stream",
    "__version__",
    "deltas",
    "direction_mask",
    "enhance",
    "load",
    "localize",
    "plot",
    "process",
    "process_batch",
    "resynthesize",
    "to_db",
    "to_xarray",
]

if TYPE_CHECKING:
    from rosafe.interface.remarks import PRESETS
    from rosafe.localization.enhancement import direction_mask, enhance
    from rosafe.localization.head import Head
    from rosafe.localization.localize import localize
    from rosafe.localization.localizer import Localizer
    from rosafe.processing.features import deltas, process_batch, to_db
    from rosafe.processing.process import process
    from rosafe.processing.resynthesis import Resynthesizer, resynthesize
    from rosafe.processing.stream import Stream
    from rosafe.results.readers import load
    from rosafe.results.result import Result
    from rosafe.view.dataset import to_xarray
    from rosafe.view.plot import plot

# Imported on first use: programs that need only ROS do not wait for numpy and scipy.
_MODULES = {
    "Head": "rosafe.localization.head",
    "Localizer": "rosafe.localization.localizer",
    "PRESETS": "rosafe.interface.remarks",
    "Result": "rosafe.results.result",
    "Resynthesizer": "rosafe.processing.resynthesis",
    "Stream": "rosafe.processing.stream",
    "deltas": "rosafe.processing.features",
    "direction_mask": "rosafe.localization.enhancement",
    "enhance": "rosafe.localization.enhancement",
    "load": "rosafe.results.readers",
    "localize": "rosafe.localization.localize",
    "plot": "rosafe.view.plot",
    "process": "rosafe.processing.process",
    "process_batch": "rosafe.processing.features",
    "resynthesize": "rosafe.processing.resynthesis",
    "to_db": "rosafe.processing.features",
    "to_xarray": "rosafe.view.dataset",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({"__doc__", *__all__})
