"""All representations, built-in and plugins. Each module of this folder contains declarations and their stages.

A plugin is a Python file in a folder listed in the environment variable ROSAFE_PLUGINS (in the format of PATH), or a
module or class in the entry point group `rosafe.representations` of an installed package. A broken plugin is left out
and listed in `PROBLEMS`. `WARNINGS` are remarks about the other plugins; `PLUGINS` is the origin of each kind.
"""

from __future__ import annotations

from .registry import BUILTIN, PLUGINS, PROBLEMS, STAGES, WARNINGS

KINDS = {kind: stage.REPRESENTATION for kind, stage in STAGES.items()}

__all__ = ["BUILTIN", "KINDS", "PLUGINS", "PROBLEMS", "STAGES", "WARNINGS"]
