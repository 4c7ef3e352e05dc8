"""Copies of this checkout for tests that change, lock or install one, and becoming a user without rights."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.harness import PYTHON, ROOT

NOBODY = 65534
ENVIRONMENT = {"PATH": "/usr/local/bin:/usr/bin:/bin", "HOME": "/nonexistent"}
LEFT_OUT = shutil.ignore_patterns(
    ".git", ".generated", ".*_cache", ".hypothesis", "__pycache__", "tests", "rosafe-demo"
)


@contextmanager
def fresh_copy() -> Iterator[Path]:
    """A copy of the checkout as a new clone would be, in a folder that every user can reach."""
    with tempfile.TemporaryDirectory(prefix="rosafe-test-") as folder:
        Path(folder).chmod(0o755)
        copy = Path(folder, "a checkout")  # with a blank in its name, as some have
        shutil.copytree(ROOT, copy, ignore=LEFT_OUT, symlinks=True)
        yield copy


def environment(**more: str) -> dict[str, str]:
    """What a login shell would have, and nothing of this process."""
    return {**ENVIRONMENT, **more}


def run(
    *command: str | Path, env: dict[str, str], cwd: Path = Path("/"), seconds: int = 240
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, whatever that is."""
    return subprocess.run(
        ["/usr/bin/timeout", str(seconds), *map(str, command)],
        env=env,
        cwd=cwd,
        text=True,
        capture_output=True,
        check=False,
    )


def without_rights(*command: str | Path) -> list[str | Path]:
    """`command` as a user who can write nothing; this process' own user where that is not root."""
    if os.getuid() != 0:
        return list(command)
    return ["/usr/bin/setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", "--", *command]


def generate(copy: Path, *arguments: str) -> list[str | Path]:
    """The command that generates the messages of a copy."""
    return ["env", f"PYTHONPATH={copy}", PYTHON, "-m", "rosafe.component.generate", *arguments]
