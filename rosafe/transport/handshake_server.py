"""A listening socket that silence, garbage and floods do not block. No ROS in here.

Whoever connects has to say something first: a TCPROS header, an HTTP request. One thread accepts connections and reads
these openings beside each other, each within a few seconds and so many bytes; only what has come whole gets a thread.
Where there are too many that have not said anything yet, the one that has kept silent longest goes. Where descriptors
run out, connections wait to be accepted until there are some again; the last few are left to the process itself.
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
from typing import Any

BACKLOG = 1024  # connections that wait to be accepted
DESCRIPTORS = 4096  # wanted at the start, as far as the hard limit allows; there is a thread for most of them
RESERVE = 64  # descriptors that connections do not get: files, devices, and what the process itself connects to
MAX_PENDING = 256  # connections whose opening has not come yet
OPENING_SECONDS = 5.0  # for a whole opening
READ_BYTES = 65536  # at once
PAUSE_SECONDS = 0.2  # between two looks whether there are descriptors again
ACCEPTED_AT_ONCE = 32  # before those are heard that have said something
_TICK = 0.25  # seconds between two looks for those whose time is over
_EXHAUSTED = {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM}

# Takes (which peer or "", what is wrong) for the log; what happens again and again is its business.
Report = Callable[[str, str], None]


class HandshakeRejected(ValueError):
    """An opening that nobody can mean; the text says why. `answer` is sent before the connection is closed."""

    def __init__(self, why: str, answer: bytes = b"") -> None:
        super().__init__(why)
        self.answer = answer


def raise_limit() -> None:
    """Let this process have more descriptors than the usual 1024, where it may."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = DESCRIPTORS if hard == resource.RLIM_INFINITY else min(DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _limit() -> int:
    """How many descriptors this process may have, which can be changed from outside."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return 2**31 if soft == resource.RLIM_INFINITY else soft


class _PendingConnection:
    """A connection that has not said all it must yet."""

    def __init__(self, sock: socket.socket, address: Any, until: float, data: bytes = b"") -> None:
        self.sock = sock
        self.address = address
        self.until = until
        self.data = bytearray(data)
        self.idle = False  # one that was here before and may be silent for longer


class HandshakeServer:
    """Accepts connections and hands on those that have said what they must.

    Parameters
    ----------
    listener : socket.socket
        Bound and listening; `run` ends when it is closed.
    opening : callable
        Takes all bytes that have come; returns how many of them are the opening, None where more must come, or raises
        `HandshakeRejected`.
    enter : callable
        Takes (socket, address, opening, what came after it) on a thread of its own; from then on the socket is its to
        close. It is blocking.
    report : callable
        Takes what is worth a line in the log.
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
        self._guests: dict[int, _PendingConnection] = {}  # the one that has waited longest first
        self._back: deque[_PendingConnection] = deque()
        self._wake_reader, self._wake_writer = socket.socketpair()
        self._wake_reader.setblocking(False)
        self._wake_writer.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._paused_until = 0.0  # 0 while connections are accepted
        listener.setblocking(False)
        listener.listen(BACKLOG)

    def adopt_idle(self, sock: socket.socket, address: Any, rest: bytes, seconds: float) -> None:
        """Wait up to `seconds` for another opening from a connection that had entered; for `enter`, at its end."""
        guest = _PendingConnection(sock, address, time.monotonic() + (OPENING_SECONDS if rest else seconds), rest)
        guest.idle = not rest
        self._back.append(guest)
        with contextlib.suppress(OSError):  # it rings already, or all is over
            self._wake_writer.send(b"!")

    def run(self) -> None:
        """Serve until the listener is closed."""
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
        self._selector.register(self._wake_reader, selectors.EVENT_READ, self._resume_idle)
        next_look = 0.0
        while self._listener.fileno() >= 0:
            try:
                events = [key for key, _ in self._selector.select(_TICK)]
                for key in sorted(events, key=lambda key: key.fileobj is self._listener):  # first those who are here
                    key.data()
                if time.monotonic() > next_look:
                    self._close_expired()
                    next_look = time.monotonic() + _TICK
            except Exception:  # a fault of ours must not make the node deaf
                if self._listener.fileno() >= 0:
                    with contextlib.suppress(Exception):
                        self._report("", f"connections: {traceback.format_exc()}")
                    time.sleep(_TICK)
        for guest in list(self._guests.values()):
            self._close(guest)
        for sock in (self._wake_reader, self._wake_writer, *(guest.sock for guest in self._back)):
            sock.close()
        self._selector.close()

    # --- coming in ---

    def _accept(self) -> None:
        for turn in range(ACCEPTED_AT_ONCE):
            if not self._has_room():
                if turn:
                    return  # there may be nobody to make room for
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
                continue  # it has left already
            self._register(_PendingConnection(sock, address, time.monotonic() + OPENING_SECONDS))

    def _has_room(self) -> bool:
        """Whether another descriptor may be taken: the system gives out the lowest one that is free."""
        if len(self._guests) >= min(MAX_PENDING, _limit() // 4):
            return False
        try:
            lowest = os.dup(self._wake_reader.fileno())
        except OSError:
            return False
        os.close(lowest)
        return lowest < _limit() - min(RESERVE, _limit() // 8)

    def _make_room(self) -> bool:
        """Let go whoever has kept silent longest; False where there is nobody."""
        guest = next(iter(self._guests.values()), None)
        if guest is None:
            return False
        if not guest.idle:
            self._report("", "too many connections that say nothing: those that came first are disconnected")
        self._close(guest)
        return True

    def _pause(self) -> None:
        if not self._paused_until:
            self._selector.unregister(self._listener)
            self._report("", f"of {_limit()} file descriptors none is left for connections: new ones wait")
        self._paused_until = time.monotonic() + PAUSE_SECONDS

    def _resume_idle(self) -> None:
        self._wake_reader.recv(READ_BYTES)
        while self._back:
            if len(self._guests) >= MAX_PENDING:
                self._make_room()
            self._register(self._back.popleft())

    def _register(self, guest: _PendingConnection) -> None:
        guest.sock.setblocking(False)
        self._guests[guest.sock.fileno()] = guest
        self._selector.register(guest.sock, selectors.EVENT_READ, lambda: self._read(guest))
        if guest.data:
            self._parse_pending(guest)  # who has said much at once must not make us take more and more
        else:
            self._read(guest)

    # --- what they say ---

    def _read(self, guest: _PendingConnection) -> None:
        if guest.sock.fileno() < 0:  # dismissed in this very turn
            return
        try:
            part = guest.sock.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            part = b""
        if not part:
            self._close(guest)
            return
        guest.data += part
        if guest.idle:
            guest.idle, guest.until = False, time.monotonic() + OPENING_SECONDS
        self._parse_pending(guest)

    def _parse_pending(self, guest: _PendingConnection) -> None:
        """Hand on or send away whoever has said enough for that."""
        try:
            size = self._opening(guest.data)
        except HandshakeRejected as refusal:
            self._report(guest.address[0], f"{refusal}; disconnected")
            self._close(guest, refusal.answer)
            return
        if size is not None:
            self._dispatch(guest, size)

    def _dispatch(self, guest: _PendingConnection, size: int) -> None:
        self._forget(guest)
        guest.sock.setblocking(True)
        opening, rest = bytes(guest.data[:size]), bytes(guest.data[size:])
        thread = threading.Thread(
            target=self._enter,
            args=(guest.sock, guest.address, opening, rest),
            name=f"from {guest.address[0]}",
            daemon=True,
        )
        try:
            thread.start()
        except RuntimeError as problem:
            self._report("", f"a connection is closed: {problem}")
            guest.sock.close()

    def _forget(self, guest: _PendingConnection) -> None:
        del self._guests[guest.sock.fileno()]
        self._selector.unregister(guest.sock)

    def _close(self, guest: _PendingConnection, answer: bytes = b"") -> None:
        self._forget(guest)
        with guest.sock, contextlib.suppress(OSError):  # it may not want to know
            guest.sock.send(answer)

    # --- now and then ---

    def _close_expired(self) -> None:
        now = time.monotonic()
        for guest in [guest for guest in self._guests.values() if guest.until < now]:
            if not guest.idle:
                said = f"{len(guest.data)} bytes and no more" if guest.data else "nothing"
                self._report(guest.address[0], f"said {said} for {OPENING_SECONDS:g} s and was disconnected")
            self._close(guest)
        if self._paused_until and now > self._paused_until:
            if self._has_room():
                self._paused_until = 0.0
                self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
                self._report("", "there are file descriptors for connections again")
            else:
                self._paused_until = now + PAUSE_SECONDS
