"""Copies of this checkout for tests that change or install one, and commands that run as a user without rights."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.harness import PYTHON, ROOT, run_program

UNPRIVILEGED_USER = 65534
CLANG = ROOT / ".generated" / "cached-compilers" / "cached-clang"  # a program, see tests/packaging/conftest.py
ENVIRONMENT = {"PATH": "/usr/local/bin:/usr/bin:/bin", "HOME": "/nonexistent"}
EXCLUDED = shutil.ignore_patterns(
    ".git", ".generated", ".*_cache", ".hypothesis", "__pycache__", "tests", "rosafe-demo"
)


REQUESTS = ("InputProc", "IhcProc", "Stop", "Acquire")  # actions with and without a parent, services of both packages
MESSAGES = ("rosAFE_signalOneD",)  # kept, with those that `REQUESTS` need


@contextmanager
def fresh_copy(*names: str) -> Iterator[Path]:
    """Yield a copy of the checkout, or of these files and folders, in a folder that every user can read.

    It is like a new clone, or, if names are given, has the compiled modules of this checkout.
    """
    with tempfile.TemporaryDirectory(prefix="rosafe-test-") as folder:
        Path(folder).chmod(0o755)
        copy = Path(folder, "a checkout")  # the name contains a blank
        if not names:
            shutil.copytree(ROOT, copy, ignore=EXCLUDED, symlinks=True)
        for name in names:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, copy / name, symlinks=True)
            else:
                shutil.copy2(ROOT / name, copy / name)
        yield copy


def definitions(package: Path) -> set[Path]:
    """Return the files of messages, services and actions in the folder of a ROS package."""
    return {path for kind in ("action", "msg", "srv") for path in (package / kind).glob(f"*.{kind}")}


def keep_few_definitions(copy: Path) -> None:
    """Delete most requests and messages of both packages, so that generators are quick."""
    both = definitions(copy) | definitions(copy / "bass")
    kept = {path for path in both if path.stem in (*REQUESTS, *MESSAGES)}
    while needed := {path for path in both - kept if any(path.stem in words(user) for user in kept)}:
        kept |= needed
    for path in both - kept:
        path.unlink()


def words(definition: Path) -> set[str]:
    """Return the words of a definition, which include the messages that it needs."""
    return set(re.findall(r"\w+", definition.read_text("utf-8")))


def environment(**more: str) -> dict[str, str]:
    """Return the environment of a login shell, without the variables of this process."""
    return {**ENVIRONMENT, **more}


def run(
    *command: str | Path, env: dict[str, str], cwd: Path = Path("/"), seconds: int = 240
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, and return the result for any exit code."""
    return run_program(["/usr/bin/timeout", str(seconds), *map(str, command)], env=env, cwd=cwd)


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
    return ["env", f"PYTHONPATH={copy}", PYTHON, "-m", "rosafe.ros1.component.generate", *arguments]
