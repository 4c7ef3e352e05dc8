"""All representations: one module each, with declaration and numerics, found by being here or by being a plugin.

A plugin is a Python file in one of the folders that the environment variable ROSAFE_PLUGINS names (as PATH does), or a
module or class that an installed package names in the entry point group `rosafe.representations`. One that is broken is
left out and named in `PROBLEMS`; `WARNINGS` are remarks about the others, and `PLUGINS` tells where each kind is from.
"""

from __future__ import annotations

from .registry import BUILTIN, PLUGINS, PROBLEMS, STAGES, WARNINGS

KINDS = {kind: stage.REPRESENTATION for kind, stage in STAGES.items()}

__all__ = ["BUILTIN", "KINDS", "PLUGINS", "PROBLEMS", "STAGES", "WARNINGS"]
