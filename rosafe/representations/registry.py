"""Finds the representations: the modules of this folder, then plugins; parents first."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from rosafe.declarations.checks import short
from rosafe.declarations.representation import Representation
from rosafe.dsp.plugin_checks import checked
from rosafe.dsp.stage import Stage
from rosafe.representations import checks, loading

# The original's processors, in its order: also that of getParameters and getSignals, which report no others.
CORE_KINDS = ("input", "preProc", "gammatone", "ihc", "ild", "ratemap", "crossCorrelation")


def _stages_in(found: Any) -> list[type[Stage]]:
    """The classes with a declaration that a module itself defines, each once; or the class of an entry point."""
    if not isinstance(found, ModuleType):
        return [found]
    own = {id(v): v for v in vars(found).values() if isinstance(v, type) and v.__module__ == found.__name__}
    return [value for value in own.values() if "REPRESENTATION" in vars(value)]


def builtin_stages() -> dict[str, type[Stage]]:
    """The representations of this folder by kind, without plugins; parents first."""
    found: dict[str, type[Stage]] = {}
    for info in pkgutil.iter_modules([str(Path(__file__).parent)]):
        if info.name != Path(__file__).stem:
            stages = _stages_in(importlib.import_module(f"{__package__}.{info.name}"))
            found.update({stage.REPRESENTATION.kind: stage for stage in stages})
    return _ordered(found)


def _ordered(stages: Mapping[str, type[Stage]]) -> dict[str, type[Stage]]:
    """The original's first, then by name, parents before their children; without those whose parent is missing."""
    waiting = sorted(stages, key=lambda kind: (CORE_KINDS.index(kind) if kind in CORE_KINDS else len(CORE_KINDS), kind))
    ordered: dict[str, type[Stage]] = {}
    while ready := [kind for kind in waiting if stages[kind].REPRESENTATION.parent in ("", *ordered)]:
        ordered[ready[0]] = stages[ready[0]]
        waiting.remove(ready[0])
    return ordered


class _Search:
    """All representations, of plugins too.

    Attributes
    ----------
    stages : dict of str to type
        By kind, parents first.
    plugins : dict of str to str
        The origin of each plugin, by kind: the path of its file, or its entry point.
    problems, warnings : list of str
        A line for each plugin that is left out, and for each remark about one.
    """

    def __init__(self) -> None:
        self.stages = builtin_stages()
        self.plugins: dict[str, str] = {}
        self.problems: list[str] = []
        self.warnings: list[str] = []
        offered: list[tuple[str, type[Stage]]] = []
        for origin, found, path in loading.load(self.problems, self.warnings):
            names = loading.old_names_used(path)
            stages = [stage for stage in _stages_in(found) if self._declared(origin, stage)]
            if stages and names:
                self.warnings.append(f"{origin}: uses old names, which the next release removes: {', '.join(names)}")
            offered += [(origin, stage) for stage in stages]
        self._accept(offered)
        self.stages = _ordered(self.stages)

    def _declared(self, origin: str, stage: Any) -> bool:
        """Whether `stage` has a declaration; its absence is a problem."""
        declared = getattr(stage, "REPRESENTATION", None)
        if isinstance(stage, type) and isinstance(declared, Representation):
            return True
        name = getattr(stage, "__name__", short(stage))
        self.problems.append(f"{origin}: {name}: REPRESENTATION: expected a Representation, got {short(declared)}")
        return False

    def _accept(self, offered: list[tuple[str, type[Stage]]]) -> None:
        """Take those that go together; the parent of a plugin may be another one, whatever their order."""
        while offered:
            taken = next((one for one in offered if not checks.problem_of(one[1], self.stages)), None)
            if taken is None:
                break
            origin, stage = taken
            declared = stage.REPRESENTATION
            if stage.INPUT is Stage.INPUT:  # which the author need not repeat
                stage.INPUT = self.stages[declared.parent].REPRESENTATION.parts[0].axes
            self.stages[declared.kind], self.plugins[declared.kind] = checked(stage), origin
            self.warnings += [
                f"{origin}: {declared.kind}: the boolean {p.name} has the default True, and a plain ROS request "
                "cannot tell False from a value that is not given; declare the inverse parameter with the default False"
                for p in declared.parameters
                if p.idl == "boolean" and p.default
            ]
            offered.remove(taken)
        for origin, stage in offered:
            problem = checks.problem_of(stage, self.stages)
            self.problems.append(f"{origin}: {stage.REPRESENTATION.kind}: {problem}")


_SEARCH = _Search()
STAGES, PLUGINS, PROBLEMS, WARNINGS = _SEARCH.stages, _SEARCH.plugins, _SEARCH.problems, _SEARCH.warnings
BUILTIN = frozenset(builtin_stages())  # kinds that are no plugins
