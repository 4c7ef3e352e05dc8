"""`rosafe validate`: all comparisons that need no other toolbox, their disturbances, the page and the command."""

from __future__ import annotations

import re
import socket
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from rosafe.commands.__main__ import main
from rosafe.localization import training
from rosafe.representations import BUILTIN
from rosafe.validation import figures, report, transients
from rosafe.validation.comparison import DEFINITION, INDEPENDENT, LIMITATION, STAGE, Comparison
from tests.harness import ROOT
from tests.models import OTHER_SOUND_SECONDS, cache

PAGE = ROOT / "docs" / "validation.md"
ALL = report.comparisons()
CHECKED = [one for one in ALL if one.evidence != LIMITATION]
SHORT = report.comparisons(short=True)
SYSTEMS = {"Head.sphere", "localize", "enhance"}  # beside the representations


def page_rows() -> list[list[str]]:
    """Return the cells of all rows of the page."""
    return [line.strip("| ").split(" | ") for line in PAGE.read_text("utf-8").splitlines() if line.startswith("| `")]


def name(comparison: Comparison) -> str:
    return f"{comparison.kind}: {comparison.subject}"


@pytest.fixture(scope="module", autouse=True)
def models(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Learn direction models from less sound than usual, once for all processes of a run of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache(tmp_path_factory)))
        patch.setattr(training, "SOUND_SECONDS", OTHER_SOUND_SECONDS)
        yield


@pytest.mark.parametrize("comparison", ALL, ids=name)
def test_passes(comparison: Comparison) -> None:
    if comparison.missing:
        pytest.skip(comparison.missing)
    (row,) = report.run([comparison])
    assert row.passed, report.line(row)
    written = [
        cells for cells in page_rows() if cells[0].strip("`") == comparison.kind and cells[1] == comparison.subject
    ]
    assert row.parameters in [cells[3] for cells in written], "run: rosafe validate -o docs/validation.md"
    if row.curve:
        assert len(row.curve.x) == len(row.curve.expected) == len(row.curve.measured)


@pytest.mark.parametrize("comparison", CHECKED, ids=name)
def test_detects_its_disturbance(comparison: Comparison) -> None:
    if comparison.missing:
        pytest.skip(comparison.missing)
    (row,) = report.run([comparison], disturbed=True)
    assert not row.passed, report.line(row, disturbed=True)


@pytest.mark.parametrize("kind", sorted(BUILTIN))
def test_every_representation_has_a_comparison_that_needs_nothing_else(kind: str) -> None:
    assert any(comparison.kind == kind and not comparison.requires for comparison in CHECKED)


def test_rows_against_the_own_definition_are_not_independent() -> None:
    evidence = {(one.kind, one.measure.__name__): one.evidence for one in CHECKED if hasattr(one.measure, "__name__")}
    own = ("efferent_attenuation", "onset_sum", "offset_decay", "ratemap_decay", "ratemap_power", "gabor_count")
    stage = ("spectral_shape", "spectral_entropy", "librosa_features", "autocorrelation", "cross_correlation")
    for (_, function), found in evidence.items():
        assert found == (DEFINITION if function in own else STAGE if function in stage else found)
    assert {function for _, function in evidence} >= {*own, *stage}


def test_names_and_tolerances_are_unique_and_finite() -> None:
    assert len({(one.kind, one.subject, one.source.text, one.criterion) for one in ALL}) == len(ALL)
    for comparison in ALL:
        assert comparison.kind in {*BUILTIN, *SYSTEMS}
        assert comparison.evidence in (INDEPENDENT, STAGE, DEFINITION, LIMITATION)
        assert comparison.criterion and (comparison.source.text or comparison.source.reference)
        assert (comparison.disturbance is None) == (comparison.evidence == LIMITATION)
    assert all(-10 < comparison.tolerance <= 100 for comparison in CHECKED)
    assert {need.partition(".")[0] for one in ALL if not one.short for need in one.requires} == {
        *("gammatone", "pyfar", "librosa", "python_auditory_toolbox"),
    }


def test_page_is_up_to_date() -> None:
    """The rows agree; deviations may depend on the machine, and the recorded parameters are in `test_passes`."""
    order = [one for evidence in report.SECTIONS for one in ALL if one.evidence == evidence]
    rows = page_rows()
    assert [(cells[0].strip("`"), *cells[1:3], cells[4]) for cells in rows] == [
        (one.kind, one.subject, one.source.markdown, one.criterion) for one in order
    ], "run: rosafe validate -o docs/validation.md"
    for cells, comparison in zip(rows, order, strict=True):
        deviation = float(cells[5].split(" ")[0])
        if comparison.disturbance:
            error, found = cells[8].rsplit(": ", 1)
            assert (cells[6], cells[7]) == (f"{comparison.tolerance:g}", "yes")
            assert error == comparison.disturbance.text
            assert deviation <= comparison.tolerance < float(found)


def test_page_shows_its_pictures() -> None:
    pictures = re.findall(r"!\[.+?\]\((.+?)\)", PAGE.read_text("utf-8"))
    assert len(pictures) == 6
    for picture in pictures:
        data = (PAGE.parent / picture).read_bytes()
        assert data.startswith(b"\x89PNG") and len(data) < 200_000


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> list[Comparison]:
    """Four comparisons in place of all: two with a curve, one of a toolbox that does not exist, and a limitation."""
    rows = [one for one in SHORT if one.kind in ("moc", "ild") and not one.requires]
    rows.append(replace(SHORT[0], requires=("no_such_toolbox",)))
    rows.append(next(one for one in ALL if one.evidence == LIMITATION))
    monkeypatch.setattr(report, "comparisons", lambda short=False: rows)
    return rows


def test_command(few: list[Comparison], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError("no network is allowed")

    monkeypatch.setattr(socket, "socket", refuse)
    assert main(["validate"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:-1]] == ["pass", "pass", "skipped", "reported"]
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
    (row,) = report.run([replace(few[0], requires=("broken_toolbox",))])
    assert row.skipped
    assert "broken_toolbox cannot be imported (AttributeError: 'no such thing')" in report.line(row)
    missing = replace(few[0], requires=("numpy", str(tmp_path / "head.sofa"))).missing
    assert missing == f"{tmp_path}/head.sofa is not installed"


def test_written_page(few: list[Comparison], tmp_path: Path) -> None:
    page = tmp_path / "out.md"
    assert main(["validate", "-o", str(page)]) == 0
    text = page.read_text("utf-8")
    assert (
        "2 of 2 comparisons passed (1 of 1 independent, 0 of 0 single stages, 1 of 1 own definitions); 1 were" in text
    )
    assert text.index("## Independent comparisons") < text.index("## Own definition") < text.index("## Limitations")
    assert text.count("\n| `") == 4
    assert "| 16 kHz; defaults | largest difference over all channels and frames |" in text  # ild
    assert "`ihc_method` = none; `rm_scaling` = power | largest difference |" in text  # moc
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out-binaural.png", "out-periphery.png", "out.md"]


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["-o", "out.txt"], 1, "-o: expected a name ending in .md, got out.txt"),
        (["-o", "missing_folder/out.md"], 1, "expected an existing folder missing_folder"),
        (["-o", "out.md", "--self-test"], 2, "-o: expected without --self-test"),
        (["--figures", "missing_folder"], 1, "--figures: expected an existing folder, got missing_folder"),
        (["--figures", ".", "--short"], 2, "--figures: expected without other options"),
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


def test_published_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", "--figures", str(tmp_path)]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 4
    written, committed = ((folder / "figures.md").read_text("utf-8") for folder in (tmp_path, PAGE.parent))
    values = re.compile(r"-?\d+\.?\d*(?:e[+-]\d+)?")
    assert values.sub("", written) == values.sub("", committed), "run: rosafe validate --figures docs"
    found, expected = ([float(one) for one in values.findall(text)] for text in (written, committed))
    assert found == pytest.approx(expected, rel=0.02, abs=0.01)
    for picture in re.findall(r"!\[.+?\]\((.+?)\)", committed):
        for folder in (tmp_path, PAGE.parent):
            data = (folder / picture).read_bytes()
            assert data.startswith(b"\x89PNG") and len(data) < 100_000


def test_published_values_and_curves_agree() -> None:
    """Adaptation follows AMT; for weak lags, the lead dominates as in the published model."""
    precedence, drnl, adaptation = figures.published_figures(report.compute)
    for panel in adaptation.panels:
        assert panel.curves[0][1] == pytest.approx(panel.published, abs=1e-3)
    for panel in drnl.panels:
        assert panel.curves[0][1] == pytest.approx(panel.curves[1][1], abs=0.01)
    errors = [[abs(values - panel.published).max() for _, values in panel.curves] for panel in precedence.panels]
    assert errors[0][0] < 0.1 and errors[1][1] < 0.1
    assert errors[2][0] > 0.2 and errors[3][0] > 0.2  # known limitations


def test_onsets_preset_and_defaults() -> None:
    """The defaults mark steady noise and toggling bits; the preset does not."""
    rates = {}
    for comparison in ALL:
        if comparison.kind == "onsetMap" and comparison.evidence == LIMITATION and not comparison.requires:
            (row,) = report.run([comparison])
            rates[comparison.subject] = row.deviation
    preset = [value for subject, value in rates.items() if subject.startswith("preset")]
    assert len(preset) == 3 and max(preset) == 0
    assert [rates[f"defaults: {sound}"] > 1 for sound in (transients.STEADY, transients.SPARSE, "exact silence")] == [
        True,
        True,
        False,
    ]
