"""Setups: a tree of processors with its sound as a file that people read and write (docs/setups.md); no ROS.

`read` and `write` go from text to `Setup` and back; `plan` tells what to do for one in a tree that is there already.
rosafe/client/setup_transaction.py does it on a running graph.
"""

from __future__ import annotations

from .markup import SetupError
from .plan import SetupPlan, dry_run, plan
from .reading import read, read_parameters
from .setup import AcquireSettings, Setup, SetupProcessor, wanted
from .writing import write

__all__ = [
    "AcquireSettings",
    "Setup",
    "SetupError",
    "SetupPlan",
    "SetupProcessor",
    "dry_run",
    "plan",
    "read",
    "read_parameters",
    "wanted",
    "write",
]
