"""Octave scripts like those of other users of the original's client, which depend on the shapes of values."""

from __future__ import annotations

import pytest

from tests.matlab import octave
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros


def test_a_robot_interface(world: World) -> None:
    results = octave.run_and_parse(world, octave.script("robot_interface"))
    assert results["sizes"] == [[1, 16000], [8000, 2], 0.5, [16000, 2]]
    assert all(results["same"]) and results["alive"]
    assert results["types"] == ["cell", "double"]
    assert results["old"] == [[16000, 1], [16000, 2]]
    assert results["fields"] == [[0, 1], "done"]
    assert results["wrong"] == "genomix:connection expected at most '-columns' after the address of genomixd"


def test_signals_accept_the_same_chunks_as_the_front_end(world: World) -> None:
    results = octave.run_and_parse(world, octave.script("signals_of_the_front_end"))
    samples, channels = [1600, 1], [1600, 3]
    frames = results["correlation"][2]
    assert results["time"] == [True, True, samples] and results["samples"]
    assert results["bank"] == [True, True, channels] and results["channels"] and results["adapted"]
    assert results["correlation"][:2] == [True, True] and frames == [10, 3, 37]
    assert results["nothing new"] == [True, True, channels]
    for name in ("time as it comes", "two ears"):
        assert results[name] == [False, False, samples]
    for name in ("bank on its side", "one channel"):
        assert results[name] == [False, False, channels]
    for name in ("other lags", "lags first"):
        assert results[name] == [False, False, frames]
    assert results["newest"] == list(range(16, 26))
    error = "expected a chunk of N-by-1 with one frame per row, got 1-by-4410"
    assert results["error"] == f"BufferedSignal:size input_0: {error}"
    assert results["error 3"].endswith("expected a chunk of N-by-3-by-37 with one frame per row, got 10-by-3")
