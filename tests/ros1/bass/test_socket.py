"""The dedicated socket's protocol, over real TCP connections."""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe.audio.stream.capture import Snapshot
from rosafe.ros1.bass import socket_server
from rosafe.ros1.bass.socket_server import DedicatedSocket, read_frames, take_requests
from tests.harness import PATIENCE, ROOT, wait_for


def port_content(last: int, length: int) -> Snapshot:
    """Return a window in which frame k is k on the left and -k on the right, with zeros before frame 1."""
    left = np.maximum(np.arange(last - length + 1, last + 1), 0).astype(np.int32)
    return Snapshot(44100, 1, length, last, left, -left, 0)


def parse(answer: bytes) -> tuple[int, int, int, list[int], list[int]]:
    n, loss, following = struct.unpack("<iiq", answer[:16])
    samples = np.frombuffer(answer[16:], "<i4").tolist()
    assert len(samples) == 2 * n
    return n, loss, following, samples[:n], samples[n:]


def receive(connection: socket.socket) -> tuple[int, int, int, list[int], list[int]]:
    """Return one complete answer."""
    with connection.makefile("rb", buffering=0) as stream:
        answer = bytearray()
        size = 16
        while len(answer) < size:
            part = stream.read(size - len(answer))
            assert part, f"closed after {len(answer)} of {size} bytes"
            answer += part
            if len(answer) >= 16:
                size = 16 + 8 * struct.unpack_from("<i", answer)[0]
    return parse(bytes(answer))


class Server:
    """A server in a thread that serves `content`."""

    def __init__(self) -> None:
        self.content: Snapshot | None = port_content(100, 20)
        self.reads = 0
        self.reports: list[str] = []
        self.stopping = threading.Event()
        self._socket = DedicatedSocket(self._read, "127.0.0.1", 0, self.reports.append)
        self.address = self._socket.address
        self.thread = threading.Thread(target=self._socket.serve, args=(self.stopping,))
        self.thread.start()

    def _read(self) -> Snapshot | None:
        self.reads += 1
        return self.content

    def clients(self) -> int:
        return sum(thread.name == "socket client" for thread in threading.enumerate())

    @contextmanager
    def client(self) -> Iterator[socket.socket]:
        with socket.create_connection(self.address, timeout=PATIENCE) as connection:
            yield connection


@pytest.fixture
def server() -> Iterator[Server]:
    running = Server()
    yield running
    running.stopping.set()
    running.thread.join(PATIENCE)
    assert not running.thread.is_alive()


@pytest.mark.parametrize(
    ("count", "first", "expected"),
    [
        (5, 90, (5, 0, 95, [90, 91, 92, 93, 94])),
        (50, 99, (2, 0, 101, [99, 100])),  # not more than available
        (3, 11, (3, 70, 84, [81, 82, 83])),  # 11 to 80 have left the window
        (5, 101, (0, 0, 101, [])),  # no new frames yet
        (5, 500, (0, 0, 500, [])),  # from before a restart, or invalid: the count is never negative
        (5, 10**30, (0, 0, 2**63 - 1, [])),
        (0, 90, (0, 0, 90, [])),
        (10**30, 81, (20, 0, 101, list(range(81, 101)))),
    ],
)
def test_answer(count: int, first: int, expected: tuple[int, int, int, list[int]]) -> None:
    n, loss, following, left, right = parse(read_frames(port_content(100, 20), count, first))
    assert (n, loss, following, left) == expected
    assert right == [-k for k in left]


def test_answer_before_and_at_the_start_of_an_acquisition() -> None:
    assert parse(read_frames(None, 5, 3)) == (0, 0, 3, [], [])
    assert parse(read_frames(port_content(0, 20), 5, 1)) == (0, 0, 1, [], [])
    assert parse(read_frames(port_content(4, 20), 10, 1))[:4] == (4, 0, 5, [1, 2, 3, 4])


@settings(max_examples=60)
@given(st.lists(st.tuples(st.integers(1, 60), st.integers(1, 60)), min_size=1, max_size=20), st.integers(1, 50))
def test_a_reader_gets_each_frame_or_the_number_of_lost_frames(steps: list[tuple[int, int]], length: int) -> None:
    last, following, seen, lost = 0, 1, [], 0
    for advance, count in steps:
        last += advance
        n, loss, following, left, _ = parse(read_frames(port_content(last, length), count, following))
        assert n == len(left) <= length
        lost += loss
        assert left == list(range(following - n, following))
        seen += left
    assert len(seen) + lost == following - 1


@settings(max_examples=40)
@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 10**12)), max_size=6), st.data())
def test_requests_can_be_divided_anywhere(requests: list[tuple[int, int]], data: st.DataObject) -> None:
    text = b"".join(b"Read Port - N %d - nfr %d\n" % request for request in requests)
    inbox = bytearray()
    found: list[tuple[int, int]] = []
    while text:
        size = data.draw(st.integers(1, len(text)))
        inbox += text[:size]
        text = text[size:]
        found += take_requests(inbox, quiet=False)
    assert found == requests
    assert not inbox


def test_requests_without_line_ends() -> None:
    inbox = bytearray(b"CloseRead Port - N 1 - nfr 2Read Port - N 3 - nfr 4")
    assert list(take_requests(inbox, quiet=False)) == [(1, 2)]
    assert list(take_requests(inbox, quiet=True)) == [(3, 4)]
    assert not inbox
    inbox += b"Read Port - N 5"  # the rest follows
    assert list(take_requests(inbox, quiet=True)) == []
    inbox += b" - nfr 6"
    assert list(take_requests(inbox, quiet=True)) == [(5, 6)]


@pytest.mark.parametrize(
    ("text", "request_"),
    [
        (b"Read Port - N -5 - nfr -7\n", (0, 0)),
        (b"Read Port - N 2147483648 - nfr 9223372036854775808\n", (2**31, 2**63)),
        (b"Read Port N=5, nfr:7\r\n", (5, 7)),
        (b"\xff\0\x80 binary Read Port - N 1 - nfr 2\n", (1, 2)),
        (b"Read Port - N 5.9 - nfr 1e9\n", (5, 1)),
    ],
)
def test_malformed_requests(text: bytes, request_: tuple[int, int]) -> None:
    assert list(take_requests(bytearray(text), quiet=False)) == [request_]


@pytest.mark.parametrize(
    "text", [b"Read Port\n", b"Read Port - N 5\n", b"Read Port - nfr 5\n", b"N 1 - nfr 1\n", b"Close\n", b"\n\0\r", b""]
)
def test_other_text_gets_no_answer(text: bytes) -> None:
    assert list(take_requests(bytearray(text), quiet=True)) == []


def test_invalid_input_is_not_stored() -> None:
    inbox = bytearray()
    for _ in range(100):
        inbox += b"x" * 1000
        assert not list(take_requests(inbox, quiet=True))
    assert len(inbox) <= 4096
    inbox += b"Read Port - N " + b"9" * 8000 + b" - nfr 1\n"
    list(take_requests(inbox, quiet=False))


def test_conversation(server: Server) -> None:
    with server.client() as connection:
        connection.sendall(b"Read Port - N 3 - nfr 98\n")
        assert receive(connection) == (3, 0, 101, [98, 99, 100], [-98, -99, -100])
        connection.sendall(b"Read Port - N 3 - nfr 101\nRead Port - N 1 - nfr 100\n")
        assert receive(connection)[0] == 0
        assert receive(connection)[3] == [100]
        server.content = port_content(103, 20)
        connection.sendall(b"Read Port - N 3 - nfr 101")  # without line ends
        assert receive(connection)[3] == [101, 102, 103]
        connection.sendall(b"Close")
        connection.sendall(b"\nRead Po")
        connection.sendall(b"rt - N 1 - nfr 103\n")
        assert receive(connection)[3] == [103]


def test_the_documented_number_of_clients_is_served(server: Server) -> None:
    connections = [socket.create_connection(server.address, timeout=PATIENCE) for _ in range(socket_server.MAX_CLIENTS)]
    for index, connection in enumerate(connections):
        connection.sendall(b"Read Port - N 1 - nfr %d\n" % (81 + index % 20))
    assert [receive(c)[3] for c in connections] == [[81 + index % 20] for index in range(len(connections))]
    with server.client() as one_more:
        assert one_more.recv(1) == b""  # rejected
    assert "rejected" in server.reports[0]
    connections.pop().close()
    wait_for(lambda: server.clients() == socket_server.MAX_CLIENTS - 1)
    with server.client() as again:
        again.sendall(b"Read Port - N 1 - nfr 100\n")
        assert receive(again)[3] == [100]
    for connection in connections:
        connection.close()
    wait_for(lambda: server.clients() == 0)


def full(server: Server) -> list[socket.socket]:
    """Connect the maximum number of clients, in this order, which send nothing."""
    connections = [socket.create_connection(server.address, timeout=PATIENCE) for _ in range(socket_server.MAX_CLIENTS)]
    wait_for(lambda: server.clients() == socket_server.MAX_CLIENTS)
    return connections


def let_in(server: Server) -> bool:
    """Return whether a new client gets an answer."""
    with server.client() as connection:
        try:
            connection.sendall(b"Read Port - N 1 - nfr 100\n")
            return receive(connection)[3] == [100]
        except (AssertionError, ConnectionError):  # rejected
            return False


def closed(connection: socket.socket) -> bool:
    if not select.select([connection], [], [], 0)[0]:
        return False
    try:
        return connection.recv(1, socket.MSG_PEEK) == b""
    except ConnectionResetError:
        return True


def test_idle_clients_are_replaced(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    connections = full(server)
    assert not let_in(server) and not any(map(closed, connections)), "not immediately"
    monkeypatch.setattr(socket_server, "IDLE_SECONDS", 0.5)
    wait_for(lambda: let_in(server))
    assert [closed(connection) for connection in connections].count(True) == 1
    assert closed(connections[0]), "the longest idle one"
    assert sum("without a request for" in line for line in server.reports) == 1
    for _ in range(5):
        wait_for(lambda: server.clients() == socket_server.MAX_CLIENTS - 1)  # the previous client has disconnected
        assert let_in(server)
    assert [closed(connection) for connection in connections].count(True) == 1, (
        "no client is disconnected below the limit"
    )
    for connection in connections:
        connection.close()


def test_a_client_with_requests_stays_and_one_with_other_text_is_replaced(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(socket_server, "IDLE_SECONDS", 0.5)
    active, sending, *others = full(server)
    others += [socket.create_connection(server.address, timeout=PATIENCE) for _ in range(3)]  # three beyond the limit

    def all_served() -> bool:
        active.sendall(b"Read Port - N 1 - nfr 90\n")
        assert receive(active)[3] == [90]
        if not closed(sending):
            sending.sendall(b"rubbish, Read Port - N")
        others.append(socket.create_connection(server.address, timeout=PATIENCE))
        return closed(sending)

    wait_for(all_served, what="the end of the client that sends rubbish")
    assert not closed(active)
    active.sendall(b"Read Port - N 1 - nfr 91\n")
    assert receive(active)[3] == [91]
    for connection in (active, sending, *others):
        connection.close()


def test_idle_time_is_as_documented() -> None:
    text = (ROOT / "docs" / "capture.md").read_text("utf-8")
    assert f"no request for {socket_server.IDLE_SECONDS:g} s" in " ".join(text.split())


def test_without_descriptors_accepting_is_paused_and_resumed(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    listener = server._socket._listener
    tries: list[float] = []

    class NoDescriptors:
        """The listening socket of a process without free descriptors."""

        def __getattr__(self, name: str) -> Any:
            return getattr(listener, name)

        def accept(self) -> Any:
            tries.append(time.monotonic())
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    with server.client() as before:
        wait_for(lambda: server.clients() == 1)
        server._socket._listener = NoDescriptors()  # type: ignore[assignment]
        with server.client() as waiting:
            waiting.sendall(b"Read Port - N 1 - nfr 100\n")
            wait_for(lambda: len(tries) >= 2)
            before.sendall(b"Read Port - N 1 - nfr 99\n")
            assert receive(before)[3] == [99], "connected clients are still served"
            monkeypatch.setattr(NoDescriptors, "accept", lambda self: listener.accept())
            assert receive(waiting)[3] == [100]
    assert tries[1] - tries[0] >= socket_server.PAUSE_SECONDS
    assert "Too many open files" in server.reports[0]


def test_slow_client_does_not_hinder_others(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    server.content = port_content(2_000_000, 2_000_000)
    with server.client() as slow, server.client() as quick:
        for _ in range(20):
            slow.sendall(b"Read Port - N 2000000 - nfr 1\n")  # 16 MB each, of which it reads none
        quick.sendall(b"Read Port - N 1 - nfr 1\n")
        assert receive(quick)[3] == [1]
        assert receive(slow)[0] == 2_000_000  # and it gets its answers when it reads again
        assert receive(slow)[4][-1] == -2_000_000
    monkeypatch.setattr(socket_server, "DEAD_SECONDS", 0.2)
    with server.client() as slow, server.client() as quick:
        slow.sendall(b"Read Port - N 2000000 - nfr 1\n")
        wait_for(lambda: server.clients() == 2)
        wait_for(lambda: server.clients() == 1, what="the end of the client that takes no answer")
        quick.sendall(b"Read Port - N 1 - nfr 2\n")
        assert receive(quick)[3] == [2]


def test_client_that_resets_its_connection(server: Server) -> None:
    server.content = port_content(2_000_000, 2_000_000)
    with server.client() as rude:
        rude.sendall(b"Read Port - N 2000000 - nfr 1\n" * 3)
        rude.recv(1)
        rude.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    wait_for(lambda: server.clients() == 0)
    with server.client() as other:
        other.sendall(b"Read Port - N 1 - nfr 7\n")
        assert receive(other)[3] == [7]


def test_end_closes_connections_and_releases_the_port(server: Server) -> None:
    with server.client() as connection:
        wait_for(lambda: server.clients() == 1)
        server.stopping.set()
        assert connection.recv(1) == b""
    server.thread.join(PATIENCE)
    with socket.create_server(server.address):
        pass
