"""The harness: children have default signals, however the suite was started; forks are as new processes; topics."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from pathlib import Path

import pytest
import rospy
from std_msgs.msg import Empty

from tests import conftest, fork_server, harness
from tests.harness import PYTHON, ROOT, Graph, Process, proc
from tests.terminal import Terminal

SHOW = ["grep", "SigIgn", "/proc/self/status"]


def ignored(shown: str) -> set[int]:
    """Return the signals ignored by the process that ran SHOW."""
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
def test_suite_that_ignores_signals(workers: str, tmp_path: Path) -> None:
    """Run the tests above in a process that ignores signals, as under nohup or in the background of a script."""
    pytest.importorskip("xdist")
    proc("self")  # the tests above read it
    tests = f"{PYTHON} -m pytest {workers} -p no:cacheprovider {__file__} -k default"
    command = f"trap '' HUP INT QUIT TERM USR1; exec {tests}"
    done = subprocess.run(["bash", "-c", command], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "4 passed" in done.stdout, done.stdout


def test_the_first_message_is_collected(graph: Graph) -> None:
    graph.client()
    publisher = rospy.Publisher("/of_the_test/first", Empty, queue_size=1)
    with graph.collect("/of_the_test/first", Empty) as messages:
        publisher.publish()
        harness.wait_for(lambda: len(messages) == 1, what="the first message")
    publisher.unregister()


# --- forks ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "command",
    [
        ["rosafe", "--version"],
        ["rosafe", "nonsense"],
        ["rosafe", "process", "missing.wav", "-o", "out.npz"],
        ["rosAFE-ros", "-i", "1left"],
        ["bass-ros", "-h"],
        ["genomixd", "--frobnicate"],
    ],
    ids=" ".join,
)
def test_a_fork_behaves_like_a_new_process(tmp_path: Path, command: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    graph = Graph("http://127.0.0.1:1", tmp_path)
    results = []
    for forks in (True, False):
        monkeypatch.setattr(harness, "forks", forks)
        assert harness.can_fork(command, graph.env) == forks
        done = graph.run(*command, check=False)
        results.append((done.returncode, done.stdout, done.stderr))
    assert results[0] == results[1]


def test_signals_reach_a_fork(tmp_path: Path) -> None:
    graph = Graph("http://127.0.0.1:1", tmp_path)
    for number, code in ((signal.SIGTERM, 0), (signal.SIGKILL, -signal.SIGKILL)):
        with graph.start("bass-ros", "--wait") as process:
            assert isinstance(process._popen, fork_server.ForkedProcess)
            harness.wait_for(lambda: "waiting for a ROS master" in process.err, what=lambda: str(process))
            assert os.getsid(process.pid) == process.pid
            assert process.stop(number) == code, process


def test_output_of_an_unbuffered_fork_is_visible_at_once(graph: Graph) -> None:
    """`rostopic hz` never flushes its output."""
    graph.client()
    publisher = rospy.Publisher("/of_the_test/unbuffered", Empty, queue_size=1)
    with graph.start("rostopic", "hz", publisher.resolved_name, PYTHONUNBUFFERED="1") as process:
        assert isinstance(process._popen, fork_server.ForkedProcess)
        harness.wait_for(lambda: "subscribed to" in process.out, what=lambda: str(process))
    publisher.unregister()


def test_programs_whose_imports_may_differ_are_not_forked(tmp_path: Path) -> None:
    env = Graph("http://127.0.0.1:1", tmp_path).env
    assert harness.can_fork(["bass-ros"], env)
    for command, changes in (
        (["bass-ros"], {"ROSAFE_PLUGINS": "/plugins"}),
        (["bass-ros"], {"PYTHONPATH": "/elsewhere"}),
        (["bass-ros", "__name:=left"], {}),
        (["bass-ros", "-b"], {}),
        (["/elsewhere/bass-ros"], {}),
        (["cat"], {}),
    ):
        assert not harness.can_fork(command, {**env, **changes}), (command, changes)


def test_variables_that_imported_tests_set_do_not_prevent_forks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    conftest.pytest_collection_finish()
    assert harness.can_fork(["bass-ros"], Graph("http://127.0.0.1:1", tmp_path).env)


def test_the_lists_of_conftest_name_existing_tests() -> None:
    for name in (*conftest.STARTING_FILES, *conftest.LONG_FILES, *conftest.LONGEST_FILES, *conftest.NO_KERNELS):
        assert (ROOT / "tests" / name).exists(), name
    for name in conftest.EACH_CASE:
        file, _, test = name.partition("::")
        assert f"def {test}(" in (ROOT / "tests" / file).read_text("utf-8"), name
