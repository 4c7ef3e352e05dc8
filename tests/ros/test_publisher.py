"""How messages leave the node: complete, newest last, to each subscriber at its own pace, and bounded in memory."""

from __future__ import annotations

import io
import os
import re
import signal
import socket
import threading
import xmlrpc.client
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rosAFE.msg
import rosgraph
import rospy
from rosgraph.network import read_ros_handshake_header, write_ros_handshake_header
from rospy import topics
from rospy.impl.tcpros_base import TCPROSTransport
from rospy.impl.tcpros_pubsub import TCPROSPub

from rosafe.interface import CORE_REPRESENTATIONS
from rosafe.ros import array_msg
from rosafe.transport import publisher
from rosafe.transport.buffer_list import BufferList
from rosafe.transport.publisher import MAX_WAITING, MAX_WAITING_BYTES, Publisher, send_pieces
from tests.harness import PATIENCE, PYTHON, ROOT, Graph, Process, proc, wait_for
from tests.ros.session import Session, noise, own_node

TIME_DOMAIN = rosAFE.msg.rosAFE_TimeDomainSignalPortStruct
BLOCK = 12000


# --- into a socket ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 5, 3000])
def test_pieces_arrive_as_one_whatever_the_socket_takes_at_once(count: int) -> None:
    """More pieces than one call may have, of all sizes, through a socket whose buffer is smaller than many of them."""
    rng = np.random.default_rng(count)
    pieces: list[Any] = [rng.normal(size=rng.integers(1, 40)) for _ in range(count - 1)] + [rng.normal(size=200_000)]
    pieces[0:0] = [b"head", memoryview(b"view")]
    wanted = b"".join(bytes(memoryview(piece).cast("B")) for piece in pieces)
    ours, theirs = socket.socketpair()
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 10_000)
    sending = threading.Thread(target=send_pieces, args=(ours, pieces))
    sending.start()
    came = bytearray()
    while len(came) < len(wanted):
        came += theirs.recv(70_000)
    sending.join()
    ours.close()
    theirs.close()
    assert came == wanted


def test_what_the_system_left_over_is_sent_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = bytearray()

    class Slow:
        def sendmsg(self, pieces: list[bytes]) -> int:
            assert len(pieces) <= 3
            part = b"".join(pieces)[:7]
            taken.extend(part)
            return len(part)

        def sendall(self, rest: memoryview) -> None:
            taken.extend(rest)

    monkeypatch.setattr(publisher, "_MAX_PIECES", 3)
    pieces = [bytes([n]) * n for n in range(1, 30)]
    send_pieces(Slow(), pieces)  # type: ignore[arg-type]
    assert taken == b"".join(pieces)


def test_gathered_pieces_are_counted_and_empty_ones_left_out() -> None:
    out = BufferList()
    for piece in (b"abc", b"", np.zeros(0), np.zeros(2), memoryview(b"1234")):
        out.write(piece)
    assert (len(out.pieces), out.size) == (3, 3 + 16 + 4)


# --- topics -----------------------------------------------------------------------------------------------------


def message(index: int, frames: int = 3) -> Any:
    """A message whose samples are its index."""
    samples = np.full(frames, float(index))
    return array_msg(TIME_DOMAIN)(lastFrameIndex=index, framesOnPort=frames, left=samples, right=samples)


@contextmanager
def stalled(graph: Graph, topic: str) -> Iterator[socket.socket]:
    """A subscriber that makes itself known and then reads nothing, until the test reads for it."""
    master = rosgraph.Master("/stalled", master_uri=graph.uri)
    publisher_uri = master.lookupNode(rospy.get_name())
    answer: Any = xmlrpc.client.ServerProxy(publisher_uri).requestTopic("/stalled", topic, [["TCPROS"]])
    _, host, port = answer[2]
    with socket.create_connection((host, port)) as sock:
        fields = {"topic": topic, "md5sum": TIME_DOMAIN._md5sum, "callerid": "/stalled", "type": TIME_DOMAIN._type}
        write_ros_handshake_header(sock, fields)
        read_ros_handshake_header(sock, io.BytesIO(), 4096)
        yield sock


def read_exactly(sock: socket.socket, size: int) -> bytes:
    data = bytearray()
    while len(data) < size:
        data += sock.recv(size - len(data))
    return bytes(data)


def read_message(sock: socket.socket) -> Any:
    return array_msg(TIME_DOMAIN)().deserialize(read_exactly(sock, int.from_bytes(read_exactly(sock, 4), "little")))


def test_what_waits_is_bounded_and_ends_with_the_newest(graph: Graph) -> None:
    """Small messages wait up to a number, large ones up to so many bytes; who reads in time gets every one."""
    graph.client()
    for frames, count, together in ((2000, 400, MAX_WAITING // 2), (MAX_WAITING_BYTES // 32, 8, 1)):
        port = Publisher(f"/of_the_test/bounded{frames}", array_msg(TIME_DOMAIN))
        with stalled(graph, port.resolved_name) as sock, graph.collect(port.resolved_name) as quick:
            wait_for(lambda: port.get_num_connections() == 2)  # noqa: B023
            for first in range(1, count + 1, together):
                for index in range(first, first + together):
                    port.publish(message(index, frames))
                wait_for(lambda: quick and quick[-1].lastFrameIndex == index)  # noqa: B023
            assert [m.lastFrameIndex for m in quick] == list(range(1, count + 1)), "the stalled one holds up nobody"
            got = [1]
            while got[-1] < count:
                came = read_message(sock)
                assert np.all(came.left == came.lastFrameIndex) and len(came.left) == frames
                got.append(came.lastFrameIndex)
            assert got == sorted(got) and got[-1] == count
            waited = [index for index in got if index > count - MAX_WAITING]
            assert len(got) < count, "old ones were given up"
            assert waited[-1] == count
            if frames == 2000:
                assert waited == list(range(count - MAX_WAITING + 1, count + 1))
        port.unregister()


def test_statistics_of_the_topic_and_of_each_connection(graph: Graph) -> None:
    """As `getBusStats` gives them: bytes published, and for each connection its number, bytes, messages, whether up."""
    graph.client()
    port = Publisher("/of_the_test/counted", array_msg(TIME_DOMAIN))
    port.publish(message(1))  # for nobody, yet
    size = 4 + 4 + 8 + 8 + 2 * (4 + 3 * 8)
    with stalled(graph, port.resolved_name), graph.collect(port.resolved_name):
        wait_for(lambda: port.get_num_connections() == 2)
        port.publish(message(2))

        def statistics() -> Any:
            node: Any = xmlrpc.client.ServerProxy(rosgraph.Master("/test", graph.uri).lookupNode(rospy.get_name()))
            return next(entry for entry in node.getBusStats("/test")[2][0] if entry[0] == port.resolved_name)

        wait_for(lambda: [entry[2] for entry in statistics()[2]] == [2, 2], what=lambda: str(statistics()))
        assert statistics()[1] == 3 * size, "the latched one for each, the other once"
        assert all(entry[1] >= 2 * size and entry[3] for entry in statistics()[2])
    port.unregister()


def test_a_subscriber_that_left_is_forgotten(graph: Graph) -> None:
    graph.client()
    port = Publisher("/of_the_test/left", array_msg(TIME_DOMAIN))
    with stalled(graph, port.resolved_name):
        wait_for(lambda: port.get_num_connections() == 1)
    wait_for(lambda: (port.publish(message(1)), port.get_num_connections() == 0)[1])
    wait_for(lambda: not [t for t in threading.enumerate() if t.name == "to /stalled"], what="end of its sender")
    port.unregister()


@pytest.mark.parametrize("moment", ["before", "amid"])
def test_a_subscriber_of_a_topic_that_is_closed_in_that_very_moment(
    graph: Graph, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    """Its connection ends, and so does the thread that was to send to it."""
    graph.client()
    port = Publisher(f"/of_the_test/closing_{moment}", array_msg(TIME_DOMAIN))
    port.publish(message(1))
    topic, name = port.impl, port.resolved_name
    if moment == "before":
        port.unregister()
    else:
        add = topics._TopicImpl.add_connection

        def add_and_close(self: Any, connection: Any) -> Any:
            added = add(self, connection)
            port.unregister()
            return added

        monkeypatch.setattr(topics._TopicImpl, "add_connection", add_and_close)
    with socket.create_server(("127.0.0.1", 0)) as listener, socket.create_connection(listener.getsockname()) as theirs:
        ours, _ = listener.accept()
        transport = TCPROSTransport(TCPROSPub(name, TIME_DOMAIN), name)
        transport.set_socket(ours, "/closing")
        assert not topic.add_connection(transport)
        theirs.settimeout(10)
        assert theirs.recv(1) == b""
        wait_for(lambda: not [t for t in threading.enumerate() if t.name == "to /closing"], what="end of its sender")


def test_late_subscribers_get_the_newest_and_withdrawal_ends_everything(graph: Graph) -> None:
    graph.client()
    port = Publisher("/of_the_test/late", array_msg(TIME_DOMAIN))
    for index in (1, 2):
        port.publish(message(index))
    with graph.collect("/of_the_test/late", TIME_DOMAIN) as plain:
        wait_for(lambda: plain)
        assert plain[0].lastFrameIndex == 2 and plain[0].left.data == (2.0, 2.0, 2.0)
        sender = next(t for t in threading.enumerate() if t.name == f"to {rospy.get_name()}")
        port.unregister()
        sender.join(PATIENCE)
        assert not sender.is_alive()
    with pytest.raises(rospy.ROSException):
        port.publish(message(3))


def test_a_message_that_cannot_be_written_is_refused_where_somebody_listens(graph: Graph) -> None:
    graph.client()
    port = Publisher("/of_the_test/bad", array_msg(TIME_DOMAIN))
    with graph.collect("/of_the_test/bad", array_msg(TIME_DOMAIN)) as came:
        wait_for(lambda: port.get_num_connections() == 1)
        with pytest.raises(rospy.ROSException, match="left"):
            port.publish(array_msg(TIME_DOMAIN)(left=np.ones((2, 2))))
        port.publish(message(5))
        wait_for(lambda: came)
        assert came[0].lastFrameIndex == 5
    port.unregister()


# --- the node ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tree(graph: Graph) -> Iterator[Session]:
    """The default tree at 44.1 kHz with ports of one second, in a node of its own."""
    with own_node(graph, name="large") as session:
        session.listen(sample_rate=44100, chunk=BLOCK // 4, chunks=20)
        session.ok("InputProc", nFramesPerBlock=BLOCK)
        for request in ("PreProc", "GammatoneProc", "IhcProc", "IldProc"):
            session.ok(request)
        play(session, 6)
        yield session


def play(session: Session, blocks: int) -> int:
    """So many blocks more, one after the other; the index of the last one."""
    assert session.microphone is not None
    with session.follow("ild") as messages:
        for seed in range(blocks):
            session.microphone.play(noise(BLOCK, seed))
            index = session.microphone.index + 1
            wait_for(lambda: messages[-1].lastFrameIndex == index)  # noqa: B023
    return session.microphone.index + 1


def resident(pid: int) -> float:
    return int(proc(pid, "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


LISTENER = """
import sys, rospy
from rosAFE.msg import rosAFE_TimeFrequencySignalPortStruct as TimeFrequency
from rosafe.ros import array_msg
rospy.init_node(sys.argv[1])
rospy.Subscriber(sys.argv[2], array_msg(TimeFrequency), lambda m: print(m.lastFrameIndex), buff_size=2**22)
rospy.spin()
"""


def test_a_stopped_subscriber_of_22_megabytes_costs_nobody_anything(tree: Session) -> None:
    """No memory, and no block of another port; when it goes on it soon has the newest, and killed it is forgotten."""
    large = tree.topic("gammatone")
    with (
        tree.graph.start(PYTHON, "-u", "-c", LISTENER, "going", large) as going,
        tree.graph.start(PYTHON, "-u", "-c", LISTENER, "killed", large) as killed,
    ):
        wait_for(lambda: going.out and killed.out, what="the latched message")
        assert tree.connections(large) == 2
        play(tree, 2)
        for subscriber in (going, killed):
            os.kill(subscriber.pid, signal.SIGSTOP)
        play(tree, 3)
        before = resident(tree.process.pid)
        index = play(tree, 20)  # follows every block of ILD
        assert resident(tree.process.pid) - before < 60, "20 messages of 22 MB, to two subscribers"
        os.kill(killed.pid, signal.SIGKILL)
        os.kill(going.pid, signal.SIGCONT)
        wait_for(lambda: going.out.split()[-1] == str(index), what=lambda: f"{index} in {going}")
        wait_for(lambda: tree.connections(large) == 1)
        came = [int(line) for line in going.out.split()]
        assert came == sorted(came) and len(came) < 15, "it did not get what came meanwhile"
        assert tree.read("gammatone").lastFrameIndex == index


def test_the_example_of_the_document(tree: Session, tmp_path: Path) -> None:
    """docs/subscribers.md: ten lines that work as they stand, but for the name of this test's node."""
    text = (ROOT / "docs" / "subscribers.md").read_text("utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert len([line for line in code.splitlines() if line]) <= 10
    script = tmp_path / "listener.py"
    script.write_text(code.replace("/rosAFE/", f"/{tree.name}/"))
    with tree.graph.start(PYTHON, "-u", str(script)) as listener:
        wait_for(lambda: "]" in listener.out, what=lambda: str(listener))
        assert re.match(r"\d+ \(31, 100\) \[.*", listener.out)
        assert listener.stop() == 0, listener


def test_the_table_of_the_document(tree: Session) -> None:
    text = (ROOT / "docs" / "subscribers.md").read_text("utf-8")
    for name in re.findall(r"`((?:rosAFE|binaudio)_\w+)`", text):
        assert array_msg(getattr(rosAFE.msg, name)), name
    assert f"{MAX_WAITING} messages and {MAX_WAITING_BYTES // 10**6} MB" in text


@pytest.mark.ros
def test_all_ports_for_a_while(tmp_path: Path) -> None:
    """The short form of the benchmark that runs for minutes: nothing lost, no growth."""
    proc()
    env = {k: v for k, v in os.environ.items() if not k.startswith("ROS_")}
    command = [PYTHON, str(ROOT / "benchmarks" / "ports.py"), "--quick", "--loaded", "--seconds", "3"]
    with Process(command, {**env, "HOME": str(tmp_path)}) as done:
        assert done.wait(200) == 0, done
        rows = re.findall(r"^\| (/rosAFE/\S+) \| (\d+) \| (\d+) \| (\d+) \|$", done.out, re.MULTILINE)
    assert len(rows) == 2 * len(CORE_REPRESENTATIONS)
    for topic, came, expected, lost in rows:
        assert 2 < int(came) <= int(expected) and int(lost) == 0, topic
