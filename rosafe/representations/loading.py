"""Imports the modules of plugins. What one of them does, or fails with, at import does not affect the others."""

from __future__ import annotations

import contextlib
import grp
import importlib.util
import os
import pwd
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from rosafe.declarations import plugins
from rosafe.dsp import old_names


class Loaded(NamedTuple):
    """A module, or a class, of which a plugin consists."""

    origin: str  # the path of the file, or the entry point
    found: Any
    path: str  # of the file


def described(problem: BaseException) -> str:
    """An exception as one line."""
    try:
        text = str(problem)
    except Exception:
        text = ""
    where = f" (line {problem.lineno})" if isinstance(problem, SyntaxError) and problem.lineno else ""
    return " ".join(f"{type(problem).__name__}: {text}".split()) + where


def load(problems: list[str], warnings: list[str]) -> Iterator[Loaded]:
    """Each plugin that can be imported; a line for each of the others is appended to `problems`."""
    for folder in map(os.path.abspath, plugins.folders()):
        for path in _files(folder, problems, warnings):
            try:
                with _contained(path):
                    module = _imported(path)
            except BaseException as problem:  # SystemExit and KeyboardInterrupt included: this is other people's code
                problems.append(f"{path}: {described(problem)}")
            else:
                yield Loaded(path, module, path)
    for point in plugins.entry_points():
        origin = f"{point.name} ({point.value})"
        try:
            with _contained(origin):
                found = point.load()
        except BaseException as problem:
            problems.append(f"{origin}: {described(problem)}")
        else:
            yield Loaded(origin, found, str(getattr(sys.modules.get(point.module), "__file__", "")))


def _files(folder: str, problems: list[str], warnings: list[str]) -> list[str]:
    """The files in `folder` that may be plugins; `folder` may be one of them."""
    if os.path.isfile(folder) and folder.endswith(".py"):
        folder, name = os.path.split(folder)
        chosen = [name]
    else:
        try:
            names = sorted(os.listdir(folder))
        except OSError as problem:
            problems.append(
                f"{folder}: named in {plugins.FOLDERS}, and not a folder that can be read: {problem.strerror}"
            )
            return []
        chosen = [name for name in names if name.endswith(".py") and not name.startswith(plugins.SKIPPED)]
    if folder not in sys.path:
        sys.path.append(folder)  # last: for modules that the plugins share, not for replacing others
    paths = [os.path.join(folder, name) for name in chosen]
    warnings += filter(None, map(_writable_by_others, [folder, *paths]))
    return paths


def _writable_by_others(path: str) -> str:
    """A warning if other users can change what is at `path`, which is run with the rights of this process."""
    try:
        status = os.stat(path)
        own_group = grp.getgrgid(status.st_gid)
        me = pwd.getpwuid(os.geteuid()).pw_name
    except (OSError, KeyError):
        return ""
    if status.st_uid not in (0, os.geteuid()):
        who = f"user {status.st_uid}"
    elif status.st_mode & stat.S_IWOTH:
        who = "all users"
    elif status.st_mode & stat.S_IWGRP and (status.st_gid != os.getegid() or {*own_group.gr_mem} - {me}):
        who = f"group {own_group.gr_name}"
    else:
        return ""
    return f"{path}: can be changed by {who}, and plugins run with your rights; chmod go-w {path}"


def _imported(path: str) -> ModuleType:
    name = f"rosafe_plugin_{Path(path).stem}"
    number = 2
    while name in sys.modules:  # a file of the same name in another folder
        name, number = f"rosafe_plugin_{Path(path).stem}_{number}", number + 1
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and pickle look it up there
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


@contextlib.contextmanager
def _contained(origin: str) -> Iterator[None]:
    """Keep what a plugin does at import from others: standard output, working directory, environment, sys.path.

    What it prints goes to standard error: the shell evaluates the output of scripts/env.sh, and programs read that of
    commands.
    """
    plugins.before_import(origin)
    environment, path, errors = dict(os.environ), list(sys.path), np.geterr()
    folder = os.open(".", os.O_RDONLY | os.O_CLOEXEC)
    sys.stdout.flush()
    output = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
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
        np.seterr(**errors)


def old_names_used(path: str) -> list[str]:
    """The names of 0.2 in the source at `path`."""
    try:
        return old_names.used(Path(path).read_bytes())
    except (OSError, SyntaxError, ValueError):
        return []
