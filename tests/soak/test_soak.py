"""The soak itself: a round of it holds, and it says so where something does not."""

from __future__ import annotations

import argparse
import os
import signal
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests import harness
from tests.harness import PYTHON, ROOT, SCRIPTS, Process, proc
from tests.soak import __main__ as command
from tests.soak.world import LIGHT, Use, World

pytestmark = pytest.mark.ros
SOAK = [PYTHON, "-m", "tests.soak", "--light"]


@pytest.fixture
def graph_of_none(tmp_path: Path) -> Iterator[harness.Graph]:
    """An environment for the soak, which starts a master of its own."""
    yield harness.Graph("http://127.0.0.1:1", tmp_path)


def test_a_round_of_the_soak(graph_of_none: harness.Graph) -> None:
    proc()
    with graph_of_none.start(*SOAK, "--minutes", "0", "--seed", "1", cwd=ROOT) as soak:
        assert soak.wait(500) == 0, soak
        assert soak.out.rstrip().endswith("soak: all held")
        assert "every frame, every port, every count" in soak.out


def test_the_soak_finds_what_does_not_hold(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    """Here: that a process has ended which nobody has told to."""
    with Process(["sleep", "60"], dict(os.environ)) as lasting, Process(["sleep", "60"], dict(os.environ)) as dying:
        there = SimpleNamespace(
            afe=SimpleNamespace(process=lasting), bass=lasting, genomixd=dying, stream=nullcontext, size=LIGHT
        )
        there.alive = lambda: World.alive(cast(World, there))

        def end(world: Any, chance: Any) -> None:
            dying.stop(signal.SIGKILL)

        monkeypatch.setattr(command, "world", lambda size, home: nullcontext(there))
        monkeypatch.setattr(command, "FAULTS", {"end": end})
        monkeypatch.setattr("sys.argv", ["soak", "--light", "--minutes", "0"])
        assert command.main() == 1
    said = capfd.readouterr()
    assert "round 1: end" in said.out and "all held" not in said.out
    assert "soak: FAILED: AssertionError: it has ended: sleep 60" in said.err


def test_what_grows_is_found() -> None:
    """Memory, threads or files: from when it was warm to the end."""
    use = Use(threads=10, files=20, memory=2**28)
    grown = {"memory": 2**29, "threads": 40, "files": 60}
    for name, value in grown.items():
        soak = command.Soak(cast(World, None), Random(1), 0.0)
        soak._uses = [{"node": replace(use, **{name: value * 10})}, {"node": use}, {"node": use}]
        soak._check_growth()
        soak._uses.append({"node": replace(use, **{name: value})})
        with pytest.raises(AssertionError, match=r"node gathers (memory|threads|files)"):
            soak._check_growth()


@pytest.mark.parametrize("minutes", ["-1", "nan", "ten", ""])
def test_minutes_that_are_none(minutes: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="is no number of minutes"):
        command._minutes(minutes)


def test_help_has_an_example(graph_of_none: harness.Graph) -> None:
    assert "scripts/soak --minutes 60" in graph_of_none.run(*SOAK, "-h", PYTHONPATH=f"{ROOT}").stdout
    assert "tests.soak" in (SCRIPTS / "soak").read_text("utf-8")
