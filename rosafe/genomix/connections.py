"""HTTP connections: how long, how many and from whom, so that no client keeps others out or fills the memory.

aiohttp gets whole requests, one at a time; what a client sends ahead waits, most of it in the kernel. Where there is
no room for another connection, the one goes that has been without a request for longest.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import re
import resource
import time
from collections.abc import Iterator
from http import HTTPStatus
from typing import Any, cast

from aiohttp import web

from rosafe.genomix.errors import too_many
from rosafe.genomix.syntax import JSON, plain
from rosafe.interface import ComponentError

MAX_CONNECTIONS = 2000  # or half of the descriptors that there are
SHARE = 2  # what one address has at most is the whole divided by this
MAX_URL = 256 * 1024  # bytes of a request line: a list of 1024 numbers fits, percent signs and all
MAX_HEAD = MAX_URL + 64 * 1024  # bytes of a request line with all headers
SHORT = 16 * 1024  # bytes of a request that does not count; bytes read at a time
MAX_HEADS = 64 * 2**20  # bytes of all longer requests together
MAX_ANSWERS = 512 * 2**20  # bytes of all answers that clients are taking

REQUEST_SECONDS = 15.0  # for a whole request, from its first byte or, the first one, from connecting
IDLE_SECONDS = 3600.0  # a connection without requests is closed after
STALL_SECONDS = 60.0  # a client that does not take its answer is dropped after
YIELD_SECONDS = 5.0  # and where others want the memory, after
TELL_SECONDS = 60.0  # between two lines in the log that say there is no more room

log = logging.getLogger("genomixd")

_END = re.compile(rb"\r?\n\r?\n")
_BODY = re.compile(rb"\n(?:content-length:(?![ \t]*0*[ \t]*\r?\n)|transfer-encoding:)", re.IGNORECASE)


class Client:
    """The connections from one address.

    `waiting` are those without a request under way, in the order in which they came to it; `held` are those with a
    request that lasts as long as the client likes.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self.connections: set[Connection] = set()
        self.waiting: dict[Connection, None] = {}
        self.held: set[Connection] = set()


class Connections:
    """All connections of a server."""

    def __init__(self) -> None:
        descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        self._most = MAX_CONNECTIONS if descriptors < 0 else min(MAX_CONNECTIONS, descriptors // 2)
        self._clients: dict[str, Client] = {}
        self._count = 0
        self._told_at = -TELL_SECONDS
        self.heads = 0  # bytes of long requests
        self._answers: dict[Connection, tuple[object, int]] = {}  # what is being taken, and its bytes

    def admit(self, connection: Connection, address: str) -> Client | None:
        """The client of a new connection; None where there is no room for it and none can be made."""
        client = self._clients.get(address) or Client(address)
        full = len(client.connections) >= self._most // SHARE
        if full or self._count >= self._most:
            crowds = [client] if full else self._clients.values()
            waiting = [crowd for crowd in crowds if crowd.waiting]
            self._tell(client.address)
            if not waiting:
                return None
            next(iter(max(waiting, key=lambda crowd: len(crowd.connections)).waiting)).drop()
        self._clients[address] = client
        client.connections.add(connection)
        client.waiting[connection] = None
        self._count += 1
        return client

    def _tell(self, address: str) -> None:
        if time.monotonic() > self._told_at + TELL_SECONDS:
            self._told_at = time.monotonic()
            log.warning("as many clients are connected as may be, now from %s: idle ones are closed", address)

    def forget(self, connection: Connection) -> None:
        """A connection is over."""
        client = connection.client
        self._answers.pop(connection, None)
        client.held.discard(connection)
        client.waiting.pop(connection, None)
        if connection in client.connections:
            client.connections.remove(connection)
            self._count -= 1
            if not client.connections:
                self._clients.pop(client.address, None)

    @contextlib.contextmanager
    def held(self, connection: Connection) -> Iterator[None]:
        """While a request lasts as long as its client likes: half of a client's connections are for other ones."""
        held, most = connection.client.held, self._most // SHARE // 2
        if len(held) >= most:
            raise too_many(f"{most} requests of this address are listening or waiting")
        held.add(connection)
        try:
            yield
        finally:
            held.discard(connection)

    @contextlib.contextmanager
    def taking(self, connection: Connection, data: object, size: int) -> Iterator[None]:
        """While a client takes an answer: `data` of `size` bytes, which others may be taking, too.

        Clients that do not take theirs make room for it.
        """
        for other in list(self._answers):
            if self._fits(data, size):
                break
            if other.stalled(YIELD_SECONDS):
                other.drop()
        if not self._fits(data, size):
            raise too_many(f"clients are taking {MAX_ANSWERS >> 20} MiB of answers at this moment")
        self._answers[connection] = (data, size)
        try:
            yield
        finally:
            self._answers.pop(connection, None)

    def _fits(self, data: object, size: int) -> bool:
        taken = {id(one): one_size for one, one_size in self._answers.values()}
        return not taken or id(data) in taken or sum(taken.values()) + size <= MAX_ANSWERS


class Connection(web.RequestHandler):
    """One connection. asyncio and aiohttp call its methods; `client`, `gone` and `begun` are for the server."""

    def __init__(self, connections: Connections, server: web.Server, **options: Any) -> None:
        loop = asyncio.get_running_loop()
        super().__init__(server, loop=loop, max_line_size=MAX_URL, keepalive_timeout=IDLE_SECONDS, **options)
        self.client = Client("")
        self.gone = asyncio.Event()
        self._connections = connections
        self._open = False
        self._under_way = False  # a request
        self._ahead = bytearray()  # what has come, and aiohttp has not got yet
        self._searched = 0  # in that many bytes of it there is no end of a head
        self._head = 0  # bytes of the request under way
        self._counted = 0  # bytes of both that count
        self._late: asyncio.TimerHandle | None = None
        self._stall: asyncio.TimerHandle | None = None
        self._stalled_at = 0.0

    # --- the connection ---

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._socket = cast(asyncio.Transport, transport)
        self._socket.set_write_buffer_limits(high=0)  # so that pause_writing tells of all that is not taken
        self._socket.max_size = SHORT  # type: ignore[attr-defined]  # asyncio reads 256 KiB at a time
        client = self._connections.admit(self, _address(transport.get_extra_info("peername")))
        if client is None:
            self._socket.write(_refusal(503, too_many("so many clients are connected as there may be")))
            self._socket.close()
            return
        self.client = client
        self._open = True
        self._await_rest()
        super().connection_made(transport)

    def connection_lost(self, exc: BaseException | None) -> None:
        self._leave()
        if self._stall is not None:
            self._stall.cancel()
        super().connection_lost(exc)

    def drop(self) -> None:
        """End it at once, whatever it is about; what was not taken is lost."""
        self._leave()
        self._socket.abort()

    def _leave(self) -> None:
        """From now on others may have its place."""
        self._open = False
        self.gone.set()
        self._connections.forget(self)
        self._ahead.clear()
        self._head = 0
        self._weigh()
        self._rest_is_here()

    def _refuse(self, status: int, error: ComponentError) -> None:
        self._leave()
        self._socket.write(_refusal(status, error))
        self.force_close()

    # --- requests ---

    def data_received(self, data: bytes) -> None:
        if not self._open:
            return
        self._ahead += data
        self._weigh()
        if self._counted and self._connections.heads > MAX_HEADS:
            self._refuse(503, too_many(f"long requests take {MAX_HEADS >> 20} MiB at this moment"))
        elif not self._under_way:
            self._next_request()
        elif len(self._ahead) >= SHORT:
            self._socket.pause_reading()

    def _next_request(self) -> None:
        if not self._searched:
            del self._ahead[: len(self._ahead) - len(self._ahead.lstrip(b"\r\n"))]  # as RFC 9112, 2.2 asks for
        end = _END.search(self._ahead, max(0, self._searched - 3))
        if end is None:
            self._searched = len(self._ahead)
            if self._searched > MAX_HEAD:
                self._refuse(400, _no_request(f"a request has at most {MAX_HEAD >> 10} KiB"))
            elif self._ahead and self._late is None:
                self._await_rest()
            return
        head = bytes(self._ahead[: end.end()])
        del self._ahead[: end.end()]
        self._searched, self._head = 0, len(head)
        if _BODY.search(head):
            status = 400 if head.startswith(b"GET ") else 405
            self._refuse(status, _no_request("everything is a GET without a body; see /"))
            return
        self._under_way = True
        self.client.waiting.pop(self, None)
        if self._late is None:
            self._await_rest()  # should aiohttp see no end of it
        super().data_received(head)

    def begun(self) -> None:
        """aiohttp has understood the request."""
        self._rest_is_here()

    async def finish_response(self, *arguments: Any) -> Any:
        try:
            return await super().finish_response(*arguments)
        finally:
            self._loop.call_soon(self._finished)

    def _finished(self) -> None:
        if not self._open:
            return
        self._rest_is_here()
        self._under_way, self._head = False, 0
        self._weigh()
        self.client.waiting[self] = None
        self._next_request()
        if len(self._ahead) < SHORT:
            self._socket.resume_reading()

    def handle_error(
        self, request: web.BaseRequest, status: int = 500, exc: BaseException | None = None, message: str | None = None
    ) -> web.Response:
        """The answer to what is no request; aiohttp's own is HTML, with a traceback in the log."""
        if isinstance(exc, ConnectionError):  # a client that has vanished, or was dropped
            raise exc
        if status >= HTTPStatus.INTERNAL_SERVER_ERROR:
            self.log_exception("cannot answer", exc_info=exc)
        if request.writer.output_size > 0:
            raise ConnectionAbortedError("a part of another answer was sent already")
        what = (message or str(exc) or HTTPStatus(status).phrase).splitlines()[0][:200]
        body = _body(_no_request(what))
        answer = web.Response(body=body, status=status, content_type=JSON.media_type, charset="utf-8")
        answer.force_close()
        return answer

    def _weigh(self) -> None:
        size = self._head + len(self._ahead)
        counted = size if size > SHORT else 0
        self._connections.heads += counted - self._counted
        self._counted = counted

    def _await_rest(self) -> None:
        error = _no_request(f"no whole request within {REQUEST_SECONDS:g} s")
        self._late = self._loop.call_later(REQUEST_SECONDS, self._refuse, 408, error)

    def _rest_is_here(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None

    # --- answers ---

    def pause_writing(self) -> None:
        super().pause_writing()
        self._stalled_at = self._loop.time()
        self._stall = self._loop.call_later(STALL_SECONDS, self.drop)

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._stall is not None:
            self._stall.cancel()
            self._stall = None

    def stalled(self, seconds: float) -> bool:
        """Whether the client has taken nothing of its answer for so long."""
        return self._stall is not None and self._loop.time() - self._stalled_at >= seconds


def _address(peer: Any) -> str:
    """Whom a connection counts for: an address, all of this machine, or the network of a host with IPv6."""
    if not peer:
        return ""
    address = ipaddress.ip_address(str(peer[0]).partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is None:
            return "loopback" if address.is_loopback else str(ipaddress.ip_network((address, 64), strict=False))
        address = address.ipv4_mapped
    return "loopback" if address.is_loopback else str(address)


def _no_request(what: str) -> ComponentError:
    return ComponentError("::genomix::e_url", what=what)


def _body(error: ComponentError) -> bytes:
    return plain(JSON, error.body).encode("utf-8", "backslashreplace")


def _refusal(status: int, error: ComponentError) -> bytes:
    """A whole answer, where aiohttp is not asked."""
    body = _body(error)
    head = (
        f"HTTP/1.1 {status} {HTTPStatus(status).phrase}\r\nContent-Type: {JSON.media_type}; charset=utf-8\r\n"
        f"Connection: close\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    return head.encode() + body
