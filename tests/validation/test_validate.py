"""`rosafe validate`: all comparisons that need no other toolbox, their disturbances, the page and the command."""

from __future__ import annotations

import re
import socket
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from rosafe.commands.__main__ import main
from rosafe.representations import BUILTIN
from rosafe.validation import report
from rosafe.validation.comparison import Comparison
from tests.harness import ROOT

PAGE = ROOT / "docs" / "validation.md"
ALL = report.comparisons()
SHORT = report.comparisons(short=True)


def name(comparison: Comparison) -> str:
    return f"{comparison.kind}: {comparison.subject}"


@pytest.mark.parametrize("comparison", ALL, ids=name)
def test_passes(comparison: Comparison) -> None:
    if comparison.missing:
        pytest.skip(comparison.missing)
    (row,) = report.run([comparison])
    assert row.passed, report.line(row)
    if row.curve:
        assert len(row.curve.x) == len(row.curve.expected) == len(row.curve.measured)


@pytest.mark.parametrize("comparison", ALL, ids=name)
def test_detects_its_disturbance(comparison: Comparison) -> None:
    if comparison.missing:
        pytest.skip(comparison.missing)
    (row,) = report.run([comparison], disturbed=True)
    assert not row.passed, report.line(row, disturbed=True)


@pytest.mark.parametrize("kind", sorted(BUILTIN))
def test_every_representation_has_a_comparison_that_needs_nothing_else(kind: str) -> None:
    assert any(comparison.kind == kind and not comparison.requires for comparison in ALL)


def test_names_and_tolerances_are_unique_and_finite() -> None:
    assert len({(one.kind, one.subject, one.source.text) for one in ALL}) == len(ALL)
    for comparison in ALL:
        assert comparison.kind in BUILTIN
        assert 0 <= comparison.tolerance < 100
        assert comparison.source.text or comparison.source.reference
    assert {one.requires.partition(".")[0] for one in ALL if not one.short} == {
        *("gammatone", "pyfar", "librosa", "python_auditory_toolbox"),
    }


def test_page_is_up_to_date() -> None:
    """The rows agree; deviations may depend on the machine."""
    lines = [line.split(" | ") for line in PAGE.read_text("utf-8").splitlines() if line.startswith("| `")]
    found = [(cells[0].strip("| `"), cells[1], cells[2], cells[4], cells[6]) for cells in lines]
    expected = [(c.kind, c.subject, c.source.markdown, f"{c.tolerance:g}", c.disturbance.text) for c in ALL]
    assert found == expected, "run: rosafe validate -o docs/validation.md"
    assert {cells[5] for cells in lines} == {"yes"}, "a comparison failed or was skipped"
    for cells, comparison in zip(lines, ALL, strict=True):
        assert float(cells[3].split(" ")[0]) <= comparison.tolerance < float(cells[7].rstrip("| "))


def test_page_shows_its_pictures() -> None:
    pictures = re.findall(r"!\[.+?\]\((.+?)\)", PAGE.read_text("utf-8"))
    assert len(pictures) == 5
    for picture in pictures:
        data = (PAGE.parent / picture).read_bytes()
        assert data.startswith(b"\x89PNG") and len(data) < 200_000


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> list[Comparison]:
    """Three comparisons in place of all: two with a curve, one of a toolbox that does not exist."""
    rows = [one for one in SHORT if one.kind in ("moc", "ild") and not one.requires]
    rows.append(replace(SHORT[0], requires="no_such_toolbox"))
    monkeypatch.setattr(report, "comparisons", lambda short=False: rows)
    return rows


def test_command(few: list[Comparison], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError("no network is allowed")

    monkeypatch.setattr(socket, "socket", refuse)
    assert main(["validate"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:-1]] == ["pass", "pass", "skipped"]
    assert lines[2].endswith("no_such_toolbox is not installed")
    assert re.fullmatch(r"2 of 2 comparisons passed, 1 skipped, in \d+ s", lines[-1])
    assert main(["validate", "--self-test"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:-1]] == ["detected", "detected", "skipped"]
    assert lines[-1].startswith("2 of 2 disturbances detected")


def test_command_fails_if_a_comparison_fails(few: list[Comparison], capsys: pytest.CaptureFixture[str]) -> None:
    few[0] = replace(few[0], measure=lambda process: float("nan"))
    few[1] = replace(few[1], measure=lambda process: 2 * few[1].tolerance)
    assert main(["validate"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:2]] == ["FAIL", "FAIL"]
    assert lines[-1].startswith("0 of 2 comparisons passed")


def test_self_test_fails_if_a_disturbance_is_not_detected(
    few: list[Comparison], capsys: pytest.CaptureFixture[str]
) -> None:
    few[0] = replace(few[0], tolerance=1e9)
    assert main(["validate", "--self-test"]) == 1
    assert capsys.readouterr().out.splitlines()[0].startswith("NOT DETECTED")


def test_broken_toolbox_is_skipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, few: list[Comparison]) -> None:
    (tmp_path / "broken_toolbox.py").write_text("raise AttributeError('no such thing')")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    (row,) = report.run([replace(few[0], requires="broken_toolbox")])
    assert row.skipped
    assert "broken_toolbox cannot be imported (AttributeError: 'no such thing')" in report.line(row)
    assert replace(few[0], requires=str(tmp_path / "head.sofa")).missing.startswith(f"{tmp_path}/head.sofa is not")


def test_written_page(few: list[Comparison], tmp_path: Path) -> None:
    page = tmp_path / "out.md"
    assert main(["validate", "-o", str(page)]) == 0
    text = page.read_text("utf-8")
    assert "2 of 2 comparisons passed, of 2 representations; 1 were skipped" in text
    assert text.count("\n| `") == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out-binaural.png", "out-periphery.png", "out.md"]


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["-o", "out.txt"], 1, "-o: expected a name ending in .md, got out.txt"),
        (["-o", "missing_folder/out.md"], 1, "expected an existing folder missing_folder"),
        (["-o", "out.md", "--self-test"], 2, "-o: expected without --self-test"),
    ],
)
def test_errors(
    words: list[str], code: int, message: str, capsys: pytest.CaptureFixture[str], few: list[Comparison]
) -> None:
    try:
        found = main(["validate", *words])
    except SystemExit as end:
        found = int(end.code or 0)
    assert found == code
    assert message in capsys.readouterr().err
