"""Finds all representations: the modules of this folder, then plugins. Parents precede their children.

Side effects and failures of the import of one plugin do not affect the others.
"""

from __future__ import annotations

import contextlib
import copyreg
import functools
import grp
import importlib
import importlib.util
import os
import pkgutil
import pwd
import stat
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from rosafe.declarations import plugins
from rosafe.declarations.representation import Representation
from rosafe.declarations.text import short_repr
from rosafe.dsp.plugin_checks import checked, text_of_exception
from rosafe.dsp.stage import Stage
from rosafe.representations import plugin_conflicts

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


# --- import of plugins -------------------------------------------------------------------------------------------


def _described(problem: BaseException) -> str:
    """Return an exception as one line."""
    line = f" (line {problem.lineno})" if isinstance(problem, SyntaxError) and problem.lineno else ""
    return " ".join(f"{type(problem).__name__}: {text_of_exception(problem)}".split()) + line


def _load(problems: list[str], warnings: list[str]) -> Iterator[tuple[str, Any]]:
    """Yield the origin and the module or class of each plugin; append a line for each that fails to `problems`."""
    for origin, load_plugin in _candidates(problems, warnings):
        try:
            with _contained(origin):
                found = load_plugin()
        except BaseException as problem:  # including SystemExit and KeyboardInterrupt: the code is not ours
            problems.append(f"{origin}: {_described(problem)}")
        else:
            yield origin, found


def _candidates(problems: list[str], warnings: list[str]) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield the origin of each plugin, and a function that imports it."""
    for folder in map(os.path.abspath, plugins.folders()):
        for path in _files(folder, problems, warnings):
            yield path, functools.partial(_import_file, path)
    for point in plugins.entry_points():
        yield f"{point.name} ({point.value})", point.load


def _files(folder: str, problems: list[str], warnings: list[str]) -> list[str]:
    """Return the files in `folder` that may be plugins; `folder` may be such a file itself."""
    if os.path.isfile(folder) and folder.endswith(".py"):
        folder, name = os.path.split(folder)
        chosen = [name]
    else:
        try:
            names = sorted(os.listdir(folder))
        except OSError as problem:
            problems.append(f"{folder}: {plugins.FOLDERS}: expected a readable folder, got: {problem.strerror}")
            return []
        chosen = [name for name in names if name.endswith(".py") and not name.startswith(plugins.SKIPPED)]
    if folder not in sys.path:
        sys.path.append(folder)  # last, so that modules shared by plugins cannot replace others
    paths = [os.path.join(folder, name) for name in chosen]
    warnings += filter(None, map(_writable_by_others, [folder, *paths]))
    return paths


def _writable_by_others(path: str) -> str:
    """Return a warning if other users can change the code at `path`, which this process executes."""
    try:
        status = os.stat(path)
        group = grp.getgrgid(status.st_gid)
        me = pwd.getpwuid(os.geteuid()).pw_name
    except (OSError, KeyError):
        return ""
    if status.st_uid not in (0, os.geteuid()):
        writer = f"user {status.st_uid}"
    elif status.st_mode & stat.S_IWOTH:
        writer = "all users"
    elif status.st_mode & stat.S_IWGRP and (status.st_gid != os.getegid() or {*group.gr_mem} - {me}):
        writer = f"group {group.gr_name}"
    else:
        return ""
    return f"{path}: can be changed by {writer}, and plugins run with your rights; chmod go-w {path}"


def _import_file(path: str) -> ModuleType:
    name = f"rosafe_plugin_{Path(path).stem}"
    number = 2
    while name in sys.modules:  # a file with the same name in another folder
        name, number = f"rosafe_plugin_{Path(path).stem}_{number}", number + 1
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # required by dataclasses and pickle
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


@contextlib.contextmanager
def _contained(origin: str) -> Iterator[None]:
    """Undo changes by the import of a plugin: working directory, environment, sys.path, numpy's error handling.

    Its output is redirected to standard error, because the shell evaluates the output of scripts/env.sh and programs
    parse that of commands.
    """
    plugins.before_import(origin)
    environment, path = dict(os.environ), list(sys.path)
    folder = os.open(".", os.O_RDONLY | os.O_CLOEXEC)
    sys.stdout.flush()
    output = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr), np.errstate():
            yield
    finally:
        os.dup2(output, 1)
        os.close(output)
        os.fchdir(folder)
        os.close(folder)
        if os.environ != environment:
            os.environ.clear()
            os.environ.update(environment)
        sys.path[:] = path


# --- all representations -----------------------------------------------------------------------------------------


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
        for origin, found in _load(self.problems, self.warnings):
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
