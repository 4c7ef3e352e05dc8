"""The limits of connections, one by one, with a small server in this process."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from aiohttp import web

from rosafe.web.server import connections
from rosafe.web.server.access import HttpRefusal
from rosafe.web.server.connections import ClientAccount, Connections, HttpConnection, Limits, _address
from rosafe.web.server.listener import HttpListener, connection_of
from tests.harness import PATIENCE, in_loop

LIMITS = Limits(
    max_connections=16,  # 8 of one address, 4 of which may poll
    max_url=1024,
    max_header_bytes=2**20,
    max_answers=2**20,
    request_seconds=PATIENCE,
)
BURST = 128  # connections at once, as many as an address may have
LARGE = bytes(32 * 2**20)  # more than the buffers of the kernel hold


class Client:
    """One connection."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    def send(self, path: str) -> None:
        self.writer.write(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())

    async def status(self) -> int:
        """Return the status of the next answer and skip its body."""
        head = (await self.reader.readuntil(b"\r\n\r\n")).decode()
        length = next(line for line in head.splitlines() if line.lower().startswith("content-length"))
        await self.reader.readexactly(int(length.partition(":")[2]))
        return int(head.split()[1])

    async def get(self, path: str) -> int:
        self.send(path)
        return await self.status()


def _format(refusal: HttpRefusal) -> tuple[bytes, str]:
    return str(refusal).encode(), "text/plain"


class World:
    """A server with the paths /now, /token (authenticates the connection), /poll and /large."""

    def __init__(self, limits: Limits) -> None:
        self.connections = Connections(limits, _format, logging.getLogger())
        self.may_answer = asyncio.Event()
        self.polling = asyncio.Semaphore(0)
        app = web.Application(middlewares=[self._guard])
        for path, handler in (("now", self._now), ("token", self._token), ("poll", self._poll), ("large", self._large)):
            app.router.add_get(f"/{path}", handler)
        self._listener = HttpListener(app, self.connections)
        self._clients: list[Client] = []

    async def __aenter__(self) -> World:
        self.port = await self._listener.start("127.0.0.1", 0)
        return self

    async def __aexit__(self, *_: object) -> None:
        self.may_answer.set()
        for client in self._clients:
            client.writer.transport.abort()
        await self._listener.close(0.1)

    async def connect(self) -> Client:
        client = Client(*await asyncio.open_connection("127.0.0.1", self.port, limit=65536))
        self._clients.append(client)
        return client

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        connection_of(request).request_parsed()
        try:
            return await handler(request)
        except HttpRefusal as refusal:
            return web.Response(status=refusal.status, text=str(refusal))

    async def _now(self, request: web.Request) -> web.StreamResponse:
        return web.Response(text="now")

    async def _token(self, request: web.Request) -> web.StreamResponse:
        connection_of(request).mark_authenticated()
        return web.Response(text="welcome")

    async def _poll(self, request: web.Request) -> web.StreamResponse:
        with self.connections.long_poll(connection_of(request)):
            self.polling.release()
            await self.may_answer.wait()
        return web.Response(text="done")

    async def _large(self, request: web.Request) -> web.StreamResponse:
        data = bytes(request.query.get("other", ""), "ascii") or LARGE
        with self.connections.reading_answer(data, len(LARGE)):
            response = web.StreamResponse()
            response.content_length = len(LARGE)
            await response.prepare(request)
            self.polling.release()
            await response.write(LARGE)
            await response.write_eof()
        return response


@in_loop(World, LIMITS)
async def test_half_of_the_connections_of_an_address_may_poll(world: World, /) -> None:
    polls = [await world.connect() for _ in range(4)]
    for client in polls:
        client.send("/poll")
        await world.polling.acquire()
    other = await world.connect()
    assert await other.get("/poll") == 503
    assert await other.get("/now") == 200
    world.may_answer.set()
    assert [await client.status() for client in polls] == [200] * 4
    assert await other.get("/poll") == 200


# --- which connections are closed ----------------------------------------------------------------------------------


class Fake:
    """A connection as `Connections` sees it."""

    def __init__(self, every: Connections) -> None:
        self.dropped = False
        self.account = ClientAccount("")
        self.every = every

    def drop(self) -> None:
        self.dropped = True
        self.every.forget(cast(HttpConnection, self))


class Room:
    """A server with room for eight connections, four from one address."""

    def __init__(self) -> None:
        self.every = Connections(replace(LIMITS, max_connections=8), _format, logging.getLogger())

    def come(self, address: str, busy: bool = False) -> Fake | None:
        """Return a new connection, None if it is rejected."""
        new = Fake(self.every)
        connection = cast(HttpConnection, new)
        account = self.every.admit(connection, address)
        if account is None:
            return None
        new.account = account
        if busy:
            del account.silent[connection]
        return new

    def authenticate(self, one: Fake | None) -> None:
        """An authenticated connection waits for its next request."""
        assert one is not None
        connection = cast(HttpConnection, one)
        del one.account.silent[connection]
        one.account.idle[connection] = None


def dropped(connections: list[Fake | None]) -> list[bool]:
    return [one.dropped for one in connections if one]


def test_the_longest_idle_connection_is_closed_first() -> None:
    server = Room()
    mine = [server.come("me") for _ in range(2)]
    crowd = [server.come("crowd", busy=number == 0) for number in range(10)]
    # Six connections of the crowd were closed, but not the one in use, and none of other clients.
    assert dropped(crowd) == [False] + [True] * 6 + [False] * 3
    others = [server.come("other") for _ in range(2)]  # now it is full
    assert server.come("third") is not None  # one of the client with most connections is closed
    assert dropped(crowd[7:]) == [True, False, False]
    assert not any(dropped(mine + others))


def test_a_connection_in_use_is_not_closed() -> None:
    server = Room()
    assert all(server.come("crowd", busy=True) for _ in range(4))
    assert server.come("crowd") is None
    assert all(server.come("more", busy=True) for _ in range(3))
    last = server.come("more")
    assert server.come("me") is not None
    assert last is not None and last.dropped
    assert server.come("you") is not None  # of the previous one, which waits


def test_authenticated_connections_are_closed_last() -> None:
    """But a full address loses its own ones, even if another address has a connection that is not authenticated."""
    server = Room()
    stranger = server.come("other")
    owner = [server.come("loopback") for _ in range(2)]
    for one in owner:
        server.authenticate(one)
    silent = [server.come("loopback") for _ in range(4)]
    assert dropped(silent) == [True, True, False, False]
    for one in silent[2:]:
        server.authenticate(one)
    assert dropped(owner) == [False, False]
    assert server.come("loopback") is not None
    assert dropped(owner) == [True, False] and dropped([stranger]) == [False]


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("127.0.0.1", "127.8.9.10", True),
        ("127.0.0.1", "::1", True),
        ("10.0.0.1", "10.0.0.2", False),
        ("10.0.0.1", "127.0.0.1", False),
        ("2001:db8::1", "2001:db8::ffff:2", True),
        ("2001:db8::1", "2001:db8:0:1::1", False),
        ("fe80::1%eth0", "fe80::1", True),
    ],
)
def test_addresses_of_one_client(one: str, other: str, same: bool) -> None:
    assert (_address((one, 1)) == _address((other, 2))) is same


@in_loop(World, LIMITS)
async def test_the_token_authenticates_a_connection(world: World, /) -> None:
    authenticated = await world.connect()
    assert await authenticated.get("/token") == 200
    silent = [await world.connect() for _ in range(7)]
    assert await (await world.connect()).get("/now") == 200  # the ninth connection
    assert await silent[0].reader.read() == b""  # the longest silence of those that are not authenticated
    assert await authenticated.get("/now") == 200


@in_loop(World, replace(LIMITS, max_connections=BURST))
async def test_a_burst_of_requests_does_not_lock_out_other_clients(world: World, /) -> None:
    """More requests than an address may have connections arrive before the server has handled the first one."""
    for steps in range(12):  # of the event loop, between the burst and the other client
        with ExitStack() as stack:
            for _ in range(BURST):
                one = stack.enter_context(socket.create_connection(("127.0.0.1", world.port)))
                one.sendall(b"GET /now HTTP/1.1\r\nHost: localhost\r\n\r\n")
            for _ in range(steps):
                await asyncio.sleep(0)
            sock = socket.create_connection(("127.0.0.1", world.port))
            sock.sendall(b"GET /now HTTP/1.1\r\nHost: localhost\r\n\r\n")
            other = Client(*await asyncio.open_connection(sock=sock))
            assert await other.status() == 200, steps
            other.writer.transport.abort()


def long_request(path: str) -> bytes:
    """Return a request of 20 kB without its last two bytes."""
    lines = b"".join(b"x%d: %s\r\n" % (number, b"y" * 3990) for number in range(5))
    return b"GET /%s HTTP/1.1\r\nHost: localhost\r\n" % path.encode() + lines


@in_loop(World, replace(LIMITS, max_header_bytes=50_000))
async def test_long_requests_together_have_a_limit(world: World, /) -> None:
    """Of those without an end the oldest is closed; those in progress stay, and a further one is refused."""
    clients = []
    for number in range(3):
        clients.append(await world.connect())
        clients[-1].writer.write(long_request("poll"))
        async with asyncio.timeout(PATIENCE):
            while sum(world.connections.long_requests.values()) < 20_000 * min(2, number + 1):
                await asyncio.sleep(0.001)
    assert await clients[0].reader.read() == b""
    for client in clients[1:]:
        client.writer.write(b"\r\n")
        await world.polling.acquire()
    other = await world.connect()
    other.writer.write(long_request("now"))
    assert await other.status() == 503
    assert await (await world.connect()).get("/now") == 200
    world.may_answer.set()
    assert [await client.status() for client in clients[1:]] == [200, 200]
    other = await world.connect()
    other.writer.write(long_request("now") + b"\r\n")
    assert await other.status() == 200


@in_loop(World, LIMITS)
async def test_answers_that_clients_read_slowly_leave_no_memory_for_others(world: World, /) -> None:
    """The same data may be sent to several clients."""
    slow = await world.connect()
    slow.send("/large")
    await world.polling.acquire()
    other = await world.connect()
    assert await other.get("/large?other=1") == 503
    other.send("/large")
    await world.polling.acquire()
    assert [await client.status() for client in (slow, other)] == [200, 200]
    assert await other.get("/large?other=1") == 200


def test_a_single_answer_may_be_too_large() -> None:
    every = Connections(replace(LIMITS, max_answers=100), _format, logging.getLogger())
    samples = np.zeros(2), np.zeros(2)
    one, same = (every.reading_answer(samples[0], 1000) for _ in range(2))
    with one, same, pytest.raises(HttpRefusal, match="clients are reading"), every.reading_answer(samples[1], 1):
        pass
    with every.reading_answer(samples[0], 60), every.reading_answer(samples[1], 40):
        pass


# --- time limits ------------------------------------------------------------------------------------------------


async def statuses_until_the_end(client: Client) -> list[bytes]:
    """Return the first lines of all answers until the server closes the connection."""
    answers = await client.reader.read()
    return [line.split()[1] for line in answers.splitlines() if line.startswith(b"HTTP/1.1 ")]


@pytest.mark.parametrize("sent", [b"", b"GET /now HTTP/1.1\r\nHo", b"GET /now HTTP/1.1\r\nHost: localhost\r\nX: "])
@in_loop(World, replace(LIMITS, request_seconds=0.5))
async def test_a_request_without_an_end(world: World, /, sent: bytes) -> None:
    """At once, or on a connection that was used before and may be idle; the limit applies to the complete request."""
    new, used = await world.connect(), await world.connect()
    assert await used.get("/now") == 200
    new.writer.write(sent)
    slow = asyncio.create_task(byte_by_byte(new)) if sent.endswith(b"X: ") else None
    assert await statuses_until_the_end(new) == [b"408"]
    if slow:
        slow.cancel()
    if sent:
        assert await used.get("/now") == 200
        used.writer.write(sent)
        assert await statuses_until_the_end(used) == [b"408"]


async def byte_by_byte(client: Client) -> None:
    while True:
        client.writer.write(b"x")
        await asyncio.sleep(0.05)


@in_loop(World, LIMITS)
async def test_a_client_that_does_not_read_is_disconnected(world: World, /, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "STALL_SECONDS", 0.5)
    slow, other = await world.connect(), await world.connect()
    slow.send("/large")
    await world.polling.acquire()
    slow.writer.transport.pause_reading()  # type: ignore[attr-defined]
    assert await other.get("/large?other=1") == 503
    while world.connections._answers:
        await asyncio.sleep(0.01)
