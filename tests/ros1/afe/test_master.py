"""A master that is restarted, or hangs for a while: the nodes still serve clients, and register again."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import rosgraph
from rospy.impl.registration import Registration

from rosafe.ros1.transport import registration
from rosafe.ros1.transport.succession import Succession
from tests.harness import PYTHON, ROOT, Graph, MasterProcess, freeze, wait_for


def kill(graph: Graph, master: MasterProcess) -> Callable[[], None]:
    """Kill the master. Return a function that starts another one at the same address."""
    master.kill()
    return lambda: master.start(graph.env)


def hang(graph: Graph, master: MasterProcess) -> Callable[[], None]:
    """Stop the master, so that clients wait for an answer. Return a function that continues it."""
    assert master.process is not None
    pid = master.process.pid
    freeze(pid)
    return lambda: os.kill(pid, signal.SIGCONT)


def assert_all_is_registered(graph: Graph, clients: list[str], path: str) -> None:
    """Check that a new client finds services, topics and parameters, and receives audio from bass."""
    done = graph.run(*clients, "come", "/rosAFE", PYTHONPATH=path)
    assert json.loads(done.stdout.splitlines()[-1]) == {
        "processors": ["input", "preProc", "late"],
        "topics": ["/rosAFE/gammatonePort/late", "/rosAFE/preProcPort/preProc"],
        "removed": True,
        "left": [],
    }


@pytest.mark.parametrize("lose", [kill, hang])
def test_a_master_is_lost_and_returns(
    private_graph: tuple[Graph, MasterProcess], tmp_path: Path, lose: Callable[..., Callable[[], None]]
) -> None:
    """Without a master, only requests that need it are rejected; afterwards everything is registered again."""
    graph, master = private_graph
    lost = tmp_path / "lost"
    clients = [PYTHON, "-m", "tests.ros1.afe.master_clients"]
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
        if lose is kill:  # a new master has only the registrations that it received
            assert_all_is_registered(graph, clients, path)
        assert readers <= graph.readers(), "actions are registered, too"
        for node in (afe, bass):
            assert node.stop(signal.SIGTERM) == 0
            assert "Traceback" not in node.err, node.err
        assert not {"/rosAFE", "/bass"} & graph.nodes()


@pytest.mark.parametrize("in_time", [True, False])
def test_the_end_waits_a_limited_time_for_a_registration_in_progress(graph: Graph, in_time: bool) -> None:
    """Also if the master did not answer before: it could carry it out after the node has unregistered everything."""
    limits: list[float] = []

    class Lock:
        """The lock that the registering thread holds during a call."""

        def acquire(self, timeout: float) -> bool:
            limits.append(timeout)
            return in_time

        def release(self) -> None:
            assert in_time

    succession = Succession("/ending", graph.uri)
    manager = SimpleNamespace(handler=SimpleNamespace(succession=succession), master_uri=graph.uri, uri="http://a:1/")
    registrar = registration.Registrar(manager)
    registrar._name, registrar._master_lost = "/ending", True
    registrar.reg_added("/ending/topic", "std_msgs/String", Registration.PUB)
    registrar._update_master(dict(registrar._offered))
    registrar.reg_removed("/ending/topic", "std_msgs/String", Registration.PUB)
    assert "/ending/topic" in graph.topics()
    setattr(succession, "registration_lock", Lock())  # noqa: B010  # of another type
    registrar.end()
    assert limits == [registration.SETTLE_SECONDS]
    assert ("/ending/topic" in graph.topics()) == (not in_time)
    rosgraph.Master("/ending", master_uri=graph.uri).unregisterPublisher("/ending/topic", "http://a:1/")


def test_the_end_does_not_wait_for_a_master(private_graph: tuple[Graph, MasterProcess]) -> None:
    graph, master = private_graph
    with graph.node("rosAFE-ros") as node:
        bring_back = hang(graph, master)
        try:
            assert node.stop(signal.SIGTERM) == 0
        finally:
            bring_back()
        wait_for(lambda: "/rosAFE" not in graph.nodes(), what="the master receives the end later")


DEAD_CLIENTS = """
import logging, socket, struct, time
from rosafe.ros1.transport.master import PrivateMaster, proxy
records = []
for name in ("xmlrpc", "rosmaster.threadpool"):
    logging.getLogger(name).addFilter(lambda record: records.append(record.name) or True)
with PrivateMaster() as master:
    address = "127.0.0.1", int(master.uri.rsplit(":", 1)[1])
    client = socket.create_connection(address)
    client.sendall(b"POST / HT")
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()  # with a reset
    server = proxy(master.uri)
    server.registerSubscriber("/dead", "/topic", "*", "http://127.0.0.1:9")  # no process listens there
    server.registerPublisher("/dead", "/topic", "std_msgs/Empty", "http://127.0.0.1:9")
    while len(set(records)) < 2:
        time.sleep(0.01)
"""


def test_a_private_master_prints_nothing_about_dead_clients(graph: Graph) -> None:
    """A program that runs one in its process, such as the demo, has a clean stderr."""
    done = graph.run(PYTHON, "-c", DEAD_CLIENTS, PYTHONPATH=str(ROOT))
    assert (done.stdout, done.stderr) == ("", "")
