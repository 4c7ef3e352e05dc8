"""The reference pages: up to date, examples print the numbers on the page; the examples of docs/resynthesis.md run."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import re
from pathlib import Path
from types import ModuleType

import matplotlib
import pytest

from rosafe.representations.registry import builtin_stages
from tests.harness import ROOT

FOLDER = ROOT / "docs" / "reference"
KINDS = sorted(builtin_stages())
MAX_PICTURE = 20_000  # bytes


@pytest.fixture(scope="module")
def pages() -> ModuleType:
    pytest.importorskip("PIL", reason="python3-pil is not installed; run scripts/install --tests")
    matplotlib.use("Agg")
    spec = importlib.util.spec_from_file_location("reference", ROOT / "docs" / "reference.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def numbers(text: str) -> list[float]:
    return [float(found) for found in re.findall(r"-?\d+(?:\.\d+)?", text)]


@pytest.mark.parametrize("kind", KINDS)
def test_a_page(kind: str, pages: ModuleType) -> None:
    page = (FOLDER / f"{kind}.md").read_text("utf-8")
    (printed,) = re.findall(r"^It prints\n\n```\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert pages.text(kind, printed) == page, "run python3 docs/reference.py"
    found, variables = pages.run(kind)
    assert re.sub(r"[\d.]+", "", found) == re.sub(r"[\d.]+", "", printed)
    assert numbers(found) == pytest.approx(numbers(printed), rel=0.02, abs=0.02)
    assert any(name.startswith(kind) for name in variables["result"])
    assert page.count("$") >= 4 and page.count("$") % 2 == 0
    assert not re.search(r"\\[,!;{}_]", page.split("## Equations")[1].split("## Parameters")[0])  # for GitHub


@pytest.mark.parametrize("page", [*(f"reference/{kind}" for kind in KINDS), "parameters", "citing"])
def test_no_word_of_a_generated_page_is_empty(page: str) -> None:
    text = (ROOT / "docs" / f"{page}.md").read_text("utf-8")
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    assert not re.findall(r".*(?:``|[^|\s] {2,}[^|\s]|\(\)|None).*", prose)


@pytest.mark.parametrize("kind", KINDS)
def test_a_picture(kind: str) -> None:
    data = (FOLDER / f"{kind}.png").read_bytes()
    assert data.startswith(b"\x89PNG") and len(data) < MAX_PICTURE


def test_every_representation_has_one_page(pages: ModuleType) -> None:
    assert sorted(pages.PAGES) == KINDS
    assert sorted(path.stem for path in FOLDER.iterdir()) == sorted(2 * KINDS)
    overview = (ROOT / "docs" / "representations.md").read_text("utf-8")
    assert sorted(re.findall(r"^\*\*\[(\w+)\]\(reference/\1\.md\)\*\*", overview, re.MULTILINE)) == KINDS


def test_the_page_on_sound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its Python examples run, and its figures are those of the benchmark."""
    page = (ROOT / "docs" / "resynthesis.md").read_text("utf-8")
    monkeypatch.chdir(tmp_path)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        for code in re.findall(r"^```python\n(.*?)^```$", page, re.MULTILINE | re.DOTALL):
            (tmp_path / "example.py").write_text(code)
            spec = importlib.util.spec_from_file_location("example", tmp_path / "example.py")
            assert spec and spec.loader
            spec.loader.exec_module(importlib.util.module_from_spec(spec))
    assert "(2, 32000) (2, 32000)" in printed.getvalue() and "delay 8 ms, error -36 dB" in printed.getvalue()
    measured = (ROOT / "benchmarks" / "results" / "resynthesis.md").read_text("utf-8")
    rows = [line for line in page.split("## Figures")[1].splitlines() if line.startswith("| ")]
    assert len(rows) >= 6 and all(row in measured for row in rows)
