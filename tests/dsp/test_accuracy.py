"""The errors that docs/accuracy.md tells of are measured anew, against truths that share nothing with the code."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import pytest

from benchmarks import accuracy
from tests.harness import ROOT

TOLD = (ROOT / "docs" / "accuracy.md").read_text()


@pytest.mark.parametrize("measure", accuracy.MEASUREMENTS)
def test_errors_stay_within_their_bounds(measure: Callable[[], Iterator[accuracy.Row]]) -> None:
    rows = list(measure())
    assert rows
    for row in rows:
        assert math.isfinite(row.error) and row.error <= row.bound, row
        assert any(line.startswith(f"| {row.what} |") and line.endswith(f" {row.bound:.1e} |") for line in lines()), (
            f"docs/accuracy.md does not tell of {row.what}: run benchmarks/accuracy.py"
        )


def lines() -> list[str]:
    return TOLD.splitlines()


def test_the_truth_tells_errors_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """A filter that is wrong in its tenth digit is found out."""
    monkeypatch.setattr("rosafe.dsp.gammatone.bandwidth", lambda f: 24.7 + 0.108 * f + 1e-9)
    assert any(row.error > row.bound for row in accuracy.gammatone_impulses())
    assert any(row.error > row.bound for row in accuracy.filterbanks())
