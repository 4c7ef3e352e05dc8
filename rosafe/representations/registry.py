"""Finds all representations: the modules of this folder, then plugins. Parents precede their children."""

from __future__ import annotations

import copyreg
import importlib
import pkgutil
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from rosafe.declarations.representation import Representation
from rosafe.declarations.text import short_repr
from rosafe.dsp.plugin_checks import checked
from rosafe.dsp.stage import Stage
from rosafe.representations import plugin_conflicts, plugin_loader

# The processors of the original, in its order, which getParameters and getSignals also use; they report no others.
CORE_KINDS = ("input", "preProc", "gammatone", "ihc", "ild", "ratemap", "crossCorrelation")


def _stages_in(found: Any) -> list[type[Stage]]:
    """Return the classes with a declaration that a module itself defines, or the class of an entry point."""
    if not isinstance(found, ModuleType):
        return [found]
    own = {id(v): v for v in vars(found).values() if isinstance(v, type) and v.__module__ == found.__name__}
    return [value for value in own.values() if "REPRESENTATION" in vars(value)]


def builtin_stages() -> dict[str, type[Stage]]:
    """Return the representations of this folder by kind, without plugins; parents first."""
    found: dict[str, type[Stage]] = {}
    for info in pkgutil.iter_modules([str(Path(__file__).parent)]):
        if info.name != Path(__file__).stem:
            stages = _stages_in(importlib.import_module(f"{__package__}.{info.name}"))
            found.update({stage.REPRESENTATION.kind: stage for stage in stages})
    return _ordered(found)


def _ordered(stages: Mapping[str, type[Stage]]) -> dict[str, type[Stage]]:
    """Sort by `CORE_KINDS`, then by name, with parents before their children; drop kinds whose parent is missing."""
    waiting = sorted(stages, key=lambda kind: (CORE_KINDS.index(kind) if kind in CORE_KINDS else len(CORE_KINDS), kind))
    ordered: dict[str, type[Stage]] = {}
    while ready := [kind for kind in waiting if stages[kind].REPRESENTATION.parent in ("", *ordered)]:
        ordered[ready[0]] = stages[ready[0]]
        waiting.remove(ready[0])
    return ordered


class _Search:
    """All representations, including plugins.

    Attributes
    ----------
    stages : dict of str to type
        The stages by kind, parents first.
    plugins : dict of str to str
        The origin of each plugin, by kind: the path of its file, or its entry point.
    problems, warnings : list of str
        A line for each plugin that is left out, and for each remark about a plugin.
    """

    def __init__(self) -> None:
        self.stages = builtin_stages()
        self.plugins: dict[str, str] = {}
        self.problems: list[str] = []
        self.warnings: list[str] = []
        offered: list[tuple[str, type[Stage]]] = []
        for origin, found in plugin_loader.load(self.problems, self.warnings):
            offered += [(origin, stage) for stage in _stages_in(found) if self._declared(origin, stage)]
        self._accept(offered)
        self.stages = _ordered(self.stages)

    def _declared(self, origin: str, stage: Any) -> bool:
        """Return whether `stage` has a declaration; append a problem if it has none."""
        declared = getattr(stage, "REPRESENTATION", None)
        if isinstance(stage, type) and isinstance(declared, Representation):
            return True
        name = getattr(stage, "__name__", short_repr(stage))
        self.problems.append(f"{origin}: {name}: REPRESENTATION: expected a Representation, got {short_repr(declared)}")
        return False

    def _accept(self, offered: list[tuple[str, type[Stage]]]) -> None:
        """Accept plugins without conflicts, in any order: the parent of a plugin may be another plugin."""
        while offered:
            accepted = next((one for one in offered if not plugin_conflicts.problem_of(one[1], self.stages)), None)
            if accepted is None:
                break
            origin, stage = accepted
            declared = stage.REPRESENTATION
            if stage.INPUT is Stage.INPUT:  # the default: the axes of the parent
                stage.INPUT = self.stages[declared.parent].REPRESENTATION.parts[0].axes
            self.stages[declared.kind], self.plugins[declared.kind] = checked(stage), origin
            self.warnings += [
                f"{origin}: {declared.kind}: the boolean {p.name} has the default True, but a plain ROS request "
                "cannot distinguish False from an omitted value; declare the inverse parameter with the default False"
                for p in declared.parameters
                if p.idl == "boolean" and p.default
            ]
            offered.remove(accepted)
        for origin, stage in offered:
            problem = plugin_conflicts.problem_of(stage, self.stages)
            self.problems.append(f"{origin}: {stage.REPRESENTATION.kind}: {problem}")


def _new(kind: str) -> Stage:
    return object.__new__(STAGES[kind])


def _reduced(stage: Stage) -> tuple[Any, ...]:
    """Return the kind and the state of a plugin's stage, for `pickle`: its class, made by `checked`, has no name."""
    return _new, (stage.REPRESENTATION.kind,), *tuple(stage.__reduce_ex__(2))[2:]


_SEARCH = _Search()
STAGES, PLUGINS, PROBLEMS, WARNINGS = _SEARCH.stages, _SEARCH.plugins, _SEARCH.problems, _SEARCH.warnings
for _kind in PLUGINS:
    copyreg.pickle(STAGES[_kind], _reduced)
BUILTIN = frozenset(builtin_stages())  # kinds that are not plugins
