"""What to install where a package is absent: one line for whoever asks for what needs it."""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
from pathlib import Path
from types import ModuleType

# Module: what pip is to install, and Debian's package where scripts/install does not bring it anyway.
_PACKAGES = {
    "matplotlib": ("'rosafe[plot]'", ""),
    "h5py": ("'rosafe[files]'", "python3-h5py"),
    "xarray": ("'rosafe[files]'", "python3-xarray"),
    "zarr": ("'rosafe[files]'", "python3-zarr"),
    "distributed": ("'rosafe[dask]'", "python3-distributed"),
    "dask": ("'rosafe[dask]'", "python3-distributed"),
    "alsaaudio": ("pyalsaaudio", ""),
}
_ROS = ("ros", "bass", "genpy", "genmsg", "actionlib", "diagnostic_", "std_msgs")  # what their names begin with
_BESIDE_ROS = ("aiohttp", "tkinter", "_tkinter", "yaml")  # what only its clients and nodes want


@functools.cache
def by_pip() -> bool:
    """Whether pip has brought this package: then ROS, Tcl and sound cards are none of its business."""
    here = Path(__file__)
    for found in importlib.metadata.distributions(name="rosafe"):
        if found.read_text("INSTALLER") is None:  # what a build has left in a checkout
            continue
        file = Path(str(found.locate_file("rosafe/missing.py")))
        if '"editable": true' in (found.read_text("direct_url.json") or "") or (file.exists() and file.samefile(here)):
            return True
    return False


def install(module: str) -> str:
    """What to do where a module is not installed."""
    top = module.partition(".")[0]
    pip, debian = _PACKAGES.get(top, (top, ""))
    if not by_pip():
        return f"apt install {debian}, or pip install {top}" if debian else "run scripts/install"
    if top.startswith(_ROS) or top in _BESIDE_ROS:
        return "pip does not bring it: run scripts/install of a checkout, on Debian 12"
    return f"pip install {pip}"


def advice(module: str) -> str:
    """That a module is not installed, and what to do about it, in one line without a full stop."""
    return f"the Python package {module.partition('.')[0]} is not installed; {install(module)}"


def require(module: str, what: str) -> ModuleType:
    """Import `module`, which `what` needs; ModuleNotFoundError of one line where it is not installed."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as problem:
        absent = problem.name or module
        raise ModuleNotFoundError(f"{what}: {advice(absent)}", name=absent) from None
