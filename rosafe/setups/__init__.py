"""Setups: text files that describe a tree of processors with its sound (docs/setups.md). Does not use ROS.

`read` and `write` convert between text and `Setup`; `plan` determines the requests that load a setup into an existing
tree. rosafe/ros1/client/setup_transaction.py sends these requests to a running graph.
"""

from __future__ import annotations

from .markup import SetupError
from .plan import SetupPlan, dry_run, plan
from .reading import read, read_parameters
from .setup import LOCALIZER, LOCALIZER_FILES, AcquireSettings, Setup, SetupProcessor, setup_processor
from .writing import write

__all__ = [
    "LOCALIZER",
    "LOCALIZER_FILES",
    "AcquireSettings",
    "Setup",
    "SetupError",
    "SetupPlan",
    "SetupProcessor",
    "dry_run",
    "plan",
    "read",
    "read_parameters",
    "setup_processor",
    "write",
]
