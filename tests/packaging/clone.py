"""Copies of this checkout for tests that change or install one, and commands that run as a user without rights."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.harness import PYTHON, ROOT

UNPRIVILEGED_USER = 65534
ENVIRONMENT = {"PATH": "/usr/local/bin:/usr/bin:/bin", "HOME": "/nonexistent"}
EXCLUDED = shutil.ignore_patterns(
    ".git", ".generated", ".*_cache", ".hypothesis", "__pycache__", "tests", "rosafe-demo"
)


REQUESTS = ("InputProc", "IhcProc", "Stop")  # a service, and actions with and without a parent


@contextmanager
def fresh_copy() -> Iterator[Path]:
    """Yield a copy of the checkout, like a new clone, in a folder that every user can read."""
    with tempfile.TemporaryDirectory(prefix="rosafe-test-") as folder:
        Path(folder).chmod(0o755)
        copy = Path(folder, "a checkout")  # the name contains a blank
        shutil.copytree(ROOT, copy, ignore=EXCLUDED, symlinks=True)
        yield copy


def keep_few_requests(copy: Path) -> set[str]:
    """Delete most requests of rosAFE, so that generators are quick; return the names of the deleted files."""
    removed = {path for kind in ("action", "srv") for path in (copy / kind).iterdir() if path.stem not in REQUESTS}
    for path in removed:
        path.unlink()
    return {path.name for path in removed}


def environment(**more: str) -> dict[str, str]:
    """Return the environment of a login shell, without the variables of this process."""
    return {**ENVIRONMENT, **more}


def run(
    *command: str | Path, env: dict[str, str], cwd: Path = Path("/"), seconds: int = 240
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, and return the result for any exit code."""
    return subprocess.run(
        ["/usr/bin/timeout", str(seconds), *map(str, command)],
        env=env,
        cwd=cwd,
        text=True,
        capture_output=True,
        check=False,
    )


def without_rights(*command: str | Path) -> list[str | Path]:
    """Return the command line that runs `command` as an unprivileged user (as this user, if it is not root)."""
    if os.getuid() != 0:
        return list(command)
    return [
        "/usr/bin/setpriv",
        f"--reuid={UNPRIVILEGED_USER}",
        f"--regid={UNPRIVILEGED_USER}",
        "--clear-groups",
        "--",
        *command,
    ]


def generate(copy: Path, *arguments: str) -> list[str | Path]:
    """Return the command that generates the messages of a copy."""
    return ["env", f"PYTHONPATH={copy}", PYTHON, "-m", "rosafe.component.generate", *arguments]
