"""Setups: text files that describe a tree of processors with its sound (docs/setups.md). Does not use ROS.

`read` and `write` convert between text and `Setup`; `plan` determines the processors that a setup adds to an existing
tree. rosafe/tree/tree_builder.py creates them.
"""

from __future__ import annotations

from .markup import SetupError
from .plan import dry_run, plan
from .reading import read, read_parameters
from .setup import LOCALIZER, LOCALIZER_FILES, AcquireSettings, Setup, SetupProcessor, setup_processor
from .writing import write

__all__ = [
    "LOCALIZER",
    "LOCALIZER_FILES",
    "AcquireSettings",
    "Setup",
    "SetupError",
    "SetupProcessor",
    "dry_run",
    "plan",
    "read",
    "read_parameters",
    "setup_processor",
    "write",
]
