"""The status of action servers: periodic, so that clients find the server at any time, and cheap."""

from __future__ import annotations

import itertools
import shutil
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import actionlib
import pytest
import rospy
from actionlib_msgs.msg import GoalStatusArray

import bass.msg
from rosafe.ros1.component import action_server, generate
from rosafe.ros1.component.action_server import DEFAULT_FREQUENCY, StatusPublisher
from rosafe.ros1.transport.publisher import BufferList
from tests.harness import PATIENCE, PYTHON, Graph, wait_for

GENERATOR = Path("/usr/lib/gencpp/gen_cpp.py")
HEADER = Path("/usr/include/actionlib/client/simple_action_client.h")


def periods(graph: Graph, topic: str, count: int = 8) -> list[float]:
    """Return the seconds between the stamps of messages of a topic, without the latched one."""
    with graph.collect(topic, GoalStatusArray) as messages:
        wait_for(lambda: len(messages) > count + 1)
        headers = [message.header for message in messages]
    sequence = [header.seq for header in headers]
    assert sequence[1:] == sorted(set(sequence[1:]))
    return [after.stamp.to_sec() - before.stamp.to_sec() for before, after in itertools.pairwise(headers[1:])]


def assert_frequency(graph: Graph, topic: str, frequency: float) -> None:
    """Check the period between messages; on a busy machine some are late."""
    shortest, mean = min(found := periods(graph, topic)), sum(found) / len(found)
    assert shortest < 1.4 / frequency and mean > 0.6 / frequency, found


def test_the_status_is_published_five_times_a_second(graph: Graph, bass_node: Any) -> None:
    assert_frequency(graph, "/bass/Acquire/status", 5)


@pytest.mark.parametrize(("given", "frequency"), [(20, 20), ("often", DEFAULT_FREQUENCY)])
def test_the_parameter(graph: Graph, given: Any, frequency: float) -> None:
    graph.client()
    rospy.set_param("/other/actionlib_status_frequency", given)
    with graph.node("bass-ros", "-i", "other") as node:
        assert_frequency(graph, "/other/Acquire/status", frequency)
        assert ("actionlib_status_frequency: expected" in node.err) == (given != frequency)
    rospy.delete_param("/other/actionlib_status_frequency")


def test_a_frequency_beyond_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rospy, "logwarn", lambda text: None)
    assert action_server._frequency(1e9) == DEFAULT_FREQUENCY


def test_no_status_in_periods(graph: Graph) -> None:
    """0 or nearly 0, as in any action server: only the latched message, and one for each change."""
    graph.client()
    with ExitStack() as stack:
        nodes, messages = [], []
        for name, frequency in (("never", 0), ("rare", 1e-12)):
            rospy.set_param(f"/{name}/actionlib_status_frequency", frequency)
            nodes.append(stack.enter_context(graph.node("bass-ros", "-i", name)))
            messages.append(stack.enter_context(graph.collect(f"/{name}/Acquire/status", GoalStatusArray)))
            rospy.delete_param(f"/{name}/actionlib_status_frequency")
        states = stack.enter_context(graph.collect("/rare/genom_state", bass.msg.genom_state_component))
        wait_for(lambda: len(states) >= 4 and all(messages))
        assert [len(received) for received in messages] == [1, 1]
        assert not any("Traceback" in node.err for node in nodes)


def test_a_second_client_in_one_process(graph: Graph, bass_node: Any) -> None:
    graph.client()
    for _ in range(2):
        client = actionlib.SimpleActionClient("/bass/Acquire", bass.msg.AcquireAction)
        assert client.wait_for_server(rospy.Duration(PATIENCE))


@pytest.mark.exploration  # compiles for several seconds
def test_two_roscpp_clients_in_one_process(graph: Graph, bass_node: Any, tmp_path: Path) -> None:
    if not (GENERATOR.exists() and HEADER.exists() and shutil.which("g++")):
        pytest.skip("roscpp is not here: scripts/install --tests brings g++, gencpp and libactionlib-dev")
    share = Path(generate.environment()["ROS_PACKAGE_PATH"].split(":")[0])
    packages = {"bass": share / "bass/msg", **{p: Path("/usr/share", p, "msg") for p in ("actionlib_msgs", "std_msgs")}}
    include = [f"-I{package}:{folder}" for package, folder in packages.items()]
    for part in ("Action", "Goal", "ActionGoal", "Result", "ActionResult", "Feedback", "ActionFeedback"):
        message = packages["bass"] / f"Acquire{part}.msg"
        output = ["-p", "bass", "-o", str(tmp_path / "bass"), "-e", "/usr/share/gencpp"]
        graph.run(PYTHON, str(GENERATOR), str(message), *include, *output)
    source, program = Path(__file__).with_name("two_clients.cpp"), tmp_path / "two_clients"
    libraries = ["-lactionlib", "-lroscpp", "-lrosconsole", "-lroscpp_serialization", "-lrostime", "-lboost_thread"]
    graph.run("g++", "-O0", f"-I{tmp_path}", str(source), "-o", str(program), *libraries, "-lpthread", timeout=300)
    done = graph.run(str(program), "/bass/Acquire", timeout=100)
    assert done.stdout.startswith('1 1 1 0 {"ex":"::bass::e_device"'), done


class Counted:
    """An action server that counts the calls to publish its status."""

    frequency = 1000.0

    def __init__(self) -> None:
        self.request_values = 0
        self.in_use = False

    def publish_again(self, idle: BufferList) -> bool:
        self.request_values += 1
        return self.in_use


def test_unused_servers_need_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread sleeps while no server has a goal or a subscriber."""
    monkeypatch.setattr(action_server, "MAX_FREQUENCY", 1000.0)
    monkeypatch.setattr(rospy.Time, "now", lambda: rospy.Time(1))
    finished = threading.Event()
    statuses, server = StatusPublisher(finished), Counted()
    statuses._servers.append(server)  # type: ignore[arg-type]
    thread = threading.Thread(target=statuses.run)
    thread.start()
    for _ in range(2):
        server.in_use, reads = True, server.request_values
        statuses._in_use.set()
        wait_for(lambda: server.request_values >= reads + 5)  # noqa: B023
        server.in_use = False
        wait_for(lambda: not statuses._in_use.is_set())
        reads = server.request_values
        assert not finished.wait(0.05) and server.request_values <= reads + 1
    finished.set()
    statuses._in_use.set()
    thread.join()
