"""Imports the modules of plugins. Side effects and failures of one import do not affect the others."""

from __future__ import annotations

import contextlib
import functools
import grp
import importlib.metadata
import importlib.util
import os
import pwd
import stat
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from rosafe.declarations import plugins
from rosafe.dsp.plugin_checks import text_of_exception


class Loaded(NamedTuple):
    """The module or class of a plugin."""

    origin: str  # the path of the file, or the entry point
    found: Any


def described(problem: BaseException) -> str:
    """Return an exception as one line."""
    line = f" (line {problem.lineno})" if isinstance(problem, SyntaxError) and problem.lineno else ""
    return " ".join(f"{type(problem).__name__}: {text_of_exception(problem)}".split()) + line


def load(problems: list[str], warnings: list[str]) -> Iterator[Loaded]:
    """Yield each plugin that can be imported; append a line for each of the others to `problems`."""
    for origin, load_plugin in _candidates(problems, warnings):
        try:
            with _contained(origin):
                found = load_plugin()
        except BaseException as problem:  # including SystemExit and KeyboardInterrupt: the code is not ours
            problems.append(f"{origin}: {described(problem)}")
        else:
            yield Loaded(origin, found)


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
