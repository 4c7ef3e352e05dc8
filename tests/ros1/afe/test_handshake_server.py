"""The handshake server alone, also with failures of the system or of its handler."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from rosafe.ros1.transport import handshake_server, server_limits
from rosafe.ros1.transport.handshake_server import HandshakeRejected, HandshakeServer
from tests.harness import wait_for


class EchoServer:
    """Echoes lines, and keeps the connection open for further ones."""

    def __init__(self) -> None:
        self.reports: list[tuple[str, str]] = []
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.opening: Callable[[bytearray], int | None] = self._line
        self.door = HandshakeServer(self.listener, lambda data: self.opening(data), self._echo, self._report)
        self.thread = threading.Thread(target=self.door.run)

    def _line(self, data: bytearray) -> int | None:
        if len(data) > 1000:
            raise HandshakeRejected("too long", b"no\n")
        end = data.find(b"\n")
        return end + 1 if end >= 0 else None

    def _echo(self, sock: socket.socket, address: Any, opening: bytes, rest: bytes) -> None:
        sock.sendall(opening)
        self.door.adopt_idle(sock, address, rest, 60)

    def _report(self, peer: str, what: str) -> None:
        self.reports.append((peer, what))

    def connect(self, data: bytes = b"") -> socket.socket:
        """Connect and send data."""
        sock = socket.create_connection(self.listener.getsockname(), 20)
        sock.sendall(data)
        return sock


@contextmanager
def server() -> Iterator[EchoServer]:
    it = EchoServer()
    it.thread.start()
    try:
        yield it
    finally:
        it.listener.close()
        it.thread.join(20)
        assert not it.thread.is_alive()


def test_the_listener_is_closed_before_the_thread_runs() -> None:
    it = EchoServer()
    it.listener.close()
    it.door.run()
    tcpros = server_limits.TcprosServer(lambda sock, address: None)
    tcpros.server_sock = it.listener
    tcpros.run()
    assert not it.reports


def test_data_arrive_completely_and_in_order() -> None:
    """In one or several pieces, and with the beginning of the next line."""
    with server() as it, it.connect(b"one\ntwo\nthr") as sock:
        for part in (b"e", b"e\nfour\n"):
            sock.sendall(part)
        with sock.makefile("rb") as lines:
            assert [lines.readline() for _ in range(4)] == [b"one\n", b"two\n", b"three\n", b"four\n"]


def test_invalid_data_are_answered_and_logged() -> None:
    with server() as it, it.connect(b"x" * 1001) as sock:
        assert sock.recv(100) == b"no\n" and sock.recv(100) == b""
        assert it.reports == [("127.0.0.1", "too long; disconnected")]


def test_silent_connections_are_closed_unless_they_have_sent_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handshake_server, "OPENING_SECONDS", 0.5)
    with server() as it, it.connect() as silent, it.connect(b"half") as half, it.connect(b"a line\n") as active:
        assert silent.recv(100) == b"" == half.recv(100)
        assert sorted(what for _, what in it.reports) == [
            "sent nothing for 0.5 s and was disconnected",
            "sent only 4 bytes for 0.5 s and was disconnected",
        ]
        active.sendall(b"another\n")
        assert active.makefile("rb").readlines(9) == [b"a line\n", b"another\n"]
        active.sendall(b"hal")
        assert active.recv(100) == b"", "it has sent a line and stays open"


def test_with_too_many_connections_the_oldest_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handshake_server, "MAX_PENDING", 10)
    with server() as it:
        connections = [it.connect() for _ in range(15)]
        for sock in connections[:5]:
            assert sock.recv(100) == b""
        assert it.reports[0] == ("", "too many silent connections: the oldest ones are disconnected")
        for sock in connections[5:]:
            sock.sendall(b"still here\n")
            assert sock.recv(100) == b"still here\n"
        for sock in connections:
            sock.close()


def test_a_failure_of_the_handler_does_not_end_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    """An exception while a header is checked, and no thread for a complete one."""
    with server() as it:
        line = it.opening
        it.opening = lambda data: 1 // 0
        with it.connect(b"a line\n"):
            wait_for(lambda: any("ZeroDivisionError" in what for _, what in it.reports))
            it.opening = line
        start = threading.Thread.start

        def refuse(thread: threading.Thread) -> None:
            if thread.name == "from 127.0.0.1":
                raise RuntimeError("can't start new thread")
            start(thread)

        monkeypatch.setattr(threading.Thread, "start", refuse)
        with it.connect(b"a line\n") as sock:
            assert sock.recv(100) == b""
        assert ("", "connection closed: can't start new thread") in it.reports
        monkeypatch.undo()
        with it.connect(b"a line\n") as sock:
            assert sock.recv(100) == b"a line\n"


def test_without_descriptors_connections_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the whole machine had no free descriptors."""
    with server() as it:
        accept = socket.socket.accept
        full = threading.Event()

        def refuse(listener: socket.socket) -> Any:
            if full.is_set() and listener is it.listener:
                raise OSError(23, "Too many open files in system")
            return accept(listener)

        monkeypatch.setattr(socket.socket, "accept", refuse)
        for _ in range(2):
            it.reports.clear()
            full.set()
            with it.connect(b"patience\n") as sock:
                wait_for(lambda: any("are in use" in what for _, what in it.reports))
                full.clear()
                assert sock.recv(100) == b"patience\n"
            assert [what for _, what in it.reports[1:]] == ["file descriptors for connections are available again"]
