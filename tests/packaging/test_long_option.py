"""The two parts of `scripts/test --long`, and its exit code."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests.harness import ROOT, SCRIPTS

USUAL = "def test_usual():\n    assert {}\n"
ADDITIONAL = "import pytest\n\n@pytest.mark.exploration\ndef test_additional():\n    assert {}\n"


@pytest.mark.long
@pytest.mark.exploration
@pytest.mark.parametrize(
    ("text", "code", "passed"),
    [
        (USUAL.format(1) + ADDITIONAL.format(1), 0, 2),
        (USUAL.format(0) + ADDITIONAL.format(1), 1, 1),
        (USUAL.format(1) + ADDITIONAL.format(0), 1, 1),
        (USUAL.format(1), 0, 1),
        (ADDITIONAL.format(1), 0, 1),
        ("", 5, 0),  # pytest's code if there is no test
    ],
)
def test_the_exit_code(tmp_path: Path, text: str, code: int, passed: int) -> None:
    (tmp_path / "test_file.py").write_text(text)
    command: list[str | Path] = [
        SCRIPTS / "test",
        "--long",
        "-c",
        ROOT / "pyproject.toml",
        "-rN",
        "-p",
        "no:cacheprovider",
        tmp_path,
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == code, done.stdout + done.stderr
    assert done.stdout.count("1 passed") == passed, done.stdout
