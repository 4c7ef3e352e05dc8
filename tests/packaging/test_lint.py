"""The tools that check the code have nothing to say. A tool that is not here is brought by scripts/install --tests."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.harness import PYTHON, ROOT

TOOLS = Path("/usr/local/lib/rosafe/tools")  # where scripts/install puts what is from PyPI


def tracked() -> list[Path]:
    """The files of the project as git knows them, or all where this is no clone."""
    if (ROOT / ".git").exists() and shutil.which("git"):
        listed = subprocess.run(
            ["git", "-c", f"safe.directory={ROOT}", "ls-files", "-z"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
        paths = [ROOT / name for name in listed.stdout.split("\0") if name]
    else:
        paths = [p for p in ROOT.rglob("*") if not any(part.startswith(".") for part in p.relative_to(ROOT).parts)]
    return [p for p in paths if p.is_file() and not p.is_symlink()]


def first_line(path: Path) -> str:
    with path.open("rb") as stream:
        return stream.readline().decode("utf-8", "replace").strip()


def check(*command: str | Path) -> None:
    if shutil.which(str(command[0])) is None:
        pytest.skip(f"{command[0]} is not installed; scripts/install --tests brings it")
    done = subprocess.run(["timeout", "550", *map(str, command)], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_ruff() -> None:
    ruff = TOOLS / "bin" / "ruff"
    check(ruff, "check", "--no-cache", *(p for p in tracked() if p.suffix == ".py" or "python3" in first_line(p)))


def test_mypy() -> None:
    """Debian's takes five times as long."""
    if not (TOOLS / "mypy").is_dir():
        pytest.skip("mypy is not installed; scripts/install --tests brings it")
    check("env", f"PYTHONPATH={TOOLS}", PYTHON, "-m", "mypy")


def test_shellcheck() -> None:
    shells = [p for p in tracked() if p.suffix == ".sh" or first_line(p) in ("#!/bin/sh", "#!/bin/bash")]
    assert ROOT / "scripts" / "env.sh" in shells and ROOT / "scripts" / "install" in shells
    check("shellcheck", *shells)


def test_catkin_lint() -> None:
    check("catkin_lint", "--strict", "-W1", ROOT, ROOT / "bass")


def test_programs_are_executable_and_use_debians_python() -> None:
    for path in tracked():
        line = first_line(path)
        if line.startswith("#!"):
            assert path.stat().st_mode & 0o111, f"{path} has a #! line but is not executable"
            assert "env python" not in line, f"{path}: another python3 may come first on PATH"


def test_catkin_installs_every_program() -> None:
    """All of scripts/ but what is for a checkout, which is written for the shell; links too."""
    programs = {f"scripts/{p.name}" for p in (ROOT / "scripts").iterdir() if "python3" in first_line(p)}
    listed = (ROOT / "CMakeLists.txt").read_text("utf-8").split("set(EXECUTABLES")[1].split(")")[0].split()
    assert set(listed) == programs


def test_every_python_file_says_what_lives_there() -> None:
    for path in tracked():
        if path.suffix == ".py":
            assert first_line(path).startswith('"""'), path
