"""A master that is killed and started anew, or hangs and goes on: the nodes serve meanwhile, and are found again."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.harness import PYTHON, ROOT, Graph, MasterProcess, wait_for


def kill(graph: Graph, master: MasterProcess) -> Callable[[], None]:
    """Take the master away as a crash does; what it returns starts another one at the same address."""
    master.kill()
    return lambda: master.start(graph.env)


def hang(graph: Graph, master: MasterProcess) -> Callable[[], None]:
    """Stop the master: who connects waits for an answer. What it returns lets it go on."""
    assert master.process is not None
    pid = master.process.pid
    os.kill(pid, signal.SIGSTOP)
    return lambda: os.kill(pid, signal.SIGCONT)


def assert_all_is_there(graph: Graph, clients: list[str], path: str) -> None:
    """A client that comes now finds services, topics and parameters, and audio from bass."""
    done = graph.run(*clients, "come", "/rosAFE", PYTHONPATH=path)
    assert json.loads(done.stdout.splitlines()[-1]) == {
        "processors": ["input", "preProc", "late"],
        "topics": ["/rosAFE/gammatonePort/late", "/rosAFE/preProcPort/preProc"],
        "removed": True,
        "left": [],
    }


@pytest.mark.parametrize("lose", [kill, hang])
def test_a_master_is_lost_and_comes_back(
    private_graph: tuple[Graph, MasterProcess], tmp_path: Path, lose: Callable[..., Callable[[], None]]
) -> None:
    """Only what needs the master is refused while it is away; afterwards all is known to it that is there."""
    graph, master = private_graph
    lost = tmp_path / "lost"
    clients = [PYTHON, "-m", "tests.ros.master_clients"]
    path = f"{ROOT}:{graph.env['PYTHONPATH']}"
    with graph.node("rosAFE-ros") as afe, graph.node("bass-ros") as bass:
        before = graph.services()
        readers = graph.readers()
        with graph.start(*clients, "stay", "/rosAFE", str(lost), cwd=ROOT, PYTHONPATH=path) as client:
            wait_for(lambda: "ready" in client.out or not client.alive, what=lambda: str(client))
            bring_back = lose(graph, master)
            lost.touch()
            try:
                wait_for(lambda: not client.alive or "{" in client.out, what=lambda: f"{client} {afe}")
                wait_for(lambda: "no answer from the ROS master" in afe.err)
            finally:
                bring_back()
            seen: dict[str, Any] = json.loads(client.out.split("ready", 1)[-1] or "{}")
            assert seen == {
                "GammatoneProc": True,
                "connect_port": "::genom::port_io",
                "DedicatedSocket": "::genom::mwerr",
                "processors": ["input", "preProc", "other", "late"],
                "removed": True,
                "left": ["input", "preProc", "late"],
            }, client
            assert afe.err.count("no answer from the ROS master") == 1
        wait_for(lambda: before <= graph.services(), what=lambda: f"{before - graph.services()} {afe} {bass}")
        wait_for(lambda: "/rosAFE/gammatonePort/late" in graph.topics())
        wait_for(lambda: "/rosAFE/preProcPort/other" not in graph.topics())
        if lose is kill:  # another master knows nothing but what it was told
            assert_all_is_there(graph, clients, path)
        assert readers <= graph.readers(), "actions are back too"
        for node in (afe, bass):
            assert node.stop(signal.SIGTERM) == 0
            assert "Traceback" not in node.err, node.err
        assert not {"/rosAFE", "/bass"} & graph.nodes()


def test_the_end_does_not_wait_for_a_master(private_graph: tuple[Graph, MasterProcess]) -> None:
    graph, master = private_graph
    with graph.node("rosAFE-ros") as node:
        bring_back = hang(graph, master)
        try:
            assert node.stop(signal.SIGTERM) == 0
        finally:
            bring_back()
        wait_for(lambda: "/rosAFE" not in graph.nodes(), what="the master hears of the end when it can")
