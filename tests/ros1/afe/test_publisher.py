"""Sending of messages: complete, newest last, to each subscriber at its own pace, and with bounded memory."""

from __future__ import annotations

import os
import re
import signal
import socket
import struct
import threading
import xmlrpc.client
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rosAFE.msg
import rosgraph
import rospy
from rosgraph.network import write_ros_handshake_header
from rospy import topics
from rospy.impl.tcpros_base import TCPROSTransport
from rospy.impl.tcpros_pubsub import TCPROSPub

from rosafe.ros import array_msg
from rosafe.ros1.transport import publisher
from rosafe.ros1.transport.publisher import (
    MAX_QUEUED,
    MAX_QUEUED_BYTES,
    BufferList,
    NewestMessage,
    Publisher,
    send_pieces,
)
from tests.harness import PATIENCE, PYTHON, ROOT, Graph, freeze, proc, wait_for
from tests.ros1.afe.session import Session, noise, own_node

TIME_DOMAIN = rosAFE.msg.rosAFE_TimeDomainSignalPortStruct
BLOCK = 12000


# --- into a socket ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 5, 3000])
def test_pieces_arrive_as_one_message_for_any_socket_buffer(count: int) -> None:
    """More pieces than a call can have, of all sizes, with a socket buffer that is smaller than many of them."""
    rng = np.random.default_rng(count)
    pieces: list[Any] = [rng.normal(size=rng.integers(1, 40)) for _ in range(count - 1)] + [rng.normal(size=200_000)]
    pieces[0:0] = [b"head", memoryview(b"view")]
    data = b"".join(bytes(memoryview(piece).cast("B")) for piece in pieces)
    ours, theirs = socket.socketpair()
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 10_000)
    sending = threading.Thread(target=send_pieces, args=(ours, pieces))
    sending.start()
    received = bytearray()
    while len(received) < len(data):
        received += theirs.recv(70_000)
    sending.join()
    ours.close()
    theirs.close()
    assert received == data


def test_the_rest_of_a_partial_write_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_gathered_pieces_are_counted_and_empty_ones_skipped() -> None:
    out = BufferList()
    for piece in (b"abc", b"", np.zeros(0), np.zeros(2), memoryview(b"1234")):
        out.write(piece)
    assert (len(out.pieces), out.size) == (3, 3 + 16 + 4)


# --- topics -----------------------------------------------------------------------------------------------------


def message(index: int, frames: int = 3) -> Any:
    """Return a message whose samples are its index."""
    samples = np.full(frames, float(index))
    return array_msg(TIME_DOMAIN)(lastFrameIndex=index, framesOnPort=frames, left=samples, right=samples)


@contextmanager
def stalled(graph: Graph, topic: str) -> Iterator[socket.socket]:
    """Connect a subscriber that reads nothing after the handshake, until the test reads for it."""
    master = rosgraph.Master("/stalled", master_uri=graph.uri)
    publisher_uri = master.lookupNode(rospy.get_name())
    answer: Any = xmlrpc.client.ServerProxy(publisher_uri).requestTopic("/stalled", topic, [["TCPROS"]])
    _, host, port = answer[2]
    with socket.create_connection((host, port)) as sock:
        fields = {"topic": topic, "md5sum": TIME_DOMAIN._md5sum, "callerid": "/stalled", "type": TIME_DOMAIN._type}
        write_ros_handshake_header(sock, fields)
        read_exactly(sock, int.from_bytes(read_exactly(sock, 4), "little"))  # the header, and nothing of a message
        yield sock


def read_exactly(sock: socket.socket, size: int) -> bytes:
    data = bytearray()
    while len(data) < size:
        data += sock.recv(size - len(data))
    return bytes(data)


def read_message(sock: socket.socket) -> Any:
    return array_msg(TIME_DOMAIN)().deserialize(read_exactly(sock, int.from_bytes(read_exactly(sock, 4), "little")))


class WatchedLock:
    """A lock that records whether another thread has waited for it, or has had it."""

    def __init__(self) -> None:
        self.reached = False
        self._lock = threading.RLock()
        self._thread = threading.current_thread()

    def acquire(self) -> None:
        if not self._lock.acquire(blocking=False):
            self.reached = True
            self._lock.acquire()

    def release(self) -> None:
        self._lock.release()
        self.reached |= threading.current_thread() is not self._thread

    def __enter__(self) -> None:
        self.acquire()

    def __exit__(self, *exception: object) -> None:
        self.release()


@pytest.mark.parametrize("same", [True, False])
def test_a_subscriber_that_connects_during_publish_newest_gets_the_message(
    graph: Graph, monkeypatch: pytest.MonkeyPatch, same: bool
) -> None:
    """It connects just after the publisher has found no subscribers."""
    graph.client()
    port = Publisher(f"/of_the_test/newest{same}", array_msg(TIME_DOMAIN))
    index = [1]
    newest = NewestMessage(lambda: message(index[0]))
    port.publish_newest(newest)
    index[0] = 2
    subscribers: list[socket.socket] = []
    publishing = threading.current_thread()
    lock = WatchedLock()

    def connections(topic: Any) -> list[Any]:
        found: list[Any] = topic.__dict__["connections"]
        if threading.current_thread() is publishing and not subscribers:
            subscribers.append(stack.enter_context(stalled(graph, port.resolved_name)))
            wait_for(lambda: lock.reached, what="the thread that sends the latched message")
        return found

    with ExitStack() as stack:
        with monkeypatch.context() as patch:
            patch.setattr(
                publisher._Topic,
                "connections",
                property(connections, lambda topic, new: topic.__dict__.update(connections=new)),
                raising=False,
            )
            patch.setattr(port.impl, "publock", lock)
            port.publish_newest(newest if same else NewestMessage(lambda: message(2)))
        (subscriber,) = subscribers
        subscriber.settimeout(PATIENCE)
        while read_message(subscriber).lastFrameIndex < 2:
            pass


def test_the_queue_is_bounded_and_ends_with_the_newest_message(graph: Graph) -> None:
    """The queue is limited in messages and in bytes; a subscriber that reads in time gets each message."""
    graph.client()
    for frames, count, together in ((2000, 400, MAX_QUEUED // 2), (MAX_QUEUED_BYTES // 32, 8, 1)):
        port = Publisher(f"/of_the_test/bounded{frames}", array_msg(TIME_DOMAIN))
        with stalled(graph, port.resolved_name) as sock, graph.collect(port.resolved_name) as quick:
            wait_for(lambda: port.get_num_connections() == 2)  # noqa: B023
            for first in range(1, count + 1, together):
                for index in range(first, first + together):
                    port.publish(message(index, frames))
                wait_for(lambda: quick and quick[-1].lastFrameIndex == index)  # noqa: B023
            assert [m.lastFrameIndex for m in quick] == list(range(1, count + 1)), (
                "the stalled subscriber does not block others"
            )
            got = [1]
            while got[-1] < count:
                received = read_message(sock)
                assert np.all(received.left == received.lastFrameIndex) and len(received.left) == frames
                got.append(received.lastFrameIndex)
            assert got == sorted(got) and got[-1] == count
            waited = [index for index in got if index > count - MAX_QUEUED]
            assert len(got) < count, "old messages were dropped"
            assert waited[-1] == count
            if frames == 2000:
                assert waited == list(range(count - MAX_QUEUED + 1, count + 1))
        port.unregister()


def test_statistics_of_the_topic_and_of_each_connection(graph: Graph) -> None:
    """As in `getBusStats`: bytes published, and for each connection its number, bytes, messages and state."""
    graph.client()
    port = Publisher("/of_the_test/counted", array_msg(TIME_DOMAIN))
    port.publish(message(1))  # without a subscriber so far
    size = 4 + 4 + 8 + 8 + 2 * (4 + 3 * 8)
    with stalled(graph, port.resolved_name), graph.collect(port.resolved_name):
        wait_for(lambda: port.get_num_connections() == 2)
        port.publish(message(2))

        def statistics() -> Any:
            node: Any = xmlrpc.client.ServerProxy(rosgraph.Master("/test", graph.uri).lookupNode(rospy.get_name()))
            return next(entry for entry in node.getBusStats("/test")[2][0] if entry[0] == port.resolved_name)

        wait_for(lambda: [entry[2] for entry in statistics()[2]] == [2, 2], what=lambda: str(statistics()))
        assert statistics()[1] == 3 * size, "the latched message for each, the other one once"
        assert all(entry[1] >= 2 * size and entry[3] for entry in statistics()[2])
    port.unregister()


def test_a_disconnected_subscriber_is_removed(graph: Graph) -> None:
    graph.client()
    port = Publisher("/of_the_test/left", array_msg(TIME_DOMAIN))
    events: list[int] = []
    port.impl.on_change = lambda: events.append(port.get_num_connections())
    with stalled(graph, port.resolved_name):
        wait_for(lambda: port.get_num_connections() == 1)
    wait_for(lambda: (port.publish(message(1)), port.get_num_connections() == 0)[1])
    wait_for(lambda: not [t for t in threading.enumerate() if t.name == "to /stalled"], what="end of its sender")
    assert events == [1, 0]
    port.unregister()


def test_a_subscriber_that_leaves_while_it_is_added_is_removed(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    """A message to it fails before rospy has set its callback."""
    graph.client()
    port = Publisher("/of_the_test/leaving", array_msg(TIME_DOMAIN))
    set_callback = TCPROSTransport.set_cleanup_callback

    def set_later(connection: Any, callback: Any) -> None:
        port.publish(message(1))
        wait_for(lambda: connection.done)
        set_callback(connection, callback)

    monkeypatch.setattr(TCPROSTransport, "set_cleanup_callback", set_later)
    with socket.create_server(("127.0.0.1", 0)) as listener, socket.create_connection(listener.getsockname()) as theirs:
        ours, _ = listener.accept()
        transport = TCPROSTransport(TCPROSPub(port.resolved_name, TIME_DOMAIN), port.resolved_name)
        transport.set_socket(ours, "/leaving")
        theirs.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # reset when closed
        theirs.close()
        port.impl.add_connection(transport)
    assert port.get_num_connections() == 0
    wait_for(lambda: not [t for t in threading.enumerate() if t.name == "to /leaving"], what="end of its sender")
    port.unregister()


@pytest.mark.parametrize("moment", ["before", "amid"])
def test_a_subscriber_that_connects_while_the_topic_is_closed(
    graph: Graph, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    """Its connection and its sending thread end."""
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


def test_late_subscribers_get_the_newest_message_and_closing_ends_all(graph: Graph) -> None:
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


def test_an_invalid_message_is_rejected_if_there_is_a_subscriber(graph: Graph) -> None:
    graph.client()
    port = Publisher("/of_the_test/bad", array_msg(TIME_DOMAIN))
    with graph.collect("/of_the_test/bad", array_msg(TIME_DOMAIN)) as received:
        wait_for(lambda: port.get_num_connections() == 1)
        with pytest.raises(rospy.ROSException, match="left"):
            port.publish(array_msg(TIME_DOMAIN)(left=np.ones((2, 2))))
        port.publish(message(5))
        wait_for(lambda: received)
        assert received[0].lastFrameIndex == 5
    port.unregister()


# --- the node ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tree(graph: Graph) -> Iterator[Session]:
    """Start the default tree at 44.1 kHz with ports of 1 s, in a node of its own."""
    with own_node(graph, name="large") as session:
        session.listen(sample_rate=44100, chunk=BLOCK // 4, chunks=20)
        session.ok("InputProc", nFramesPerBlock=BLOCK)
        for request in ("PreProc", "GammatoneProc", "IhcProc", "IldProc"):
            session.ok(request)
        play(session, 6)
        yield session


def play(session: Session, blocks: int) -> int:
    """Play `count` further blocks, one at a time. Return the index of the last one."""
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


def test_a_stopped_subscriber_of_22_megabytes_affects_no_other(tree: Session) -> None:
    """It needs no memory, and no other port loses a block. Continued, it gets the newest message."""
    large = tree.topic("gammatone")
    with (
        tree.graph.start(PYTHON, "-u", "-c", LISTENER, "going", large) as going,
        tree.graph.start(PYTHON, "-u", "-c", LISTENER, "killed", large) as killed,
    ):
        wait_for(lambda: going.out and killed.out, what="the latched message")
        assert tree.connections(large) == 2
        play(tree, 2)
        for subscriber in (going, killed):
            freeze(subscriber.pid)
        play(tree, 3)
        before = resident(tree.process.pid)
        index = play(tree, 60)  # receives each block of ILD
        # 60 blocks have 357 MB. Unused memory is returned later.
        wait_for(
            lambda: resident(tree.process.pid) - before < 60,
            what=lambda: f"{resident(tree.process.pid)} < {before} + 60",
        )
        os.kill(killed.pid, signal.SIGKILL)
        os.kill(going.pid, signal.SIGCONT)
        wait_for(lambda: going.out.split()[-1] == str(index), what=lambda: f"{index} in {going}")
        wait_for(lambda: tree.connections(large) == 1)
        received = [int(line) for line in going.out.split()]
        assert received == sorted(received) and len(received) < 15, "it did not get the messages in between"
        assert tree.read("gammatone").lastFrameIndex == index


@pytest.mark.parametrize(
    ("example", "printed"), [(0, r"\d+ \(31, \d+\) 0 (None|\d+\.\d+)\n"), (1, r"\d+ \(31, 100\) \[.*")]
)
def test_the_examples_of_the_document(tree: Session, tmp_path: Path, example: int, printed: str) -> None:
    """docs/subscribers.md: the lines work unchanged, except for the name of this test's node."""
    text = (ROOT / "docs" / "subscribers.md").read_text("utf-8")
    code = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)[example]
    assert len([line for line in code.splitlines() if line]) <= 10
    script = tmp_path / "listener.py"
    script.write_text(code.replace("/rosAFE/", f"/{tree.name}/"))
    with tree.graph.start(PYTHON, "-u", str(script)) as listener:
        wait_for(lambda: re.match(printed, listener.out), what=lambda: str(listener))
        assert listener.stop() == 0, listener


def test_the_table_of_the_document(tree: Session) -> None:
    text = (ROOT / "docs" / "subscribers.md").read_text("utf-8")
    for name in re.findall(r"`((?:rosAFE|binaudio)_\w+)`", text):
        assert array_msg(getattr(rosAFE.msg, name)), name
    assert f"{MAX_QUEUED} messages and {MAX_QUEUED_BYTES // 10**6} MB" in text
