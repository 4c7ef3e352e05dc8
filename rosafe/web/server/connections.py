"""Connections of an HTTP server, with limits on their number, duration and memory that do not depend on clients.

aiohttp itself reads all requests that a client sends, has no time limit for a request or for the reading of an answer,
and no limit on the number of connections: it takes more than 1 GB for 30 MB of requests in advance. Therefore it gets
complete requests here, one at a time. Data that a client sends in advance stays in the kernel, except a small buffer.
If the connection limit is reached, the connection that has been without a request for longest is closed.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import itertools
import logging
import re
import resource
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, cast

from aiohttp import web

from rosafe.web.server.access import HttpRefusal

BUFFER = 4 * 1024  # bytes of a request that are not counted; bytes read at a time
HEADERS_SIZE = 64 * 1024  # bytes of all headers of a request
SEND_BUFFER = 256 * 1024  # bytes of an answer in the kernel, by default up to 4 MB, which pause_writing does not report
STALL_SECONDS = 20.0  # until a client that does not read its answer is disconnected
IDLE_SECONDS = 3600.0  # until a connection without requests is closed
LOG_SECONDS = 60.0  # between two log entries about the connection limit

_END = re.compile(rb"\r?\n\r?\n")


@dataclass(frozen=True)
class Limits:
    """Limits of a server.

    Attributes
    ----------
    max_connections : int
        Number of connections, but at most half of the file descriptors. One address has at most half of them.
    max_url : int
        Bytes of a request line.
    max_header_bytes : int
        Bytes of all requests together that are longer than `BUFFER`.
    max_answers : int
        Bytes of all answers that clients are reading.
    request_seconds : float
        Time for a complete request from its first byte; for the first request, from the start of the connection.
    """

    max_connections: int
    max_url: int
    max_header_bytes: int
    max_answers: int
    request_seconds: float


class ClientAccount:
    """The connections from one address.

    Connections without a request in progress are `silent` (not authenticated) or `idle` (authenticated), the longest
    silence first. `long_polls` are connections with a request whose duration the client determines.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self.connections: set[HttpConnection] = set()
        self.silent: dict[HttpConnection, None] = {}
        self.idle: dict[HttpConnection, None] = {}
        self.long_polls: set[HttpConnection] = set()


class Connections:
    """All connections of a server.

    Parameters
    ----------
    limits : Limits
    format_refusal : callable
        Returns the body of a refusal and its media type.
    log : logging.Logger
    """

    def __init__(
        self, limits: Limits, format_refusal: Callable[[HttpRefusal], tuple[bytes, str]], log: logging.Logger
    ) -> None:
        descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        self._max = limits.max_connections if descriptors < 0 else min(limits.max_connections, descriptors // 2)
        self._max_per_address = self._max // 2
        self.limits = limits
        self.format_refusal = format_refusal
        self._log = log
        self._accounts: dict[str, ClientAccount] = {}
        self._logged_at = -LOG_SECONDS
        self.long_requests: dict[HttpConnection, int] = {}  # bytes of the requests that are longer than `BUFFER`
        self._answers: dict[object, tuple[object, int]] = {}  # answers being read, and their bytes, by reading

    def admit(self, connection: HttpConnection, address: str) -> ClientAccount | None:
        """Return the account of a new connection; None if the limit is reached and no other one can be closed."""
        account = self._accounts.get(address) or ClientAccount(address)
        full = len(account.connections) >= self._max_per_address
        if full or sum(len(one.connections) for one in self._accounts.values()) >= self._max:
            self._log_full(address)
            longest = self._silent_longest([account] if full else list(self._accounts.values()))
            if longest is None:
                return None
            longest.drop()
        self._accounts[address] = account
        account.connections.add(connection)
        account.silent[connection] = None
        return account

    @staticmethod
    def _silent_longest(accounts: list[ClientAccount]) -> HttpConnection | None:
        """Return the connection to close: of the address with most connections, authenticated ones last."""
        accounts.sort(key=lambda account: len(account.connections), reverse=True)
        groups = [*(account.silent for account in accounts), *(account.idle for account in accounts)]
        return next(itertools.chain.from_iterable(groups), None)

    def _log_full(self, address: str) -> None:
        if time.monotonic() > self._logged_at + LOG_SECONDS:
            self._logged_at = time.monotonic()
            self._log.warning("connection limit reached, now by %s: idle connections are closed", address)

    def forget(self, connection: HttpConnection) -> None:
        """Remove a connection that has ended."""
        account = connection.account
        self.long_requests.pop(connection, None)
        account.long_polls.discard(connection)
        account.silent.pop(connection, None)
        account.idle.pop(connection, None)
        if connection in account.connections:
            account.connections.remove(connection)
            if not account.connections:
                del self._accounts[account.address]

    def make_room(self, connection: HttpConnection) -> bool:
        """Close the connections that have been sending a long request for longest; return whether that suffices."""
        total = sum(self.long_requests.values())
        for other, size in list(self.long_requests.items()):
            if total <= self.limits.max_header_bytes:
                break
            if other is not connection and other in other.account.silent:
                other.drop()
                total -= size
        return total <= self.limits.max_header_bytes

    @contextlib.contextmanager
    def long_poll(self, connection: HttpConnection) -> Iterator[None]:
        """Mark a request whose duration the client determines. Half of a client's connections are for other requests.

        Raises
        ------
        HttpRefusal
            If there are too many of them.
        """
        polls, limit = connection.account.long_polls, self._max_per_address // 2
        if len(polls) >= limit:
            raise HttpRefusal(503, f"{limit} requests of this address are listening or waiting")
        polls.add(connection)
        try:
            yield
        finally:
            polls.discard(connection)

    @contextlib.contextmanager
    def reading_answer(self, data: object, size: int) -> Iterator[None]:
        """Account for an answer while a client reads it: `data` of `size` bytes, which other clients may share.

        Raises
        ------
        HttpRefusal
            If there is not enough memory.
        """
        sizes = {id(answer): answer_size for answer, answer_size in self._answers.values()}
        if sizes and id(data) not in sizes and sum(sizes.values()) + size > self.limits.max_answers:
            raise HttpRefusal(
                503, f"clients are reading {self.limits.max_answers >> 20} MiB of answers; try again later"
            )
        reading = object()
        self._answers[reading] = data, size
        try:
            yield
        finally:
            del self._answers[reading]


class HttpConnection(web.RequestHandler):
    """One connection. asyncio and aiohttp call its methods, except those of the section "for the server"."""

    def __init__(self, connections: Connections, server: web.Server, **options: Any) -> None:
        loop = asyncio.get_running_loop()
        limits = connections.limits
        super().__init__(
            server,
            loop=loop,
            max_line_size=limits.max_url,
            keepalive_timeout=IDLE_SECONDS,
            lingering_time=0.0,  # a request with a body ends the connection
            **options,
        )
        self.account = ClientAccount("")
        self.gone = asyncio.Event()
        self._connections = connections
        self._authenticated = False
        self._busy = False  # with a request
        self._is_websocket = False
        self._ahead = bytearray()  # received, but not passed on to aiohttp yet
        self._searched = 0  # bytes of `_ahead` that contain no end of a header
        self._head = 0  # bytes of the request in progress
        self._deadline: asyncio.TimerHandle | None = None
        self._stall: asyncio.TimerHandle | None = None

    # --- for the server ---

    def request_parsed(self) -> None:
        """Note that aiohttp has parsed the request: its deadline is met."""
        self._cancel_deadline()

    def mark_authenticated(self) -> None:
        """Mark the client as authenticated: if the limit is reached, other connections are closed first."""
        self._authenticated = True

    def become_websocket(self) -> None:
        """Pass all data on to aiohttp from now on; to be called once the WebSocket is prepared."""
        self._is_websocket = True
        self._socket.set_write_buffer_limits()  # the WebSocket's own limits apply
        super().data_received(bytes(self._ahead))
        self._ahead.clear()
        self._head = 0
        self._account_header()
        self._socket.resume_reading()

    def drop(self) -> None:
        """Close the connection immediately, whatever its state; unread data is lost."""
        self._leave()
        self._socket.abort()

    # --- the connection ---

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._socket = cast(asyncio.Transport, transport)
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self._socket.set_write_buffer_limits(high=0)  # so that pause_writing reports everything that is not read
        self._socket.max_size = BUFFER  # type: ignore[attr-defined]  # asyncio reads 256 KiB at a time
        account = self._connections.admit(self, _address(transport.get_extra_info("peername")))
        super().connection_made(transport)
        if account is None:
            self._refuse(HttpRefusal(503, "the connection limit is reached"))
        else:
            self.account = account
            self._start_deadline()

    def connection_lost(self, exc: BaseException | None) -> None:
        self._leave()
        if self._stall is not None:
            self._stall.cancel()
        super().connection_lost(exc)

    def _leave(self) -> None:
        """Release the connection's place and memory."""
        self.gone.set()
        self._ahead.clear()
        self._connections.forget(self)
        self._cancel_deadline()

    def _refuse(self, refusal: HttpRefusal) -> None:
        """Send a complete answer and close the connection, in cases in which aiohttp is not involved."""
        self._leave()
        body, media_type = self._connections.format_refusal(refusal)
        head = (
            f"HTTP/1.1 {refusal.status} {HTTPStatus(refusal.status).phrase}\r\nContent-Type: {media_type}; "
            f"charset=utf-8\r\nConnection: close\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        self._socket.write(head.encode() + body)
        self.force_close()

    # --- requests ---

    def data_received(self, data: bytes) -> None:
        if self.gone.is_set():
            return
        if self._is_websocket:
            super().data_received(data)
            return
        self._ahead += data
        self._account_header()
        if self in self._connections.long_requests and not self._connections.make_room(self):
            limit = self._connections.limits.max_header_bytes
            self._refuse(HttpRefusal(503, f"long requests occupy {limit >> 20} MiB; try again later"))
        elif not self._busy:
            self._next_request()
        elif len(self._ahead) >= BUFFER:
            self._socket.pause_reading()

    def _next_request(self) -> None:
        if not self._searched:
            del self._ahead[: len(self._ahead) - len(self._ahead.lstrip(b"\r\n"))]  # RFC 9112, section 2.2
        if self._ahead and self._deadline is None:
            self._start_deadline()
        end = _END.search(self._ahead, max(0, self._searched - 3))
        if end is None:
            self._searched = len(self._ahead)
            limit = self._connections.limits.max_url + HEADERS_SIZE
            if self._searched > limit:
                self._refuse(HttpRefusal(400, f"request: expected at most {limit >> 10} KiB"))
            return
        head = bytes(self._ahead[: end.end()])
        del self._ahead[: end.end()]
        self._searched, self._head, self._busy = 0, len(head), True
        self._waiting.pop(self, None)
        super().data_received(head)

    async def finish_response(self, *arguments: Any) -> Any:
        try:
            return await super().finish_response(*arguments)
        finally:
            self._loop.call_soon(self._finished)

    def _finished(self) -> None:
        if self.gone.is_set():
            return
        self._cancel_deadline()
        self._busy, self._head = False, 0
        self._account_header()
        self._waiting[self] = None
        self._next_request()
        if len(self._ahead) < BUFFER:
            self._socket.resume_reading()

    @property
    def _waiting(self) -> dict[HttpConnection, None]:
        """The connections of this client that wait for a request, in the group of this one."""
        return self.account.idle if self._authenticated else self.account.silent

    def handle_error(
        self, request: web.BaseRequest, status: int = 500, exc: BaseException | None = None, message: str | None = None
    ) -> web.Response:
        """Return the answer to an invalid request; aiohttp's own is HTML, with a traceback in the log."""
        if isinstance(exc, ConnectionError):  # the client has disconnected, or was disconnected
            raise exc
        if status >= HTTPStatus.INTERNAL_SERVER_ERROR:
            self.log_exception("cannot answer", exc_info=exc)
        if request.writer.output_size > 0:
            raise ConnectionAbortedError("part of another answer was sent already")
        reason = (message or str(exc) or HTTPStatus(status).phrase).splitlines()[0][:200]
        body, media_type = self._connections.format_refusal(HttpRefusal(status, reason))
        answer = web.Response(body=body, status=status, content_type=media_type, charset="utf-8")
        answer.force_close()
        return answer

    def _account_header(self) -> None:
        size = self._head + len(self._ahead)
        if size > BUFFER:
            self._connections.long_requests[self] = size
        else:
            self._connections.long_requests.pop(self, None)

    def _start_deadline(self) -> None:
        seconds = self._connections.limits.request_seconds
        refusal = HttpRefusal(408, f"no complete request within {seconds:g} s")
        self._deadline = self._loop.call_later(seconds, self._refuse, refusal)

    def _cancel_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    # --- answers ---

    def pause_writing(self) -> None:
        super().pause_writing()
        self._stall = self._loop.call_later(STALL_SECONDS, self.drop)

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._stall is not None:
            self._stall.cancel()
            self._stall = None


def _address(peer: Any) -> str:
    """Return the account of a connection: its IPv4 address, "loopback", or the /64 network of its IPv6 address."""
    if not peer:  # disconnected already
        return ""
    address = ipaddress.ip_address(str(peer[0]).partition("%")[0])
    if address.is_loopback:
        return "loopback"
    return str(address if address.version == 4 else ipaddress.ip_network((address, 64), strict=False))
