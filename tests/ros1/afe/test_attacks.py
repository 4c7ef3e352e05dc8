"""Attacks on the ports of running nodes: silence, garbage, floods and wrong lengths do not affect other clients."""

from __future__ import annotations

import io
import re
import resource
import socket
import threading
import xmlrpc.client
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple

import pytest
import rosAFE.msg
import rospy
from actionlib_msgs.msg import GoalID
from rosgraph.network import encode_ros_handshake_header
from std_msgs.msg import Header, String

import bass.msg
from rosafe.audio.files.windows import MAX_WINDOW
from rosafe.ros1.transport import handshake_server, received_data
from tests.harness import PATIENCE, PYTHON, Graph, proc, python_path, wait_for
from tests.ros1.afe.attacker import HUGE, FakePublisher, Target, answer, flood, length, publisher_header
from tests.ros1.afe.session import Session, noise, own_node


@contextmanager
def node(graph: Graph, component: str, name: str) -> Iterator[Target]:
    with graph.node(f"{component}-ros", "-i", name) as process:
        yield Target(graph, process, name)


@pytest.fixture(scope="module", params=["rosAFE", pytest.param("bass", marks=pytest.mark.exploration)])
def target(graph: Graph, request: pytest.FixtureRequest) -> Iterator[Target]:
    """Provide a node, which must be healthy after the test; both have the same servers."""
    with node(graph, request.param, f"{request.param}_attacked") as target:
        yield target


# --- one table of clients ---------------------------------------------------------------------------------------


class Misbehaviour(NamedTuple):
    """A client that sends `data`, then `flood` until the node stops reading; the node closes the connection."""

    port: str
    data: bytes
    log: str = ""  # pattern of the line in the log
    answer: bytes = b""  # a part of the data from the node
    flood: bytes = b""


def post(body: bytes, fields: bytes = b"") -> bytes:
    return b"POST / HTTP/1.1\r\nConnection: close\r\n%sContent-Length: %d\r\n\r\n%s" % (fields, len(body), body)


def misbehaviours(name: str) -> Iterator[Misbehaviour]:
    """Yield all clients of a node."""

    def client(service: str, data: bytes = b"", **fields: str) -> bytes:
        given = {"service": f"/{name}/{service}", "md5sum": "*", "callerid": "/attacker", **fields}
        return encode_ros_handshake_header(given) + data

    silent = r"127.0.0.1: sent nothing for 5 s"
    header = r"TCPROS: 127.0.0.1: header: expected at most 65536 bytes, got \d+; this is not ROS"
    request = rf"/{name}/Stop: 127.0.0.1: request: expected at most \d+ bytes, got \d+"
    for port in ("TCPROS", "XML-RPC"):
        yield Misbehaviour(port, b"", f"{port}: {silent}")
        yield Misbehaviour(port, bytes(100))
    # TCPROS headers
    yield Misbehaviour("TCPROS", length(40), "127.0.0.1: sent only 4 bytes for 5 s")
    for data in (b"GET / HTTP/1.1\r\nHost: node\r\n\r\n", b"\xff" * 100):
        yield Misbehaviour("TCPROS", data, header)
    yield Misbehaviour("TCPROS", length(HUGE), header, flood=bytes(10**6))
    yield Misbehaviour("TCPROS", length(30) + length(1000) + bytes(26))
    yield Misbehaviour("TCPROS", length(14) + length(10) + b"\xff\xfe=\xff\xfe\xff\xfe\xff\xfe\xff")
    yield Misbehaviour("TCPROS", length(0))
    padding = "x" * (received_data.HEADER_BYTES + 4 - len(client("connect_service", padding="")))
    longest = client("connect_service", length(8) + bytes(8), padding=padding)
    yield Misbehaviour("TCPROS", longest, answer=b"no_such_remote")
    yield Misbehaviour("TCPROS", client("connect_service", padding=padding + "x"), header)
    for caller in ("/evil\x01name", "/" + "x" * 5000):  # `rosnode info` gets the names of subscribers in XML
        fields = {"topic": f"/{name}/genom_state", "md5sum": "*", "callerid": caller}
        yield Misbehaviour("TCPROS", encode_ros_handshake_header(fields), answer=b"callerid: expected a name")
    # service requests
    for size in (HUGE, 2**21):
        yield Misbehaviour("TCPROS", client("Stop", length(size)), request, flood=bytes(10**6))
    for data in (b"", length(16384) + b"x"):
        yield Misbehaviour(
            "TCPROS", client("connect_port", data), f"/{name}/connect_port: .* no complete request within"
        )
    yield Misbehaviour("TCPROS", client("connect_port", length(8), persistent="1"))
    for garbage in (b"", b"x", length(HUGE) + b"x", b"\xff" * 5000):
        data = client("connect_port", length(len(garbage)) + garbage)
        yield Misbehaviour("TCPROS", data, answer=b"service cannot process request")
    # XML-RPC
    yield Misbehaviour("XML-RPC", b"POST / HTTP/1.1\r\nContent-Length: 100\r\n\r\n<?xml")
    too_long = r"XML-RPC: 127.0.0.1: HTTP request: expected at most 262144 bytes, got \d+"
    yield Misbehaviour(
        "XML-RPC", b"POST / HTTP/1.1\r\nContent-Length: 4000000000\r\n\r\n", too_long, flood=bytes(10**6)
    )
    headers = "XML-RPC: 127.0.0.1: HTTP headers: expected at most 16384 bytes"
    yield Misbehaviour("XML-RPC", b"POST / HTTP/1.1\r\n", headers, flood=b"x: y\r\n" * 10**5)
    yield Misbehaviour("XML-RPC", b"", headers, flood=b"x" * 10**6)
    packed = post(b"<value><i4>1</i4></value>" * 10, b"Content-Encoding: gzip\r\n")
    yield Misbehaviour("XML-RPC", packed, answer=b"HTTP/1.1 501")
    call = xmlrpc.client.dumps(([{"methodName": "getBusInfo", "params": ["/evil"]}] * 100,), "system.multicall")
    deep = "<methodCall><methodName>getPid</methodName><params><param>" + "<value><array><data>" * 8000
    for text in (call, deep):
        yield Misbehaviour("XML-RPC", post(text.encode()), answer=b"<fault>")
    body = xmlrpc.client.dumps(("/hasty",), "getPid").encode()  # a client that does not read its answers
    yield Misbehaviour("XML-RPC", b"", flood=post(body).replace(b"Connection: close\r\n", b"") * 1000)


def test_no_client_affects_the_others(target: Target) -> None:
    """Each is closed within seconds, also all of them at once, and repetitions of a kind are one line in the log."""
    table = list(misbehaviours(target.name))
    with target.logs_once(*{one.log for one in table if one.log}), target.needs_no_resources(), ExitStack() as stack:
        patient = stack.enter_context(target.client("connect_service", persistent="1"))  # silent between two requests
        connections = []
        for one in table:
            sock = stack.enter_context(target.connect(one.port, one.data))
            assert not one.flood or flood(sock, one.flood) < 50e6, one
            connections.append(sock)
            target.assert_healthy()
        for one, sock in zip(table, connections, strict=True):
            assert one.answer in answer(sock), one
        patient.sendall(length(8) + bytes(8))
        assert b"no_such_remote" in patient.recv(4096)


# --- descriptors ------------------------------------------------------------------------------------------------


def test_the_soft_limit_is_raised(target: Target) -> None:
    limits = proc(target.process.pid, "limits").read_text()
    soft, hard = re.findall(r"^Max open files +(\d+) +(\d+)", limits, re.MULTILINE)[0]
    assert int(soft) == min(handshake_server.DESCRIPTORS, int(hard)) or int(soft) > handshake_server.DESCRIPTORS


def test_without_descriptors_the_node_waits_and_continues(target: Target) -> None:
    """Subscribers that never read use all descriptors; after their end all waiting clients are served."""
    pid = target.process.pid
    original_limit = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    try:
        with target.needs_no_resources(), ExitStack() as stack:
            limit = target.descriptors + 60
            resource.prlimit(pid, resource.RLIMIT_NOFILE, (limit, original_limit[1]))
            for number in range(limit + 50):
                stack.enter_context(target.subscribe("genom_state", f"/deaf{number}", wait=False))
            wait_for(lambda: target.logged("TCPROS: all"), what=lambda: str(target.process))
            assert target.descriptors < limit, "some are reserved for the node itself"
            stack.close()
            target.assert_healthy()
    finally:
        resource.prlimit(pid, resource.RLIMIT_NOFILE, original_limit)
    line = f"TCPROS: all {limit} file descriptors are in use: new connections wait"
    assert target.logged(line) == target.logged("TCPROS: file descriptors for connections are available again") == 1


# --- publishers -------------------------------------------------------------------------------------------------

AUDIO = rosAFE.msg.binaudio_portStruct


@pytest.fixture(scope="module")
def listening(graph: Graph) -> Iterator[tuple[Session, Target]]:
    with own_node(graph, name="listening") as session:
        yield session, Target(graph, session.process, session.name)


@pytest.fixture
def afe(listening: tuple[Session, Target]) -> tuple[Session, Target]:
    """Provide a node without processors, and the same node as a target."""
    listening[0].ok("Stop")
    return listening


@pytest.mark.parametrize("behaviour", ["header", "message", "answer"])
def test_a_publisher_with_wrong_lengths_is_disconnected(
    afe: tuple[Session, Target], graph: Graph, behaviour: str
) -> None:
    """Lengths of its header, of a message, of its response to requestTopic; audio of other publishers still arrives."""
    session, target = afe
    poured: list[int] = []

    def behave(sock: socket.socket) -> None:
        if behaviour == "message":
            sock.sendall(publisher_header(AUDIO, "/evil/Audio"))
        sock.sendall(length(HUGE if behaviour == "header" else 2**28))
        poured.append(flood(sock, bytes(10**6)))

    def request_topic(port: int) -> Any:
        return 1, "", ["TCPROS", "x" * 40_000_000 if behaviour == "answer" else "127.0.0.1", port]

    session.build("PreProc")  # the first one allocates memory that is kept
    session.ok("Stop")
    with (
        target.needs_no_resources(megabytes=60),
        FakePublisher(graph, "/evil/Audio", AUDIO._type, behave, request_topic) as evil,
    ):
        session.ok("connect_port", local="Audio", remote="/evil/Audio")
        if behaviour == "answer":
            wait_for(lambda: evil.calls)
        else:
            wait_for(lambda: poured, what=lambda: str(target.process))
            assert poured[0] < 40e6
        target.assert_healthy()
    session.listen()
    session.build("PreProc")
    line = {
        "header": "TCPROS: 127.0.0.1: header: expected at most 65536 bytes, got 4294967295",
        "message": "/evil/Audio: 127.0.0.1: message: expected at most \\d+ bytes, got 268435456",
    }
    if behaviour in line:
        assert target.logged(line[behaviour]) == 1, target.process


def test_all_texts_of_goals_are_bounded(afe: tuple[Session, Target], graph: Graph) -> None:
    """`frame_id`, the goal's id and the names in the request; the topics still work for other clients."""
    session, target = afe
    goal = rosAFE.msg.PreProcActionGoal
    long = "x" * 200_000
    topics = {
        "goal": [
            goal(header=Header(frame_id=long)),
            goal(goal_id=GoalID(id=long)),
            goal(goal=rosAFE.msg.PreProcGoal(name=long)),
        ],
        "cancel": [GoalID(id=long)],
    }
    for topic, messages in topics.items():
        for message in messages:
            name = f"/{session.name}/PreProc/{topic}"
            behaved = threading.Event()

            def behave(sock: socket.socket, message: Any = message, name: str = name) -> None:
                out = io.BytesIO()
                message.serialize(out)
                sock.sendall(publisher_header(message, name) + length(len(out.getvalue())) + out.getvalue())
                answer(sock)
                behaved.set()  # noqa: B023

            with FakePublisher(graph, name, message._type, behave):
                assert behaved.wait(PATIENCE), target.process
            assert target.logged(f"{name}: 127.0.0.1: message: expected at most") == 1
    session.listen()
    goal_of_mine = session.goal("InputProc", nFramesPerBlock=1600).active()
    session.ok("Stop")
    assert goal_of_mine.result().genom_success


def test_a_publisher_of_invalid_goals_does_not_affect_other_clients(afe: tuple[Session, Target], graph: Graph) -> None:
    session, target = afe
    goal = rosAFE.msg.InputProcActionGoal
    name = f"/{session.name}/InputProc/goal"
    came = threading.Semaphore(0)

    def behave(sock: socket.socket) -> None:
        sock.sendall(publisher_header(goal, name) + length(50) + b"\xff" * 50)
        came.release()
        answer(sock)

    with FakePublisher(graph, name, goal._type, behave):
        for _ in range(2):  # the node connects again
            assert came.acquire(timeout=PATIENCE)
        session.listen()
        own_goal = session.goal("InputProc", nFramesPerBlock=1600).active()
        session.ok("Stop")
        assert own_goal.result().genom_success
        target.assert_healthy()


def test_a_slightly_too_long_window_is_rejected_and_the_stream_continues(afe: tuple[Session, Target]) -> None:
    session, _ = afe
    microphone = session.listen()
    wait_for(lambda: microphone.subscribed)
    audio = session.health(lambda entries: int(entries["messages"]) > 0)
    before, refused = int(audio["messages"]), str(int(audio["refused"]) + 1)
    microphone.publish_bytes(bytes(20) + 2 * (length(MAX_WINDOW + 1) + bytes(4 * (MAX_WINDOW + 1))) + bytes(8))
    session.health(lambda entries: entries["refused"] == refused)
    microphone.play(noise(400))
    health = session.health(lambda entries: int(entries["messages"]) >= before + 2)
    assert health["refused"] == refused and microphone.subscribed


LISTENING = """
import os, sys, rospy
from rosafe.ros1.transport import registration
from bass.msg import binaudio_portStruct
from std_msgs.msg import String
registration.init_node("plain_listener", ["plain_listener"])
rospy.Subscriber(sys.argv[1], binaudio_portStruct, lambda m: os.write(1, f"audio {len(m.left)}\\n".encode()))
rospy.Subscriber(sys.argv[2], String, lambda m: os.write(1, f"text {len(m.data)}\\n".encode()))
rospy.spin()
"""


def test_subscribers_get_data_of_any_length(graph: Graph) -> None:
    """The limits of requests do not apply to audio or traces received with the generated classes."""
    graph.client()
    audio = rospy.Publisher("/long/audio", bass.msg.binaudio_portStruct, latch=True, queue_size=1)
    text = rospy.Publisher("/long/text", String, latch=True, queue_size=1)
    audio.publish(bass.msg.binaudio_portStruct(left=[1] * 44100, right=[2] * 44100))
    text.publish(String("x" * 1_000_000))
    with graph.start(PYTHON, "-c", LISTENING, "/long/audio", "/long/text", PYTHONPATH=python_path(graph)) as listener:
        wait_for(
            lambda: sorted(listener.out.splitlines()) == ["audio 44100", "text 1000000"],
            what=lambda: str(listener),
        )
    audio.unregister()
    text.unregister()
