"""The harness itself: what it starts is as if typed in a shell, however the suite was started."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from pathlib import Path

import pytest

from tests.harness import PYTHON, ROOT, Graph, Process, proc
from tests.terminal import Terminal

SHOW = ["grep", "SigIgn", "/proc/self/status"]


def ignored(shown: str) -> set[int]:
    """The signals that a process ignores which has run SHOW."""
    found = re.search(r"SigIgn:\s*([0-9a-f]+)", shown)
    assert found, shown
    return {number for number in signal.valid_signals() if int(found[1], 16) >> (number - 1) & 1}


@pytest.mark.parametrize("way", ["Process", "Graph.run", "Terminal", "subprocess"])
def test_children_have_default_signals(way: str, tmp_path: Path) -> None:
    proc()
    if way == "Process":
        with Process(SHOW, dict(os.environ)) as process:
            assert process.wait() == 0
            shown = process.out
    elif way == "Graph.run":
        shown = Graph("http://127.0.0.1:1", tmp_path).run(*SHOW).stdout
    elif way == "Terminal":
        with Terminal(SHOW, dict(os.environ)) as terminal:
            assert terminal.end() == 0
            shown = terminal.shown
    else:
        shown = subprocess.run(SHOW, capture_output=True, text=True, check=True).stdout
    assert ignored(shown) == set()


@pytest.mark.parametrize("workers", ["-n0", "-n1"])
def test_also_under_nohup_and_in_the_background_of_a_script(workers: str, tmp_path: Path) -> None:
    """The suite within the suite: that of above, where the one who starts it ignores what can be ignored."""
    pytest.importorskip("xdist")
    tests = f"{PYTHON} -m pytest {workers} -p no:cacheprovider {__file__} -k default"
    command = f"trap '' HUP INT QUIT TERM USR1; exec {tests}"
    done = subprocess.run(["bash", "-c", command], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "4 passed" in done.stdout, done.stdout
