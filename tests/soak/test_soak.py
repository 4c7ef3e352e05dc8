"""The soak itself: one round passes, and failures are reported."""

from __future__ import annotations

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
from tests.harness import PYTHON, ROOT, Process, proc
from tests.soak import __main__ as command
from tests.soak.world import LIGHT, ResourceUse, World

pytestmark = pytest.mark.ros
SOAK = [PYTHON, "-m", "tests.soak", "--light"]


@pytest.fixture
def graph_without_master(tmp_path: Path) -> Iterator[harness.Graph]:
    """An environment without a master: the soak starts its own."""
    yield harness.Graph("http://127.0.0.1:1", tmp_path)


@pytest.mark.soak
def test_a_round_of_the_soak(graph_without_master: harness.Graph) -> None:
    proc()
    with graph_without_master.start(*SOAK, "--minutes", "0", "--seed", "1", cwd=ROOT) as soak:
        assert soak.wait(500) == 0, soak
        assert soak.out.rstrip().endswith("soak: all held")
        assert "every frame, every port, every count" in soak.out


def test_the_soak_finds_a_fault(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    """A process that has ended unexpectedly."""
    with Process(["sleep", "60"], dict(os.environ)) as lasting, Process(["sleep", "60"], dict(os.environ)) as dying:
        processes = {"rosAFE": lasting, "genomixd": dying}
        there = SimpleNamespace(processes=lambda: processes, stream=nullcontext, size=LIGHT)
        there.check_alive = lambda: World.check_alive(cast(World, there))

        def end(world: Any, chance: Any) -> None:
            dying.stop(signal.SIGKILL)

        monkeypatch.setattr(command, "world", lambda size, home: nullcontext(there))
        monkeypatch.setattr(command, "FAULTS", {"end": end})
        monkeypatch.setattr("sys.argv", ["soak", "--light", "--minutes", "0"])
        assert command.main() == 1
    output = capfd.readouterr()
    assert "round 1: end" in output.out and "all held" not in output.out
    assert "soak: FAILED: AssertionError: it has ended: sleep 60" in output.err


def test_growth_is_found() -> None:
    """Of memory, threads or files, between the warm-up and the end."""
    use = ResourceUse(threads=10, files=20, memory=2**28)
    grown = {"memory": 2**29, "threads": 40, "files": 60}
    for name, value in grown.items():
        soak = command.Soak(cast(World, None), Random(1), 0.0)
        soak._uses = [{"node": replace(use, **{name: value * 10})}, {"node": use}, {"node": use}]
        soak._check_growth()
        soak._uses.append({"node": replace(use, **{name: value})})
        with pytest.raises(AssertionError, match=r"node: growing (memory|threads|files)"):
            soak._check_growth()
