"""Built with sanitizers for addresses and undefined behaviour, the kernels pass their tests and process random blocks.

The sanitized kernels are beside the other kernels of this checkout, and remain for the next run.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rosafe.dsp.kernels import build
from tests.harness import ROOT, proc, run_program

from .implementations import levels

# -O1 halves the time of the compiler. Options of the kernels' own flags come first in the command, and are overridden.
COMPILER = """#!/bin/sh
exec gcc "$@" -O1 -g1 -fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer
"""
TIMEOUT_SECONDS = 500
# Tests for another level than those of a library are skipped; tests marked `long` run in an emulator or need clang.
PYTEST = (
    "pytest",
    "-n0",
    "-q",
    "--durations=9",
    "-p",
    "no:cacheprovider",
    "tests/dsp/test_kernels.py",
    "-m",
    "not long",
)

pytestmark = pytest.mark.exploration


@pytest.fixture(scope="module", autouse=True)
def implementation() -> None:
    """Replace the fixture of this folder: the processes select their implementation."""


def run(sanitized: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run tests.dsp.sanitized with the kernels of a folder."""
    runtime = [_runtime(f"lib{name}.so") for name in ("asan", "ubsan")]
    environment = {
        **os.environ,
        build.COMPILER: str(sanitized / "compiler"),
        "LD_PRELOAD": ":".join(runtime),
        "ASAN_OPTIONS": "detect_leaks=0:quarantine_size_mb=16",
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "ROSAFE_KERNELS": "",
        "ROSAFE_TEST_EXAMPLES": "20",
    }
    command = [sys.executable, "-m", "tests.dsp.sanitized", str(sanitized), ",".join(map(str, levels()))]
    return run_program([*command, *arguments], cwd=ROOT, env=environment)


def _runtime(name: str) -> str:
    """Return the path of a library of gcc."""
    found = subprocess.run(["gcc", f"-print-file-name={name}"], capture_output=True, text=True, check=True)
    return found.stdout.strip()


@pytest.fixture(scope="module")
def sanitized() -> Path:
    """Return a folder with kernels for all instruction sets of this processor."""
    if not levels():
        pytest.skip("the kernels cannot be built here")
    if shutil.which("gcc") is None or "/" not in _runtime("libasan.so") or "/" not in _runtime("libubsan.so"):
        pytest.skip("no gcc with sanitizers here")
    folder = build.place() / f"sanitized-{hashlib.sha256(COMPILER.encode()).hexdigest()[:8]}"
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    compiler, new = folder / "compiler", folder / f"compiler.{os.getpid()}"
    new.write_text(COMPILER, "ascii")
    new.chmod(0o755)
    new.rename(compiler)
    names = build.ISA_LEVELS[platform.machine()]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(build.COMPILER, str(compiler))
        patch.setattr(build, "ISA_LEVELS", {platform.machine(): {level: names[level] for level in levels()}})
        patch.setattr(build, "COMPILE_TIMEOUT_SECONDS", TIMEOUT_SECONDS)
        build.libraries(folder)
    return folder


def passed(done: subprocess.CompletedProcess[str]) -> None:
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-5000:]


def test_an_overflow_is_reported(sanitized: Path) -> None:
    proc("self")  # without it the report has no names of functions
    done = run(sanitized, "overflow")
    assert done.returncode != 0
    assert "heap-buffer-overflow" in done.stderr and "rosafe_concatenate" in done.stderr, done.stderr[-3000:]


def test_kernels_of_all_instruction_sets_pass_all_tests(sanitized: Path) -> None:
    passed(run(sanitized, *PYTEST))


def test_many_random_blocks(sanitized: Path) -> None:
    passed(run(sanitized, "fuzz", "10000"))
