"""rosAFE: the Two!Ears auditory front-end for ROS 1, in Python.

`process` computes auditory representations of a signal in memory, `Stream` those of sound that arrives block by block.
`plot` draws them, `to_xarray` converts them to an xarray Dataset, and `load` reads result files. `to_db` and `deltas`
compute features from them, `process_batch` processes several sounds, and `PRESETS` are parameters for a purpose.
`resynthesize` and `Resynthesizer` return from the filterbank to sound; `enhance` selects the sound from a direction.
Each representation, also of a plugin, has a function of its name, such as `ratemap`, which returns one array.
docs/tutorial.md begins with a sound file.
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from rosafe.system.version import VERSION as __version__

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
    "plot": "rosafe.results.view.plot",
    "process": "rosafe.processing.process",
    "process_batch": "rosafe.processing.features",
    "resynthesize": "rosafe.processing.resynthesis",
    "to_db": "rosafe.processing.features",
    "to_xarray": "rosafe.results.view.dataset",
}

__all__ = ["__version__", *_MODULES]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        value = getattr(importlib.import_module(_MODULES[name]), name)
    elif name.isidentifier() and not (name.startswith("_") or _is_module(name)) and name in _kinds():
        value = importlib.import_module("rosafe.processing.functions").function_of(name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({"__doc__", *__all__, *_kinds()})


def _is_module(name: str) -> bool:
    """Return whether it is a module of rosafe, which is imported without the representations."""
    return importlib.util.find_spec(f"{__name__}.{name}") is not None


def _kinds() -> list[str]:
    """Return the names of all representations."""
    return list(importlib.import_module("rosafe.representations").KINDS)
