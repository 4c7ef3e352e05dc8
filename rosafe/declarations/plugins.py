"""The folders and entry points in which plugins are searched; rosafe/representations loads them."""

from __future__ import annotations

import importlib.metadata
import os
from collections.abc import Callable

FOLDERS = "ROSAFE_PLUGINS"  # environment variable: folders, or single files, separated as in PATH
ENTRY_POINTS = "rosafe.representations"  # group of entry points of installed packages
SKIPPED = (".", "_", "test_")  # beginnings of the names of files that are not loaded

_disabled = False
# Called with the origin of each plugin before its import, so that a plugin that ends the process can be named
before_import: Callable[[str], None] = lambda origin: None  # noqa: E731


def disable() -> None:
    """Import no plugins in this process. Call it before rosafe.representations is imported."""
    global _disabled
    _disabled = True


def named() -> list[str]:
    """Return the folders in the environment variable."""
    return [folder for folder in os.environ.get(FOLDERS, "").split(os.pathsep) if folder]


def folders() -> list[str]:
    """Return the folders whose plugins this process imports."""
    return [] if _disabled else named()


def entry_points() -> importlib.metadata.EntryPoints:
    """Return the entry points of installed packages that this process imports."""
    return importlib.metadata.EntryPoints() if _disabled else importlib.metadata.entry_points(group=ENTRY_POINTS)


def expected_modules() -> bool:
    """Return whether there may be plugins to import."""
    return bool(folders() or entry_points())


def where() -> str:
    """Return the search path of this process, for messages."""
    return f"{FOLDERS} is {os.pathsep.join(named())}" if named() else f"{FOLDERS} is not set"
