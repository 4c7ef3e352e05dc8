"""A listening socket that silent clients, invalid data and floods do not block. Does not depend on ROS.

A client has to send an opening first: a TCPROS header or an HTTP request. One thread accepts all connections and reads
these openings concurrently, each limited in time and size. Only a complete opening is handed to a thread of its own. If
too many connections have not sent theirs, the one that has been silent longest is closed. If file descriptors run out,
new connections wait until some are available again; the last few are reserved for the process itself.
"""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import selectors
import socket
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

BACKLOG = 1024  # connections that wait to be accepted
DESCRIPTORS = 4096  # requested at the start, if the hard limit allows; most of them have a thread
RESERVE = 64  # descriptors that are not used for connections: files, devices, and outgoing connections
MAX_PENDING = 256  # connections without a complete opening
OPENING_SECONDS = 5.0  # for a complete opening
READ_BYTES = 65536  # per read
PAUSE_SECONDS = 0.2  # between two checks whether descriptors are available again
ACCEPTED_AT_ONCE = 32  # connections that are accepted before openings are read again
_TICK = 0.25  # seconds between two checks for expired connections
_EXHAUSTED = {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM}

# Called with (address of the peer or "", the problem) to log it; repetitions are limited by the callee.
Report = Callable[[str, str], None]


class HandshakeRejected(ValueError):
    """An invalid opening, with the reason. `answer` is sent before the connection is closed."""

    def __init__(self, reason: str, answer: bytes = b"") -> None:
        super().__init__(reason)
        self.answer = answer


def raise_limit() -> None:
    """Raise the limit of descriptors of this process above the usual 1024, if it is allowed to."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = DESCRIPTORS if hard == resource.RLIM_INFINITY else min(DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < limit:
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))


def _limit() -> int:
    """Return the present limit of descriptors of this process, which other processes can change."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return 2**31 if soft == resource.RLIM_INFINITY else soft


def keep_alive(sock: socket.socket, idle: int, interval: int, count: int) -> None:
    """Detect that a host has disappeared within `idle` + `count` * `interval` seconds."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in ((socket.TCP_KEEPIDLE, idle), (socket.TCP_KEEPINTVL, interval), (socket.TCP_KEEPCNT, count)):
        sock.setsockopt(socket.IPPROTO_TCP, option, value)


@dataclass(eq=False)
class _PendingConnection:
    """A connection without a complete opening."""

    sock: socket.socket
    address: Any
    until: float  # time at which it expires
    data: bytearray
    idle: bool = False  # it had sent an opening before, and may be silent for longer


class HandshakeServer:
    """Accepts connections and hands on those that have sent a complete opening.

    Parameters
    ----------
    listener : socket.socket
        A bound and listening socket; `run` ends when it is closed.
    opening : callable
        Called with all bytes received; returns the length of the opening in them, None if it is incomplete, or raises
        `HandshakeRejected`.
    enter : callable
        Called with (socket, address, opening, data after the opening) on a thread of its own. The socket is blocking,
        and the callee has to close it.
    report : callable
        Logs a problem.
    """

    def __init__(
        self,
        listener: socket.socket,
        opening: Callable[[bytearray], int | None],
        enter: Callable[[socket.socket, Any, bytes, bytes], None],
        report: Report,
    ) -> None:
        self._listener = listener
        self._opening = opening
        self._enter = enter
        self._report = report
        self._pending: dict[int, _PendingConnection] = {}  # by descriptor, the longest wait first
        self._returned: deque[_PendingConnection] = deque()
        self._wake_reader, self._wake_writer = socket.socketpair()
        self._wake_reader.setblocking(False)
        self._wake_writer.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._paused_until = 0.0  # 0 while connections are accepted
        listener.setblocking(False)
        listener.listen(BACKLOG)

    def adopt_idle(self, sock: socket.socket, address: Any, rest: bytes, seconds: float) -> None:
        """Wait up to `seconds` for another opening from a connection that `enter` has finished with."""
        until = time.monotonic() + (OPENING_SECONDS if rest else seconds)
        self._returned.append(_PendingConnection(sock, address, until, bytearray(rest), idle=not rest))
        with contextlib.suppress(OSError):  # a wake-up is pending already, or the server has ended
            self._wake_writer.send(b"!")

    def run(self) -> None:
        """Serve until the listener is closed; that may be before the call."""
        try:
            self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
        except (OSError, ValueError):
            if self._listener.fileno() >= 0:
                raise
        self._selector.register(self._wake_reader, selectors.EVENT_READ, self._resume_idle)
        next_check = 0.0
        while self._listener.fileno() >= 0:
            try:
                events = [key for key, _ in self._selector.select(_TICK)]
                for key in sorted(events, key=lambda key: key.fileobj is self._listener):  # the listener last
                    key.data()
                if time.monotonic() > next_check:
                    self._close_expired()
                    next_check = time.monotonic() + _TICK
            except Exception:  # an internal error must not end the server
                if self._listener.fileno() >= 0:
                    with contextlib.suppress(Exception):
                        self._report("", f"connections: {traceback.format_exc()}")
                    time.sleep(_TICK)
        for pending in list(self._pending.values()):
            self._close(pending)
        for sock in (self._wake_reader, self._wake_writer, *(pending.sock for pending in self._returned)):
            sock.close()
        self._selector.close()

    # --- accepting connections ---

    def _accept(self) -> None:
        for count in range(ACCEPTED_AT_ONCE):
            if not self._has_room():
                if count:
                    return  # there may be no further connection to accept
                if not self._make_room():
                    self._pause()
                    return
            try:
                sock, address = self._listener.accept()
            except BlockingIOError:
                return
            except OSError as problem:
                if problem.errno in _EXHAUSTED:
                    self._pause()
                    return
                continue  # the client has disconnected already
            self._register(_PendingConnection(sock, address, time.monotonic() + OPENING_SECONDS, bytearray()))

    def _has_room(self) -> bool:
        """Return whether another descriptor may be used: the system assigns the lowest one that is free."""
        if len(self._pending) >= min(MAX_PENDING, _limit() // 4):
            return False
        try:
            lowest = os.dup(self._wake_reader.fileno())
        except OSError:
            return False
        os.close(lowest)
        return lowest < _limit() - min(RESERVE, _limit() // 8)

    def _make_room(self) -> bool:
        """Close the connection that has been silent longest; return False if there is none."""
        pending = next(iter(self._pending.values()), None)
        if pending is None:
            return False
        if not pending.idle:
            self._report("", "too many silent connections: the oldest ones are disconnected")
        self._close(pending)
        return True

    def _pause(self) -> None:
        if not self._paused_until:
            self._selector.unregister(self._listener)
            self._report("", f"all {_limit()} file descriptors are in use: new connections wait")
        self._paused_until = time.monotonic() + PAUSE_SECONDS

    def _resume_idle(self) -> None:
        self._wake_reader.recv(READ_BYTES)
        while self._returned:
            if len(self._pending) >= MAX_PENDING:
                self._make_room()
            self._register(self._returned.popleft())

    def _register(self, pending: _PendingConnection) -> None:
        pending.sock.setblocking(False)
        self._pending[pending.sock.fileno()] = pending
        self._selector.register(pending.sock, selectors.EVENT_READ, lambda: self._read(pending))
        if pending.data:
            self._parse_pending(pending)  # a client that sends requests in advance is not read until they are parsed
        else:
            self._read(pending)

    # --- reading openings ---

    def _read(self, pending: _PendingConnection) -> None:
        if pending.sock.fileno() < 0:  # closed in the same iteration
            return
        try:
            data = pending.sock.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._close(pending)
            return
        pending.data += data
        if pending.idle:
            pending.idle, pending.until = False, time.monotonic() + OPENING_SECONDS
        self._parse_pending(pending)

    def _parse_pending(self, pending: _PendingConnection) -> None:
        """Hand on a connection whose opening is complete; close it if the opening is invalid."""
        try:
            size = self._opening(pending.data)
        except HandshakeRejected as refusal:
            self._report(pending.address[0], f"{refusal}; disconnected")
            self._close(pending, refusal.answer)
            return
        if size is not None:
            self._dispatch(pending, size)

    def _dispatch(self, pending: _PendingConnection, size: int) -> None:
        self._forget(pending)
        pending.sock.setblocking(True)
        opening, rest = bytes(pending.data[:size]), bytes(pending.data[size:])
        thread = threading.Thread(
            target=self._enter,
            args=(pending.sock, pending.address, opening, rest),
            name=f"from {pending.address[0]}",
            daemon=True,
        )
        try:
            thread.start()
        except RuntimeError as problem:
            self._report("", f"connection closed: {problem}")
            pending.sock.close()

    def _forget(self, pending: _PendingConnection) -> None:
        del self._pending[pending.sock.fileno()]
        self._selector.unregister(pending.sock)

    def _close(self, pending: _PendingConnection, answer: bytes = b"") -> None:
        self._forget(pending)
        with pending.sock, contextlib.suppress(OSError):  # the client may have disconnected
            pending.sock.send(answer)

    # --- periodic checks ---

    def _close_expired(self) -> None:
        now = time.monotonic()
        for pending in [pending for pending in self._pending.values() if pending.until < now]:
            if not pending.idle:
                received = f"only {len(pending.data)} bytes" if pending.data else "nothing"
                self._report(pending.address[0], f"sent {received} for {OPENING_SECONDS:g} s and was disconnected")
            self._close(pending)
        if self._paused_until and now > self._paused_until:
            if self._has_room():
                self._paused_until = 0.0
                self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
                self._report("", "file descriptors for connections are available again")
            else:
                self._paused_until = now + PAUSE_SECONDS
