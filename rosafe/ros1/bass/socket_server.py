"""DedicatedSocket: the content of the port Audio over plain TCP, for clients without ROS. Does not use ROS.

A request is a text with ``Read Port``, ``N <int>`` and ``nfr <int>``, such as ``Read Port - N 4410 - nfr 1``, with or
without a line end: up to N frames from frame nfr on. The answer is little-endian: int32 n, int32 loss (frames from nfr
on that were no longer available), int64 next nfr, n int32 of the left ear, n int32 of the right ear.
"""

from __future__ import annotations

import contextlib
import errno
import re
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator

from rosafe.audio.stream.capture import Snapshot
from rosafe.ros1.transport.handshake_server import keep_alive

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8081
MAX_CLIENTS = 31
QUIET_SECONDS = 0.05  # without further bytes, until a request without a line end counts as complete
DEAD_SECONDS = 10.0  # without accepting a byte of an answer, until a client is disconnected
IDLE_SECONDS = 10.0  # without a complete request, until a client can be disconnected in favour of a new one
POLL_SECONDS = 0.05  # maximum, so that a stop is noticed
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
    """A connection, and the thread that serves it. It holds at most one answer."""

    def __init__(self, connection: socket.socket, snapshot: Callable[[], Snapshot | None]) -> None:
        self.requested = time.monotonic()  # time of the last complete request
        self.answering = False
        self._connection = connection
        self._snapshot = snapshot
        self._thread = threading.Thread(target=self._serve, name="socket client", daemon=True)
        self._thread.start()

    @property
    def connected(self) -> bool:
        """Whether the client is connected."""
        return self._thread.is_alive()

    def _serve(self) -> None:
        inbox = bytearray()
        quiet = True  # whether the inbox contains no request, even without a line end
        with self._connection as connection, contextlib.suppress(OSError):  # it has disconnected, or reads no answer
            while True:
                connection.settimeout(None if quiet else QUIET_SECONDS)
                try:
                    data = connection.recv(_MAX_REQUEST)
                except TimeoutError:
                    quiet = True
                else:
                    if not data:
                        return
                    inbox += data
                    quiet = False
                for count, first in list(take_requests(inbox, quiet)):
                    self._answer(count, first)

    def _answer(self, count: int, first: int) -> None:
        self.requested, self.answering = time.monotonic(), True
        self._connection.settimeout(DEAD_SECONDS)
        rest = memoryview(read_frames(self._snapshot(), count, first))
        while rest:
            rest = rest[self._connection.send(rest) :]
        self.answering = False

    def close(self) -> None:
        """Disconnect."""
        with contextlib.suppress(OSError):  # it has disconnected
            self._connection.shutdown(socket.SHUT_RDWR)
        self._thread.join()


class DedicatedSocket:
    """A server with a thread for each client.

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
        self._clients: list[_Client] = []
        self._listener = socket.create_server((host, port), backlog=MAX_CLIENTS + 1)  # with SO_REUSEADDR
        self._listener.settimeout(POLL_SECONDS)
        self.address = self._listener.getsockname()

    def serve(self, stopping: threading.Event) -> None:
        """Answer clients until a stop; then close all connections."""
        with self._listener:
            while not stopping.is_set():
                try:
                    connection, (address, *_) = self._listener.accept()
                except OSError as problem:  # no client for `POLL_SECONDS`, or it has disconnected already
                    if problem.errno in (errno.EMFILE, errno.ENFILE):
                        self._report(f"DedicatedSocket: pausing new connections: {problem.strerror}")
                        stopping.wait(PAUSE_SECONDS)
                else:
                    self._add(connection, address)
                self._clients = [client for client in self._clients if client.connected]
        for client in self._clients:
            client.close()

    def _add(self, connection: socket.socket, address: str) -> None:
        self._clients = [client for client in self._clients if client.connected]
        if len(self._clients) >= MAX_CLIENTS and not self._drop_idle_client():
            self._report(f"DedicatedSocket: {address} rejected: the limit of {MAX_CLIENTS} clients is reached")
            connection.close()
            return
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        keep_alive(connection, idle=60, interval=10, count=6)
        try:
            self._clients.append(_Client(connection, self._snapshot))
        except RuntimeError as problem:  # no thread is available
            self._report(f"DedicatedSocket: {address} rejected: {problem}")
            connection.close()

    def _drop_idle_client(self) -> bool:
        """Disconnect the client that has been idle longest, preferably one without a pending answer, if any is idle."""
        now = time.monotonic()
        idle = [client for client in self._clients if now - client.requested > IDLE_SECONDS]
        if not idle:
            return False
        longest = min(idle, key=lambda client: (client.answering, client.requested))
        self._report(f"DedicatedSocket: disconnecting a client without a request for {now - longest.requested:.0f} s")
        longest.close()
        self._clients.remove(longest)
        return True
