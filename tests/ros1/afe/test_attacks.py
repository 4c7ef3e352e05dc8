"""Attacks on the ports of running nodes: silence, garbage, floods and wrong lengths do not affect other clients."""

from __future__ import annotations

import contextlib
import io
import re
import resource
import socket
import threading
import xmlrpc.client
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest
import rosAFE.msg
import rospy
from actionlib_msgs.msg import GoalID
from rosgraph.network import encode_ros_handshake_header, read_ros_handshake_header
from std_msgs.msg import Header, String

import bass.msg
from rosafe.audio.files.windows import MAX_WINDOW
from rosafe.ros1.transport import handshake_server, received_data
from tests.harness import PATIENCE, PYTHON, Graph, proc, python_path, wait_for
from tests.ros1.afe.attacker import HUGE, FakePublisher, Target, closed, flood, length, publisher_header
from tests.ros1.afe.session import Session, noise, own_node

PORTS = ("TCPROS", "XML-RPC")


@contextmanager
def node(graph: Graph, component: str, name: str) -> Iterator[Target]:
    with graph.node(f"{component}-ros", "-i", name) as process:
        yield Target(graph, process, name)


BOTH = pytest.mark.parametrize("target", ["rosAFE", "bass"], indirect=True)


@pytest.fixture(scope="module", params=["rosAFE", pytest.param("bass", marks=pytest.mark.exploration)])
def target(graph: Graph, request: pytest.FixtureRequest) -> Iterator[Target]:
    """Provide a node, which must be healthy after the test; both have the same servers."""
    with node(graph, request.param, f"{request.param}_attacked") as target:
        yield target


# --- silence and garbage ----------------------------------------------------------------------------------------

OPENINGS = {
    "nothing": b"",
    "a length and no more": length(40),
    "half a request": b"POST / HTTP/1.1\r\nContent-Length: 100\r\n\r\n<?xml",
    "a request for a page": b"GET / HTTP/1.1\r\nHost: node\r\n\r\n",
    "ones": b"\xff" * 100,
    "zeros": bytes(100),
    "a header with wrong lines": length(30) + length(1000) + bytes(26),
    "a header that is no text": length(14) + length(10) + b"\xff\xfe=\xff\xfe\xff\xfe\xff\xfe\xff",
    "an empty header": length(0),
}


def test_incomplete_or_invalid_headers_do_not_block_other_clients(target: Target) -> None:
    """Also all of them at once; the node closes them within some seconds, and logs it."""
    lines = (
        "TCPROS: 127.0.0.1: sent nothing for 5 s",
        r"TCPROS: 127.0.0.1: header: expected at most 65536 bytes, got \d+; this is not ROS",
    )
    with target.logs_once(*lines), target.needs_no_resources(), ExitStack() as stack:
        open_ones = []
        for port in PORTS:
            for opening in OPENINGS.values():
                open_ones.append(stack.enter_context(target.connect(port, opening)))
                target.assert_healthy()
        for sock in open_ones:
            assert closed(sock)


def test_many_silent_or_slow_connections_do_not_block_other_clients(target: Target) -> None:
    """More than rospy could have open; some of them send single bytes."""
    line = "TCPROS: too many silent connections"
    with target.logs_once(line), target.needs_no_resources(), ExitStack() as stack:
        for port in PORTS:
            connections = [stack.enter_context(target.connect(port)) for _ in range(1200)]
            target.assert_healthy()
            for byte in (b"\x10", b"\0", b"\0"):
                for sock in connections[-200:]:
                    with contextlib.suppress(ConnectionError):
                        sock.sendall(byte)
                target.assert_healthy()
        assert target.descriptors < 2 * handshake_server.MAX_PENDING + 200, "the maximum number of waiting connections"


def test_the_longest_header_is_accepted(target: Target) -> None:
    fields = {"service": f"/{target.name}/connect_service", "md5sum": "*", "callerid": "/long", "padding": ""}
    fields["padding"] = "x" * (received_data.HEADER_BYTES - len(encode_ros_handshake_header(fields)) + 4)
    header = encode_ros_handshake_header(fields)
    assert header[:4] == length(received_data.HEADER_BYTES)
    with target.connect("TCPROS", header) as sock:
        assert "error" not in read_ros_handshake_header(sock, io.BytesIO(), 65536)
    longer = encode_ros_handshake_header({**fields, "padding": fields["padding"] + "x"})
    with target.connect("TCPROS", longer) as sock, contextlib.suppress(ConnectionResetError):
        assert sock.recv(100) == b""


def test_a_header_sent_byte_by_byte_is_accepted(target: Target) -> None:
    header = encode_ros_handshake_header(
        {"service": f"/{target.name}/connect_service", "md5sum": "*", "callerid": "/slow"}
    )
    request = length(8) + bytes(8)
    with target.connect("TCPROS") as sock:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for byte in header + request:  # the request is sent before the header is answered
            sock.sendall(bytes([byte]))
        answer = b""
        while b"no_such_remote" not in answer and (part := sock.recv(4096)):
            answer += part
        assert b"no_such_remote" in answer
    body = xmlrpc.client.dumps(("/slow",), "getPid").encode()
    call = b"POST / HTTP/1.1\r\nHost: node\r\nContent-Length: %d\r\n\r\n%s" % (len(body), body)
    with target.connect("XML-RPC") as sock:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for byte in call:
            sock.sendall(bytes([byte]))
        sock.sendall(call + call)  # two more at the same time, on the same connection
        answers = b""
        while answers.count(b"</methodResponse>") < 3:
            part = sock.recv(4096)
            assert part, answers
            answers += part
        assert answers.count(b"<int>%d</int>" % target.process.pid) == 3


# --- lengths ----------------------------------------------------------------------------------------------------


@BOTH
def test_excessive_lengths_are_rejected(target: Target) -> None:
    """Of headers, requests, HTTP bodies and HTTP headers; repetitions of each are one line in the log."""
    bomb = b"<value><i4>1</i4></value>" * 10
    lines = (
        r"TCPROS: 127.0.0.1: header: expected at most 65536 bytes, got \d+",
        rf"/{target.name}/Stop: 127.0.0.1: request: expected at most \d+ bytes, got \d+",
        r"XML-RPC: 127.0.0.1: HTTP request: expected at most 262144 bytes, got \d+",
        "XML-RPC: 127.0.0.1: HTTP headers: expected at most 16384 bytes",
    )
    with target.logs_once(*lines), target.needs_no_resources():
        for _ in range(3):
            with target.connect("TCPROS", length(HUGE)) as sock:
                assert flood(sock, bytes(10**6)) < 20e6
            for service in ("connect_port", "Stop", "get_loggers"):
                for size in (HUGE, 2**21):
                    with target.client(service) as sock:
                        sock.sendall(length(size))
                        assert flood(sock, bytes(10**6)) < 20e6
            with target.connect("XML-RPC", b"POST / HTTP/1.1\r\nContent-Length: 4000000000\r\n\r\n") as sock:
                assert flood(sock, bytes(10**6)) < 20e6
            with target.connect("XML-RPC", b"POST / HTTP/1.1\r\n") as sock:
                assert flood(sock, b"x: y\r\n" * 10**5) < 20e6
            with target.connect("XML-RPC") as sock:
                assert flood(sock, b"x" * 10**6) < 20e6
            packed = b"POST / HTTP/1.1\r\nContent-Encoding: gzip\r\nContent-Length: %d\r\n\r\n" % len(bomb)
            with target.connect("XML-RPC", packed + bomb) as sock:
                assert sock.recv(100).startswith(b"HTTP/1.1 501")


def test_incomplete_or_missing_requests(target: Target) -> None:
    """A client has some seconds for its request; only a persistent one may be silent, and only between requests."""
    lines = [
        f"/{target.name}/{name}: 127.0.0.1: no complete request within" for name in ("connect_port", "connect_service")
    ]
    with target.logs_once(*lines), target.needs_no_resources(), ExitStack() as stack:
        hanging = [stack.enter_context(target.client("connect_port")) for _ in range(20)]
        for sock in hanging[10:]:
            sock.sendall(length(16384) + b"x")
        patient = stack.enter_context(target.client("connect_service", persistent="1"))
        amid = stack.enter_context(target.client("connect_service", persistent="1"))
        amid.sendall(length(8))
        target.assert_healthy()
        body = xmlrpc.client.dumps(("/hasty",), "getPid").encode()
        call = b"POST / HTTP/1.1\r\nHost: node\r\nContent-Length: %d\r\n\r\n%s" % (len(body), body)
        unread = stack.enter_context(target.connect("XML-RPC"))
        assert flood(unread, call * 1000) < 50e6, (
            "no further request is read from a client that does not read its answers"
        )
        for sock in (*hanging, amid):
            assert closed(sock)
        patient.sendall(length(8) + bytes(8))
        assert b"no_such_remote" in patient.recv(4096)


@BOTH
def test_invalid_requests_get_an_answer(target: Target) -> None:
    with target.needs_no_resources():
        for garbage in (b"", b"x", length(HUGE) + b"x", b"\xff" * 5000):
            with target.client("connect_port") as sock:
                sock.sendall(length(len(garbage)) + garbage)
                answer = sock.recv(4096)
                assert answer[:1] == b"\0" and b"service cannot process request" in answer
        api: Any = xmlrpc.client.ServerProxy(target.api_uri)
        with pytest.raises(xmlrpc.client.Fault):
            api.system.multicall([{"methodName": "getBusInfo", "params": ["/evil"]}] * 100)
        deep = "<value><array><data>" * 8000
        body = f"<methodCall><methodName>getPid</methodName><params><param>{deep}".encode()
        with target.connect("XML-RPC", b"POST / HTTP/1.1\r\nContent-Length: %d\r\n\r\n" % len(body) + body) as sock:
            answer = b""
            while b"</methodResponse>" not in answer and (part := sock.recv(4096)):
                answer += part
            assert b"<fault>" in answer


def test_a_name_with_invalid_xml_characters_is_rejected(target: Target) -> None:
    """`rosnode info` gets the names of all subscribers in XML, which cannot contain such characters."""
    for caller in ("/evil\x01name", "/" + "x" * 5000):
        fields = {"topic": f"/{target.name}/genom_state", "md5sum": "*", "callerid": caller}
        with target.connect("TCPROS", encode_ros_handshake_header(fields)) as sock:
            assert read_ros_handshake_header(sock, io.BytesIO(), 4096)["error"] == "callerid: expected a name"
            assert closed(sock)


# --- descriptors ------------------------------------------------------------------------------------------------


def test_the_soft_limit_is_raised(target: Target) -> None:
    limits = proc(target.process.pid, "limits").read_text()
    soft, hard = re.findall(r"^Max open files +(\d+) +(\d+)", limits, re.MULTILINE)[0]
    assert int(soft) == min(handshake_server.DESCRIPTORS, int(hard)) or int(soft) > handshake_server.DESCRIPTORS


@BOTH
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


def test_1100_subscribers_that_never_read(target: Target) -> None:
    """More than the default limit of Debian; the next client is served as usual."""
    with target.needs_no_resources(megabytes=60), ExitStack() as stack:
        for number in range(1100):
            stack.enter_context(target.subscribe("genom_state", f"/deaf{number}"))
        target.assert_healthy()
        stack.close()
        wait_for(lambda: target.threads < 100, what=lambda: f"end of {target.threads} threads")


# --- publishers -------------------------------------------------------------------------------------------------

AUDIO = rosAFE.msg.binaudio_portStruct


@pytest.fixture
def afe(graph: Graph) -> Iterator[tuple[Session, Target]]:
    with own_node(graph, name="listening") as session:
        yield session, Target(graph, session.process, session.name)


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

    def answer(port: int) -> Any:
        return 1, "", ["TCPROS", "x" * 40_000_000 if behaviour == "answer" else "127.0.0.1", port]

    session.build("PreProc")  # the first one allocates memory that is kept
    session.ok("Stop")
    with (
        target.needs_no_resources(megabytes=60),
        FakePublisher(graph, "/evil/Audio", AUDIO._type, behave, answer) as evil,
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
                if closed(sock):
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
        closed(sock)

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
    before = int(session.health(lambda entries: int(entries["messages"]) > 0)["messages"])
    microphone.publish_bytes(bytes(20) + 2 * (length(MAX_WINDOW + 1) + bytes(4 * (MAX_WINDOW + 1))) + bytes(8))
    wait_for(lambda: session.health(lambda entries: entries["refused"] == "1"))
    microphone.play(noise(400))
    health = session.health(lambda entries: int(entries["messages"]) >= before + 2)
    assert health["refused"] == "1" and microphone.subscribed


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


# --- combined ------------------------------------------------------------------------------------------------


def test_a_mixed_load_causes_no_loss(graph: Graph) -> None:
    """30 subscribers that never read, clients that are killed, garbage on all ports, while audio is processed."""
    with node(graph, "bass", "bass_mixed") as bass, own_node(graph, name="mixed") as session:
        target = Target(graph, session.process, "mixed")
        target.graph.call(
            "/bass_mixed/Acquire", device="scene:", sampleRate=20000, nFramesPerChunk=1000, nChunksOnPort=60
        )
        session.ok("connect_port", local="Audio", remote="/bass_mixed/Audio")
        session.ok("InputProc", nFramesPerBlock=2000, bufferSize_s_port=0.1)  # several messages can wait for a reader
        for request in ("PreProc", "GammatoneProc"):
            session.ok(request)
        with ExitStack() as stack, session.follow("gammatone") as messages:
            for number in range(30):
                topic = ("gammatonePort/gammatone", "genom_state")[number % 2]
                stack.enter_context(target.subscribe(topic, f"/deaf{number}"))
            for turn in range(15):
                for attacked in (target, bass):
                    attacked.client("connect_port").close()
                    attacked.subscribe("genom_state", f"/dying{turn}").close()
                    for port in PORTS:
                        stack.enter_context(attacked.connect(port, list(OPENINGS.values())[turn % len(OPENINGS)]))
                seen = len(messages)
                wait_for(lambda: len(messages) > seen + 1)  # noqa: B023
            for attacked in (target, bass):
                attacked.assert_healthy()
                done = graph.run("rosservice", "call", f"/{attacked.name}/connect_service", "{local: a, remote: b}")
                assert "no_such_remote" in done.stdout
                done = graph.run("rostopic", "echo", "-n1", f"/{attacked.name}/genom_state")
                assert "task" in done.stdout
        indices = [m.lastFrameIndex for m in messages if m.lastFrameIndex]
        assert indices == list(range(indices[0], indices[-1] + 1, 2000)), "no block is missing"
        health = session.health(lambda entries: "lost" in entries)
        assert (health["lost"], health["gaps"], health["refused"]) == ("0", "0", "0")
        graph.call("/bass_mixed/Stop")
