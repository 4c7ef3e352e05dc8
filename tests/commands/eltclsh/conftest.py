"""Fixtures: eltclsh as a command and on a terminal, with a temporary home folder."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import harness
from tests.harness import run_program
from tests.terminal import Terminal

Run = Callable[..., subprocess.CompletedProcess[str]]


def environment(home: Path) -> dict[str, str]:
    """Return the environment of a user without any set-up."""
    return {"PATH": "/usr/local/bin:/usr/bin:/bin", "HOME": str(home), "LANG": "C.UTF-8"} | {
        name: os.environ[name] for name in ("DISPLAY",) if name in os.environ
    }


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Create a home folder."""
    folder = tmp_path / "home"
    folder.mkdir()
    return folder


@pytest.fixture
def run(home: Path, tmp_path: Path) -> Run:
    """Return a function that runs a shell (eltclsh by default) and returns its result."""

    def run_shell(
        *arguments: str, shell: str = "eltclsh", stdin: str = "", **env: str
    ) -> subprocess.CompletedProcess[str]:
        program = shell if shell == "tclsh" else str(harness.SCRIPTS / shell)
        return run_program(
            ["timeout", "-k", "2", str(harness.PATIENCE), program, *arguments],
            env={**environment(home), **env},
            cwd=tmp_path,
            input=stdin,
        )

    return run_shell


@pytest.fixture
def terminal(home: Path) -> Iterator[Terminal]:
    """Start eltclsh and wait for its prompt."""
    with Terminal([str(harness.SCRIPTS / "eltclsh")], environment(home)) as started:
        started.expect("eltclsh > ")
        yield started
