"""Fixtures: eltclsh as a command, and at a terminal, with a home folder of the test's own."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import harness
from tests.terminal import Terminal

Run = Callable[..., subprocess.CompletedProcess[str]]


def environment(home: Path) -> dict[str, str]:
    """What a user's shell without any set-up has."""
    return {"PATH": "/usr/local/bin:/usr/bin:/bin", "HOME": str(home), "LANG": "C.UTF-8"} | {
        name: os.environ[name] for name in ("DISPLAY",) if name in os.environ
    }


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A home folder."""
    folder = tmp_path / "home"
    folder.mkdir()
    return folder


@pytest.fixture
def run(home: Path, tmp_path: Path) -> Run:
    """Run a shell (eltclsh unless told another) with arguments to its end."""

    def run_shell(
        *arguments: str, shell: str = "eltclsh", stdin: str = "", **env: str
    ) -> subprocess.CompletedProcess[str]:
        program = shell if shell == "tclsh" else str(harness.SCRIPTS / shell)
        return subprocess.run(
            ["timeout", "-k", "2", str(harness.PATIENCE), program, *arguments],
            env={**environment(home), **env},
            cwd=tmp_path,
            input=stdin,
            capture_output=True,
            text=True,
            check=False,
        )

    return run_shell


@pytest.fixture
def terminal(home: Path) -> Iterator[Terminal]:
    """eltclsh at its first prompt."""
    with Terminal([str(harness.SCRIPTS / "eltclsh")], environment(home)) as this:
        this.expect("eltclsh > ")
        yield this
