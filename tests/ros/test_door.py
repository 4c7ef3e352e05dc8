"""A door by itself: what it does where the system, or what stands behind it, fails."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from rosafe.transport import handshake_server
from rosafe.transport.handshake_server import HandshakeRejected, HandshakeServer
from tests.harness import wait_for


class House:
    """Echoes lines, and keeps the connection for more of them."""

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

    def visit(self, said: bytes = b"") -> socket.socket:
        """Come in and say something."""
        sock = socket.create_connection(self.listener.getsockname(), 20)
        sock.sendall(said)
        return sock


@contextmanager
def house() -> Iterator[House]:
    it = House()
    it.thread.start()
    try:
        yield it
    finally:
        it.listener.close()
        it.thread.join(20)
        assert not it.thread.is_alive()


def test_what_was_said_comes_whole_and_in_order() -> None:
    """In one piece or many, several at once, with the beginning of the next."""
    with house() as it, it.visit(b"one\ntwo\nthr") as sock:
        for part in (b"e", b"e\nfour\n"):
            sock.sendall(part)
        with sock.makefile("rb") as lines:
            assert [lines.readline() for _ in range(4)] == [b"one\n", b"two\n", b"three\n", b"four\n"]


def test_who_says_nonsense_is_told_and_named() -> None:
    with house() as it, it.visit(b"x" * 1001) as sock:
        assert sock.recv(100) == b"no\n" and sock.recv(100) == b""
        assert it.reports == [("127.0.0.1", "too long; disconnected")]


def test_who_is_silent_goes_after_a_while_but_not_who_was_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handshake_server, "OPENING_SECONDS", 0.5)
    with house() as it, it.visit() as silent, it.visit(b"half") as half, it.visit(b"a line\n") as heard:
        assert silent.recv(100) == b"" == half.recv(100)
        assert sorted(what for _, what in it.reports) == [
            "said 4 bytes and no more for 0.5 s and was disconnected",
            "said nothing for 0.5 s and was disconnected",
        ]
        heard.sendall(b"another\n")
        assert heard.makefile("rb").readlines(9) == [b"a line\n", b"another\n"]
        heard.sendall(b"hal")
        assert heard.recv(100) == b"", "it has begun, and must go on"


def test_the_one_that_came_first_goes_where_there_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handshake_server, "MAX_PENDING", 10)
    with house() as it:
        crowd = [it.visit() for _ in range(15)]
        for sock in crowd[:5]:
            assert sock.recv(100) == b""
        for sock in crowd[5:]:
            sock.sendall(b"still here\n")
            assert sock.recv(100) == b"still here\n"
        for sock in crowd:
            sock.close()


def test_a_fault_of_what_stands_behind_it_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """An opening that cannot be judged, and no thread for who has come."""
    with house() as it:
        line = it.opening
        it.opening = lambda data: 1 // 0
        with it.visit(b"a line\n"):
            wait_for(lambda: any("ZeroDivisionError" in what for _, what in it.reports))
            it.opening = line
        start = threading.Thread.start

        def refuse(thread: threading.Thread) -> None:
            if thread.name == "from 127.0.0.1":
                raise RuntimeError("can't start new thread")
            start(thread)

        monkeypatch.setattr(threading.Thread, "start", refuse)
        with it.visit(b"a line\n") as sock:
            assert sock.recv(100) == b""
        assert ("", "a connection is closed: can't start new thread") in it.reports
        monkeypatch.undo()
        with it.visit(b"a line\n") as sock:
            assert sock.recv(100) == b"a line\n"


def test_where_the_system_gives_no_descriptor_connections_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """As it is when the whole machine has none left."""
    with house() as it:
        accept = socket.socket.accept
        full = threading.Event()
        full.set()

        def refuse(listener: socket.socket) -> Any:
            if full.is_set() and listener is it.listener:
                raise OSError(23, "Too many open files in system")
            return accept(listener)

        monkeypatch.setattr(socket.socket, "accept", refuse)
        with it.visit(b"patience\n") as sock:
            wait_for(lambda: any("none is left" in what for _, what in it.reports))
            full.clear()
            assert sock.recv(100) == b"patience\n"
        assert [what.split(",")[0] for _, what in it.reports[-1:]] == [
            "there are file descriptors for connections again"
        ]
