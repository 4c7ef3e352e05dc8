"""Linters report nothing. `scripts/install --tests` installs them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.harness import PYTHON, ROOT, proc, run_program

TOOLS = Path("/usr/local/lib/rosafe/tools")  # folder of packages that scripts/install installs from PyPI


def tracked() -> list[Path]:
    """Return the files tracked by git, or all files if this is not a clone."""
    if (ROOT / ".git").exists() and shutil.which("git"):
        listed = run_program(["git", "-c", f"safe.directory={ROOT}", "ls-files", "-z"], cwd=ROOT, check=True)
        paths = [ROOT / name for name in listed.stdout.split("\0") if name]
    else:
        paths = [p for p in ROOT.rglob("*") if not any(part.startswith(".") for part in p.relative_to(ROOT).parts)]
    return [p for p in paths if p.is_file() and not p.is_symlink()]


def first_line(path: Path) -> str:
    with path.open("rb") as stream:
        return stream.readline().decode("utf-8", "replace").strip()


def check(*command: str | Path) -> None:
    if shutil.which(str(command[0])) is None:
        pytest.skip(f"{command[0]} is not installed; run scripts/install --tests")
    done = subprocess.run(["timeout", "550", *map(str, command)], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_ruff() -> None:
    ruff = TOOLS / "bin" / "ruff"
    check(
        ruff,
        "check",
        "--no-cache",
        *(p for p in tracked() if p.suffix == ".py" or first_line(p).startswith("#!/usr/bin/python3")),
    )


@pytest.mark.parametrize("files", [("rosafe", "python/genomix"), ()], ids=["product", "all"])
def test_mypy(files: tuple[str, ...]) -> None:
    """With mypy from PyPI: Debian's version takes five times as long.

    In two parts, the second one with the results of the first: beside busy programs, all files at once took too long.
    """
    if not (TOOLS / "mypy").is_dir():
        pytest.skip("mypy is not installed; run scripts/install --tests")
    proc("stat")  # mypy imports psutil, which reads it
    check("env", f"PYTHONPATH={TOOLS}", PYTHON, "-m", "mypy", *files)


def test_shellcheck() -> None:
    shells = [p for p in tracked() if p.suffix == ".sh" or first_line(p) in ("#!/bin/sh", "#!/bin/bash")]
    assert ROOT / "scripts" / "env.sh" in shells and ROOT / "scripts" / "install" in shells
    check("shellcheck", "-x", *shells)


def test_cppcheck() -> None:
    """Justified exceptions are in cppcheck.txt. Results of unchanged sources are kept for the next run."""
    exceptions = ROOT / "tests" / "packaging" / "cppcheck.txt"
    sources = [path for path in tracked() if path.suffix in (".c", ".cpp")]
    assert ROOT / "rosafe" / "dsp" / "kernels" / "gammatone.c" in sources
    enabled = "--enable=warning,performance,portability"
    paths = [path.relative_to(ROOT) for path in sources]
    results = ROOT / ".generated" / "cppcheck"
    results.mkdir(parents=True, exist_ok=True)
    options = (enabled, f"--suppressions-list={exceptions}", f"--cppcheck-build-dir={results}")
    check("cppcheck", "-q", "--error-exitcode=1", *options, *paths)


def test_catkin_lint() -> None:
    check("catkin_lint", "--strict", "-W1", ROOT, ROOT / "bass")


def test_programs_are_executable_and_use_debians_python() -> None:
    for path in tracked():
        line = first_line(path)
        if line.startswith("#!"):
            assert path.stat().st_mode & 0o111, f"{path} has a #! line but is not executable"
            assert "env python" not in line, f"{path}: another python3 may come first on PATH"


def test_catkin_installs_every_program() -> None:
    """All Python programs and links in scripts/. Shell scripts are for a checkout only."""
    programs = {f"scripts/{p.name}" for p in (ROOT / "scripts").iterdir() if "python3" in first_line(p)}
    listed = (ROOT / "CMakeLists.txt").read_text("utf-8").split("set(EXECUTABLES")[1].split(")")[0].split()
    assert set(listed) == programs


def test_every_python_file_begins_with_a_docstring() -> None:
    for path in tracked():
        if path.suffix == ".py":
            assert first_line(path).startswith('"""'), path
