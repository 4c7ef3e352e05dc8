"""Sphinx builds the documents and the API reference without a warning, and the reference is complete."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

import rosafe
from rosafe.interface import KINDS
from tests.harness import PYTHON, ROOT, run_program


@pytest.mark.exploration
def test_sphinx_reports_nothing(tmp_path: Path) -> None:
    for module in ("sphinx", "numpydoc", "myst_parser"):
        pytest.importorskip(module, reason=f"{module} is not installed; run scripts/install --tests")
    command = [PYTHON, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "-d", tmp_path / "trees"]
    done = run_program(
        [*map(str, command), "docs", str(tmp_path / "html")],
        cwd=ROOT,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    library = (tmp_path / "html" / "library.html").read_text("utf-8")
    for name in set(rosafe.__all__) - {"__version__"}:
        assert f'id="rosafe.{name}"' in library, f"docs/library.rst lacks {name}"
    assert 'id="rosafe.Stream.process"' in library


def test_index_lists_every_page() -> None:
    index = (ROOT / "docs" / "index.rst").read_text("utf-8").split()
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")} - {"README"}
    assert pages - set(index) == set()


def test_request_page_lists_every_representation() -> None:
    table = (
        (ROOT / "docs" / "request.md")
        .read_text("utf-8")
        .split("## Representations and parameters")[1]
        .split("\n## ")[0]
    )
    named = set(re.findall("`([^`]+)`", table))
    for kind in KINDS.values():
        assert {kind.word, kind.request, f"{kind.word}_0"} <= named, kind.kind
