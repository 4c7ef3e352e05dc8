"""A second node of the same name: the new node runs, and the old one ends with a message, whatever it was doing."""

from __future__ import annotations

import threading
import xmlrpc.client
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import rosgraph
import rosmaster.master_api
import rosservice

from rosafe import interface
from rosafe.ros1.transport.succession import REASON, MasterProxy, Succession
from tests.harness import SCRIPTS, Graph, Process, wait_for

pytestmark = pytest.mark.forks  # the start of the processes does not matter


def owner(graph: Graph, name: str) -> str:
    """Return the address of a node that is registered at the master, or an empty string."""
    try:
        return str(rosgraph.Master("/test", master_uri=graph.uri).lookupNode(name))
    except rosgraph.MasterError:
        return ""


def pid(graph: Graph, name: str) -> int:
    """Return the process that answers at the registered address of a node, or 0."""
    address = owner(graph, name)
    try:
        answer: Any = xmlrpc.client.ServerProxy(address).getPid("/test") if address else (0, "", 0)
        return int(answer[2])
    except OSError:
        return 0


def taken_over(graph: Graph, component: interface.ComponentSpec, old: Process, new: Process) -> None:
    """Check that `new` has replaced `old`: its name, its services, its actions."""
    name = f"/{component.name}"
    assert old.wait() == 0
    assert old.out.count(REASON) == 1 and "Traceback" not in old.err
    wait_for(lambda: "ready as" in new.err, what=lambda: str(new))
    served = {f"{name}/{service.name}" for service in component.on_graph}
    goals = {(f"{name}/{activity.name}/goal", name) for activity in component.activities}
    wait_for(lambda: served <= graph.services() and goals <= graph.readers(), what=lambda: str(new))
    assert new.alive and pid(graph, name) == new.pid
    state = rosgraph.Master("/test", master_uri=graph.uri)
    assert len({state.lookupService(service) for service in served}) == 1
    assert name in graph.run("rosnode", "list").stdout.split()
    assert graph.call(f"{name}/Stop").genom_success
    assert new.alive and pid(graph, name) == new.pid


def test_bass_that_acquires_and_is_recorded(graph: Graph, tmp_path: Path) -> None:
    """Its last line in the log must not register it again."""
    with graph.node("bass-ros") as old:
        assert graph.call("/bass/Acquire", device="scene:").genom_success
        with graph.start("rosafe", "record", str(tmp_path / "sound.wav")) as recorder:
            wait_for(lambda: any(topic == "/bass/Audio" for topic, _ in graph.readers()), what=lambda: str(recorder))
            with graph.start("bass-ros") as new:
                taken_over(graph, interface.BASS, old, new)


def test_rosafe_with_a_tree_that_changes_permanently(graph: Graph) -> None:
    """It registers new ports while the new node registers itself."""
    ended = threading.Event()

    def change() -> None:
        while not ended.is_set():
            try:
                graph.call("/rosAFE/RatemapProc", name="again", upperDepName="innerhaircell_0")
                graph.call("/rosAFE/removeProcessor", nameProc="again")
            except Exception:  # neither node is available
                ended.wait(0.02)

    with graph.node("bass-ros"), graph.node("rosAFE-ros") as old:
        assert graph.call("/bass/Acquire", device="scene:").genom_success
        assert graph.call("/rosAFE/connect_port", local="Audio", remote="bass/Audio").genom_success
        assert graph.call("/rosAFE/request", representation="ild").genom_success
        changing = threading.Thread(target=change)
        changing.start()
        try:
            wait_for(lambda: "/rosAFE/ratemapPort/again" in graph.topics())
            with graph.start("rosAFE-ros") as new:
                taken_over(graph, interface.ROSAFE, old, new)
        finally:
            ended.set()
            changing.join()


def test_one_of_three_concurrent_nodes_remains(graph: Graph) -> None:
    """Concurrent nodes interrupt each other. The others report this and end with 1, or with 0 after their start."""
    processes = [graph.start("bass-ros", "-i", "crowd") for _ in range(3)]
    try:
        wait_for(lambda: sum(process.alive for process in processes) == 1, what=lambda: str(processes))
        left = next(process for process in processes if process.alive)
        wait_for(lambda: "/crowd/kill" in graph.services() and pid(graph, "/crowd") == left.pid, what=lambda: str(left))
        for process in processes:
            if process is not left:
                assert process.wait() == int("ready as" not in process.err), process
                assert "Traceback" not in process.err
        # the others may have removed registrations at their end; the remaining node repeats them
        wait_for(lambda: rosservice.get_service_type("/crowd/Stop"), what=lambda: str(left))
        assert graph.call("/crowd/Stop").genom_success and left.alive
    finally:
        for process in processes:
            process.close()


# --- one that cannot start --------------------------------------------------------------------------------------


def failing(graph: Graph, tmp_path: Path, script: str) -> Process:
    """A bass-ros in which `script` runs first."""
    program = tmp_path / "node"
    program.write_text(
        f"#!/usr/bin/python3\nimport sys\nsys.path.insert(0, {str(SCRIPTS.parent)!r})\n{script}\n"
        "from rosafe.ros1.bass.node import main\nsys.exit(main(['-i', 'failing']))\n"
    )
    program.chmod(0o755)
    return Process([str(program)], graph.env)


@pytest.mark.parametrize(
    ("script", "message"),
    [
        (  # rospy is shut down during its start
            """
import rospy
import rospy.impl.simtime as simtime
real = simtime.init_simtime
simtime.init_simtime = lambda: rospy.signal_shutdown("on request") or real()
""",
            "cannot start the node: it was asked to end",
        ),
        (  # a newer node is registered while this one creates its services
            """
import xmlrpc.client, os
import rosafe.ros1.component.component as component
def start(self):
    master = xmlrpc.client.ServerProxy(os.environ["ROS_MASTER_URI"])
    master.registerPublisher("/failing", "/anything", "std_msgs/String", "http://127.0.0.1:1/")
    real(self)
real = component.ComponentNode.start
component.ComponentNode.start = start
""",
            "cannot start the node: another node has started as /failing meanwhile",
        ),
    ],
)
def test_a_node_that_is_ended_while_it_starts_has_failed(
    graph: Graph, tmp_path: Path, script: str, message: str
) -> None:
    """With the exit status at which systemd starts it again."""
    with failing(graph, tmp_path, script) as node:
        assert node.wait() == 1, node
        assert node.err.splitlines()[-1].endswith(message), node
        assert "Traceback" not in node.err
    rosgraph.Master("/failing", master_uri=graph.uri).unregisterPublisher("/anything", "http://127.0.0.1:1/")


# --- the rule ---------------------------------------------------------------------------------------------------

OWN, OLD, NEW = "http://127.0.0.1:1/", "http://127.0.0.1:2/", "http://127.0.0.1:3/"


@contextmanager
def registered(graph: Graph, address: str) -> Iterator[None]:
    master = rosgraph.Master("/contested", master_uri=graph.uri)
    master.registerPublisher("/contested/topic", "std_msgs/String", address)
    try:
        yield
    finally:
        master.unregisterPublisher("/contested/topic", address)


@pytest.mark.parametrize(
    ("address", "up", "ignores"),
    [
        (OLD, False, True),  # the last registration of the old node was late
        (OLD, True, True),
        (OWN, False, True),  # two nodes start, and this one was registered last
        (OWN, True, True),  # it has registered after the one that caused the request, and the request arrives late
        (NEW, False, False),
        (NEW, True, False),
    ],
)
def test_a_request_to_end_that_is_ignored(graph: Graph, address: str, up: bool, ignores: bool) -> None:
    with registered(graph, OLD):
        succession = Succession("/contested", graph.uri)
    contests: list[bool] = []
    succession.on_contest = lambda: contests.append(True)
    succession.up = up
    with registered(graph, address):
        assert succession.ignores(OWN) == ignores
        assert (succession.over, bool(contests)) == (not ignores, ignores)


def test_rospy_registers_nothing_after_the_name_was_lost(graph: Graph) -> None:
    """rospy registers its own topics and services while the node starts."""
    proxy = MasterProxy(graph.uri)
    proxy.succession = Succession("/contested", graph.uri)
    topic = ("/contested", "/contested/topic", "std_msgs/String", OWN)
    assert proxy.registerPublisher(*topic)[0] == 1
    assert proxy.lookupNode("/contested", "/contested") == [1, "node api", OWN]
    assert proxy.unregisterPublisher("/contested", topic[1], OWN)[0] == 1
    proxy.succession.over = True
    assert proxy.registerPublisher(*topic)[0] == 1
    assert proxy.lookupNode("/contested", "/contested")[0] == -1


def test_the_log_registers_nothing(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    """rospy would subscribe to a parameter for each line."""
    subscribed: list[Any] = []
    real: Callable[..., Any] = rosmaster.master_api.ROSMasterHandler.subscribeParam

    def subscribe(self: Any, *arguments: Any) -> Any:
        subscribed.append(arguments)
        return real(self, *arguments)

    monkeypatch.setattr(rosmaster.master_api.ROSMasterHandler, "subscribeParam", subscribe)
    with graph.node("bass-ros", "-i", "logs") as node:
        assert graph.call("/logs/Acquire", device="scene:").genom_success
        assert graph.call("/logs/Stop").genom_success
        wait_for(lambda: "the acquisition has ended" in node.err)
        assert node.stop() == 0
    assert not [one for one in subscribed if one[0] == "/logs"]
