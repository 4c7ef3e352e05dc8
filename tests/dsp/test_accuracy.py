"""The errors in docs/accuracy.md, measured against independent reference computations."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import pytest

from benchmarks import accuracy
from tests.harness import ROOT

DOCUMENTED = (ROOT / "docs" / "accuracy.md").read_text()


@pytest.mark.parametrize("measure", accuracy.MEASUREMENTS)
def test_errors_are_within_their_limits(measure: Callable[[], Iterator[accuracy.Row]]) -> None:
    rows = list(measure())
    assert rows
    for row in rows:
        assert math.isfinite(row.error) and row.error <= row.bound, row
        assert any(
            line.startswith(f"| {row.quantity} |") and line.endswith(f" {row.bound:.1e} |") for line in lines()
        ), f"docs/accuracy.md does not contain {row.quantity}: run benchmarks/accuracy.py"


def lines() -> list[str]:
    return DOCUMENTED.splitlines()


def test_the_reference_detects_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """A filter with an error in its tenth digit is detected."""
    monkeypatch.setattr("rosafe.dsp.gammatone.bandwidth", lambda f: 24.7 + 0.108 * f + 1e-9)
    assert any(row.error > row.bound for row in accuracy.gammatone_impulses())
    assert any(row.error > row.bound for row in accuracy.filterbanks())
