"""Where plugins are looked for, and whether there may be any; rosafe/representations finds and checks them."""

from __future__ import annotations

import importlib.metadata
import os

FOLDERS = "ROSAFE_PLUGINS"  # environment variable with folders, as PATH
ENTRY_POINTS = "rosafe.representations"  # group of entry points of installed packages


def folders() -> list[str]:
    """The folders that the user names."""
    return [folder for folder in os.environ.get(FOLDERS, "").split(os.pathsep) if folder]


def entry_points() -> importlib.metadata.EntryPoints:
    """Those of installed packages."""
    return importlib.metadata.entry_points(group=ENTRY_POINTS)


def expected() -> bool:
    """Whether it is worth looking: a plugin's code is run for nothing else."""
    return bool(folders() or entry_points())
