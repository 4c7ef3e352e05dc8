"""DedicatedSocket: the content of the port Audio over plain TCP, for clients without ROS. Does not use ROS.

A request is a text with ``Read Port``, ``N <int>`` and ``nfr <int>``, such as ``Read Port - N 4410 - nfr 1``, with or
without a line end: up to N frames from frame nfr on. The answer is little-endian: int32 n, int32 loss (frames from nfr
on that were no longer available), int64 next nfr, n int32 of the left ear, n int32 of the right ear.
"""

from __future__ import annotations

import errno
import re
import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator

from rosafe.ros1.bass.capture import Snapshot
from rosafe.ros1.transport.handshake_server import keep_alive

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8081
MAX_CLIENTS = 31
QUIET_SECONDS = 0.05  # without further bytes, until a request without a line end counts as complete
DEAD_SECONDS = 10.0  # without accepting a byte of an answer, until a client is disconnected
IDLE_SECONDS = 10.0  # without a complete request, until a client can be disconnected in favour of a new one
PAUSE_SECONDS = 0.5  # in accepting connections when the process has no file descriptor left
_MAX_REQUEST = 4096  # bytes that are kept if they contain no complete request
_MARK = b"Read Port"
_COUNT, _FIRST = re.compile(rb"N[^\w-]*(-?\d{1,40})"), re.compile(rb"nfr[^\w-]*(-?\d{1,40})")
_HEADER = struct.Struct("<iiq")


def read_frames(snapshot: Snapshot | None, count: int, first: int) -> bytes:
    """Return the answer to a request for `count` frames from index `first` on."""
    if snapshot is None:
        return _HEADER.pack(0, 0, min(first, 2**63 - 1))
    last, length = snapshot.last_frame_index, len(snapshot.left)
    oldest = max(0, last - length + 1)
    start = max(first, oldest)
    loss = start - first
    n = max(0, min(count, last - start + 1, length))
    at = length - (last - start + 1)
    header = _HEADER.pack(n, min(loss, 2**31 - 1), min(start + n, 2**63 - 1))
    parts = (channel[at : at + n].astype("<i4", copy=False).tobytes() for channel in (snapshot.left, snapshot.right))
    return header + b"".join(parts) if n else header


def take_requests(inbox: bytearray, quiet: bool) -> Iterator[tuple[int, int]]:
    """Remove all complete requests from `inbox` and yield their (count, first).

    A request is complete at a line end, at the beginning of the next request, or after a pause (`quiet`).
    """
    ends = [match.end() for match in re.finditer(rb"[\n\r\0]", inbox)]
    complete = max(ends[-1] if ends else 0, inbox.rfind(_MARK))
    if quiet and _parse(bytes(inbox[complete:])):
        complete = len(inbox)
    texts = bytes(inbox[:complete])
    del inbox[:complete]
    del inbox[: max(0, len(inbox) - _MAX_REQUEST)]
    for text in texts.split(_MARK)[1:]:
        request = _parse(_MARK + text)
        if request:
            yield request


def _parse(text: bytes) -> tuple[int, int] | None:
    """Return the (count, first) of a request; None if `text` is not a request. Negative numbers count as 0."""
    count, first = _COUNT.search(text), _FIRST.search(text)
    return (max(0, int(count[1])), max(0, int(first[1]))) if text.startswith(_MARK) and count and first else None


class _Client:
    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.inbox = bytearray()
        self.requests: list[tuple[int, int]] = []
        self.outbox = memoryview(b"")
        self.pending = False  # whether the inbox may contain a request without a line end
        self.received = self.sent = self.requested = time.monotonic()  # last bytes in, bytes out, complete request


class DedicatedSocket:
    """A server that holds at most one answer per client, so that a slow client needs no more memory than a window.

    If the maximum number of clients is connected, a client without a request for `IDLE_SECONDS` is replaced by a new
    one.

    Parameters
    ----------
    snapshot : callable
        Returns the content of the port, or None before the first acquisition.
    host, port : str, int
        Address of the server.
    report : callable
        Called with a line about each client that is rejected or disconnected.

    Raises
    ------
    OSError
        The address cannot be used.
    """

    def __init__(
        self, snapshot: Callable[[], Snapshot | None], host: str, port: int, report: Callable[[str], None]
    ) -> None:
        self._snapshot = snapshot
        self._report = report
        self._clients: dict[int, _Client] = {}
        self._listener = socket.create_server((host, port), backlog=MAX_CLIENTS + 1)  # with SO_REUSEADDR
        self._listener.setblocking(False)
        self.address = self._listener.getsockname()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._paused: float | None = None  # when accepting was paused

    def serve(self, stopping: threading.Event) -> None:
        """Answer clients until a stop; then close all connections."""
        try:
            while not stopping.is_set():
                for key, events in self._selector.select(0.01 if self._has_idle_clients() else 0.05):
                    if key.fileobj is self._listener:
                        self._accept()
                    else:
                        self._handle_client(key.data, events)
                self._check_idle_clients()
                self._accept_again()
        finally:
            for client in list(self._clients.values()):
                self._drop(client)
            self._selector.close()
            self._listener.close()

    def _has_idle_clients(self) -> bool:
        return any(client.pending for client in self._clients.values())

    def _accept(self) -> None:
        try:
            connection, (address, *_) = self._listener.accept()
        except OSError as problem:
            if problem.errno in (errno.EMFILE, errno.ENFILE):
                self._report(f"DedicatedSocket: pausing new connections: {problem.strerror}")
                self._selector.unregister(self._listener)  # it would be ready all the time
                self._paused = time.monotonic()
            return  # with another error, the client has disconnected already
        if len(self._clients) >= MAX_CLIENTS and not self._drop_idle_client():
            self._report(f"DedicatedSocket: {address} rejected: the limit of {MAX_CLIENTS} clients is reached")
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        keep_alive(connection, idle=60, interval=10, count=6)
        client = _Client(connection)
        self._clients[connection.fileno()] = client
        self._selector.register(connection, selectors.EVENT_READ, client)

    def _accept_again(self) -> None:
        if self._paused is not None and time.monotonic() - self._paused > PAUSE_SECONDS:
            self._selector.register(self._listener, selectors.EVENT_READ)
            self._paused = None

    def _drop_idle_client(self) -> bool:
        """Disconnect the client that has been idle longest, preferably one without a pending answer, if any is idle."""
        now = time.monotonic()
        idle = [client for client in self._clients.values() if now - client.requested > IDLE_SECONDS]
        if not idle:
            return False
        longest = min(idle, key=lambda client: (bool(client.outbox), client.requested))
        self._report(f"DedicatedSocket: disconnecting a client without a request for {now - longest.requested:.0f} s")
        self._drop(longest)
        return True

    def _drop(self, client: _Client) -> None:
        del self._clients[client.connection.fileno()]
        self._selector.unregister(client.connection)
        client.connection.close()

    def _handle_client(self, client: _Client, events: int) -> None:
        try:
            if events & selectors.EVENT_READ:
                data = client.connection.recv(_MAX_REQUEST)
                if not data:
                    return self._drop(client)
                client.received = time.monotonic()
                client.inbox += data
                client.requests += take_requests(client.inbox, quiet=False)
                client.pending = bool(client.inbox)
            self._send(client)
        except OSError:  # reset by the client
            self._drop(client)

    def _send(self, client: _Client) -> None:
        while client.requests or client.outbox:
            if not client.outbox:
                client.outbox = memoryview(read_frames(self._snapshot(), *client.requests.pop(0)))
                client.sent = client.requested = time.monotonic()
            try:
                sent = client.connection.send(client.outbox)
            except BlockingIOError:
                break
            client.outbox = client.outbox[sent:]
            client.sent = time.monotonic()
        # Nothing is read while an answer is being sent; further requests wait in the kernel.
        events = selectors.EVENT_WRITE if client.outbox else selectors.EVENT_READ
        self._selector.modify(client.connection, events, client)

    def _check_idle_clients(self) -> None:
        """Answer requests without a line end, and disconnect clients that do not accept their answers."""
        now = time.monotonic()
        for client in list(self._clients.values()):
            if client.outbox and now - client.sent > DEAD_SECONDS:
                self._drop(client)
            elif client.pending and not client.outbox and now - client.received > QUIET_SECONDS:
                client.pending = False
                client.requests += take_requests(client.inbox, quiet=True)
                self._handle_client(client, 0)
