"""Tables and texts of results."""

from __future__ import annotations

import numpy as np
import pytest

from rosafe.results.view import report


def test_the_table_of_ports() -> None:
    table = report.port_table(
        [("/rosAFE/inputProcPort", "A", 3.675, 441000, 44100, 0), ("/b", "BB", np.nan, 26, 100, 17)]
    )
    head, _, first, second = table.splitlines()
    assert head.split() == ["port", "type", "msg/s", "frames", "frames/s", "lost"]
    assert first.split() == ["/rosAFE/inputProcPort", "A", "3.67", "441000", "44100", "0"]
    assert second.split()[2:] == ["nan", "26", "100", "17"]
    assert len({len(line) for line in (head, first, second)}) == 1


@pytest.mark.parametrize(
    "azimuth, text",
    [(84.6, "85 deg left"), (0.4, "ahead"), (-0.4, "ahead"), (-12.0, "12 deg right"), (np.nan, "no source")],
)
def test_directions_as_text(azimuth: float, text: str) -> None:
    assert report.side(azimuth) == text.rjust(12)


def test_ruler_goes_from_left_to_right() -> None:
    assert report.ruler({"E": 90.0, "T": -90.0}).startswith("|E") and report.ruler({"T": -120.0}).endswith("T|")
    middle = report.ruler({"E": 1.0})
    assert middle[len(middle) // 2] == "E"
    assert report.ruler({"E": 40.0, "T": 40.0}).count("X") == 1
    assert report.ruler({"E": np.nan}).count("-") == report.RULER - 1


def test_the_path_has_one_line_per_step() -> None:
    times = np.arange(200) / 100
    azimuth = np.where(times < 1, 45.0, -45.0)
    gone = np.where(times < 0.5, np.nan, azimuth)
    lines = report.path_table(times, {"estimate": gone, "truth": azimuth}, every=0.5).splitlines()
    assert len(lines) == 5
    assert lines[0].split()[-2:] == ["estimate", "truth"]
    assert lines[1].split() == ["0.00", "s", report.ruler({"T": 45.0}), *["no", "source", "45", "deg", "left"]]
    assert lines[3].endswith("45 deg right  45 deg right") and "X" in lines[3]
