"""Finds the representations: the modules of this folder, then plugins; parents first."""

from __future__ import annotations

import importlib
import importlib.util
import os
import pkgutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType

from rosafe.dsp.plugin_checks import checked
from rosafe.dsp.stage import Stage
from rosafe.vocabulary import plugins
from rosafe.vocabulary.representation import Representation

# The original's processors, in its order: also that of getParameters and getSignals, which report no others.
ORIGINAL = ("input", "preProc", "gammatone", "ihc", "ild", "ratemap", "crossCorrelation")


def _stages_in(module: ModuleType) -> dict[str, type[Stage]]:
    """The representations that `module` itself defines, by kind."""
    found = {}
    for value in vars(module).values():
        if isinstance(value, type) and issubclass(value, Stage) and value.__module__ == module.__name__:
            declared = vars(value).get("REPRESENTATION")
            if isinstance(declared, Representation):
                found[declared.kind] = value
    return found


def own() -> dict[str, type[Stage]]:
    """The representations of this folder by kind, without plugins; parents first."""
    found: dict[str, type[Stage]] = {}
    for info in pkgutil.iter_modules([str(Path(__file__).parent)]):
        if info.name != Path(__file__).stem:
            found.update(_stages_in(importlib.import_module(f"{__package__}.{info.name}")))
    return _ordered(found)


def _ordered(stages: Mapping[str, type[Stage]]) -> dict[str, type[Stage]]:
    """The original's first, then by name, parents before their children; without those whose parent is missing."""
    waiting = sorted(stages, key=lambda kind: (ORIGINAL.index(kind) if kind in ORIGINAL else len(ORIGINAL), kind))
    ordered: dict[str, type[Stage]] = {}
    while ready := [kind for kind in waiting if stages[kind].REPRESENTATION.parent in ("", *ordered)]:
        ordered[ready[0]] = stages[ready[0]]
        waiting.remove(ready[0])
    return ordered


def _clash(stage: type[Stage], others: Mapping[str, type[Stage]]) -> str:
    """Why `stage` cannot stand beside `others`; empty where it can."""
    mine = stage.REPRESENTATION
    if not mine.parent:
        return "it has no parent"
    if mine.parent not in others:
        return f"its parent {mine.parent!r} is no kind of processor"
    for other in (known.REPRESENTATION for known in others.values()):
        for what in ("kind", "request", "port", "word", "task"):
            if getattr(mine, what).lower() == getattr(other, what).lower():
                return f"there is a {what} {getattr(mine, what)!r} already"
        both = {p.name for p in mine.parameters} & {p.name for p in other.parameters}
        if both:
            return f"{other.kind} has a parameter {min(both)!r} too"
    return ""


def _told(problem: BaseException) -> str:
    return " ".join(f"{type(problem).__name__}: {problem}".split())


def _plugin_modules(problems: list[str]) -> Iterator[tuple[str, ModuleType]]:
    """Each plugin's origin and module; what cannot be imported goes to `problems`."""
    for folder in plugins.folders():
        if not os.path.isdir(folder):
            problems.append(f"{folder}: named in {plugins.FOLDERS}, and no folder")
        for path in sorted(Path(folder).glob("*.py")):
            try:
                spec = importlib.util.spec_from_file_location(f"rosafe_plugin_{path.stem}", path)
                assert spec is not None
                assert spec.loader is not None
                module = importlib.util.module_from_spec(spec)
                spec.loader.exec_module(module)
            except (Exception, SystemExit) as problem:  # somebody else's code: anything can happen
                problems.append(f"{path}: {_told(problem)}")
            else:
                yield str(path), module
    for point in plugins.entry_points():
        try:
            module = importlib.import_module(point.module)
        except (Exception, SystemExit) as problem:
            problems.append(f"{point.name} ({point.value}): {_told(problem)}")
        else:
            yield f"{point.name} ({point.value})", module


def find() -> tuple[dict[str, type[Stage]], list[str]]:
    """All representations by kind, parents first, and a line for each plugin that is left out."""
    stages = own()
    problems: list[str] = []
    offered = []
    for origin, module in _plugin_modules(problems):
        found = _stages_in(module)
        if not found:
            problems.append(f"{origin}: it defines no representation")
        offered += [(origin, stage) for stage in found.values()]
    # a plugin may hang on another one, whatever their order
    while offered:
        taken = [(origin, stage) for origin, stage in offered if not _clash(stage, stages)]
        if not taken:
            problems += [f"{origin}: {stage.REPRESENTATION.kind}: {_clash(stage, stages)}" for origin, stage in offered]
            break
        stages[taken[0][1].REPRESENTATION.kind] = checked(taken[0][1])
        offered.remove(taken[0])
    return _ordered(stages), problems


STAGES, PROBLEMS = find()
OWN = frozenset(own())  # kinds that are no plugins
