"""`rosafe cite`: paragraphs and BibTeX of results, of outputs and of the software."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rosafe
from rosafe.commands.__main__ import main
from rosafe.system.version import VERSION


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cite") / "speech.npz"
    parameters = {"fb_nChannels": 4, "ihc_method": "bernstein"}
    rosafe.process(np.zeros((2, 2000)), 16000, parameters=parameters, outputs=["onsetStrength"]).save(path)
    return path


def run(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(["cite", *words]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    return captured.out


def test_paragraph_of_a_result(capsys: pytest.CaptureFixture[str], result: Path) -> None:
    text = run(capsys, str(result))
    words = " ".join(text.split())
    assert f"rosAFE, version {VERSION}" in words
    assert "at a sample rate of 16000 Hz" in words
    assert "fb_nChannels = 4" in words
    assert "(Bernstein et al., 1999) with ihc_method = bernstein" in words
    assert "ratemap (cochleagram) (Brown and Cooke, 1994)" in words
    assert "onset strength (Klapuri, 1999; Bregman, 1990)" in words
    assert "Dau, T." not in words
    assert "condition the input" not in words
    for line in ("Bernstein, L. R.", "Klapuri, A.", "The Two!Ears project (2018)"):
        assert f"\n{line}" in text


def test_bibtex_of_a_result(capsys: pytest.CaptureFixture[str], result: Path) -> None:
    text = run(capsys, str(result), "--bibtex")
    keys = [line.partition("{")[2].rstrip(",") for line in text.splitlines() if line.startswith("@")]
    assert keys == [
        *("rosafe", "bernstein1999", "bregman1990", "brown1994", "glasberg1990", "hohmann2002", "klapuri1999"),
        *("patterson1987", "twoears2018"),
    ]


def test_outputs_and_settings(capsys: pytest.CaptureFixture[str]) -> None:
    drnl = run(capsys, "--outputs", "adaptation", "--set", "fb_type=drnl", "adpt_model=adt_breebaart", "--bibtex")
    assert all(key in drnl for key in ("{lopezpoveda2001,", "{jepsen2008,", "{breebaart2001,", "{dau1996,"))
    assert "{hohmann2002," not in drnl
    conditioned = run(capsys, "--outputs", "preProc", "--set", "pp_bNormalizeRMS=true")
    assert "Tchorz and Kollmeier, 2003" in conditioned
    assert "condition the input (The Two!Ears project, 2018; Tchorz and Kollmeier, 2003)" in " ".join(
        conditioned.split()
    )
    assert "pp_bNormalizeRMS = true" in conditioned
    assert "DC removal" not in conditioned


def test_software_only(capsys: pytest.CaptureFixture[str]) -> None:
    text = run(capsys)
    assert f"version {VERSION}" in text
    assert "The steps were" not in text
    assert run(capsys, "--bibtex").startswith("@software{rosafe,\n")


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["missing.npz"], 1, "missing.npz: No such file"),
        (["--outputs", "nothing"], 1, "nothing"),
        (["--set", "fb_nChannels=4"], 2, "--set: expected --outputs as well"),
        (["a.npz", "--outputs", "ild"], 2, "a result already has its representations"),
        (["a.npz", "b.npz"], 2, "expected at most one result, got 2"),
    ],
)
def test_errors(capsys: pytest.CaptureFixture[str], words: list[str], code: int, message: str) -> None:
    try:
        found = main(["cite", *words])
    except SystemExit as end:
        found = int(end.code or 0)
    assert found == code
    assert message in capsys.readouterr().err
