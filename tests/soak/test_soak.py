"""The soak itself: a round of it holds, and it says so where something does not."""

from __future__ import annotations

import argparse
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import harness
from tests.harness import PYTHON, ROOT, SCRIPTS, Process, proc, wait_for
from tests.soak import __main__ as command

pytestmark = pytest.mark.ros
SOAK = [PYTHON, "-m", "tests.soak", "--light"]


@pytest.fixture
def graph_of_none(tmp_path: Path) -> Iterator[harness.Graph]:
    """An environment for the soak, which starts a master of its own."""
    yield harness.Graph("http://127.0.0.1:1", tmp_path)


def test_a_round_of_the_soak(graph_of_none: harness.Graph) -> None:
    proc()
    with graph_of_none.start(*SOAK, "--minutes", "0", "--seed", "1", cwd=ROOT) as soak:
        assert soak.wait(150) == 0, soak
        assert soak.out.rstrip().endswith("soak: all held")
        assert "every frame, every port, every count" in soak.out


def test_the_soak_finds_what_does_not_hold(graph_of_none: harness.Graph) -> None:
    """Here: that a process has ended which nobody has told to."""
    with graph_of_none.start(*SOAK, "--minutes", "1", cwd=ROOT) as soak:
        wait_for(lambda: "round 1" in soak.out or not soak.alive, 60, lambda: str(soak))
        os.kill(child(soak, "genomixd"), signal.SIGKILL)
        assert soak.wait(100) == 1
        assert "soak: FAILED" in soak.err


def child(process: Process, program: str) -> int:
    """The child of a process that runs `program`."""
    children = proc(process.pid, "task", process.pid, "children").read_text().split()
    return next(int(pid) for pid in children if program in proc(pid, "cmdline").read_text())


@pytest.mark.parametrize("minutes", ["-1", "nan", "ten", ""])
def test_minutes_that_are_none(minutes: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="is no number of minutes"):
        command._minutes(minutes)


def test_help_has_an_example(graph_of_none: harness.Graph) -> None:
    assert "scripts/soak --minutes 60" in graph_of_none.run(*SOAK, "-h", PYTHONPATH=f"{ROOT}").stdout
    assert "tests.soak" in (SCRIPTS / "soak").read_text("utf-8")
