"""The examples of docs/own-representation.md work unchanged, and their plugins pass the check command."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from tests.harness import ROOT

from .support import SHORT, python

TEXT = (ROOT / "docs" / "own-representation.md").read_text("utf-8")
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NAME = re.compile(r"ave (?:this|it) as\s+`(\w+\.py)`")


def plugins() -> dict[str, str]:
    """Return the plugin files by name."""
    found = {}
    for block in BLOCK.finditer(TEXT):
        if "rosafe.plugin import" in block[1]:
            found[NAME.findall(TEXT[: block.start()])[-1]] = block[1]
    return found


def scripts() -> list[str]:
    """Return all other examples in Python."""
    return [block[1] for block in BLOCK.finditer(TEXT) if "rosafe.plugin import" not in block[1]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with all plugins of the page, except the one for numba if it is not installed."""
    path = tmp_path_factory.mktemp("plugins")
    for name, text in plugins().items():
        if "numba" not in text or importlib.util.find_spec("numba"):
            (path / name).write_text(text)
    return path


def test_the_page_has_them_all() -> None:
    assert list(plugins()) == ["zerocrossings.py", "bands.py", "slowratemap.py", "peaks.py"]
    assert len(scripts()) == 4
    assert len(plugins()["slowratemap.py"].splitlines()) <= 5


@pytest.mark.parametrize("number", range(4))
def test_examples(folder: Path, number: int) -> None:
    done = python(scripts()[number], folder)
    assert done.returncode == 0, done.stderr


def check(folder: Path, *kinds: str) -> None:
    """Check representations of the plugins in a folder."""
    code = f"""
from rosafe.representations import PROBLEMS, STAGES
from rosafe.testing import check_representation
assert not PROBLEMS, PROBLEMS
for kind in {kinds}:
    assert next(iter(check_representation(STAGES[kind], seconds=0.1))) == kind
"""
    done = python(SHORT + code, folder)
    assert done.returncode == 0, done.stderr


@pytest.mark.exploration
def test_each_plugin_passes_the_check(folder: Path) -> None:
    check(folder, "zeroCrossings", "bands", "slowRatemap")


def test_the_plugin_with_numba_passes_the_check(folder: Path) -> None:
    if not (folder / "peaks.py").exists():
        pytest.skip("python3-numba is not installed; the example in docs/own-representation.md needs it")
    check(folder, "peaks")
