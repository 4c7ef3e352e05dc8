"""The limits of connections, one by one, with a small server in this process."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import Any
from unittest import mock

from aiohttp import web

from rosafe.web.server.connections import Connections, Limits
from rosafe.web.server.listener import HttpListener, connection_of
from rosafe.web.server.refusal import HttpRefusal
from tests.harness import PATIENCE

LIMITS = Limits(
    max_connections=16,  # 8 of one address, 4 of which may poll
    max_url=1024,
    max_header_bytes=2**20,
    max_answers=2**20,
    request_seconds=PATIENCE,
    idle_seconds=PATIENCE,
)
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


Connect = Callable[[], Awaitable[Client]]


def _format(refusal: HttpRefusal) -> tuple[bytes, str]:
    return str(refusal).encode(), "text/plain"


class World:
    """A server with the paths /now, /token (authenticates the connection), /poll and /large."""

    def __init__(self, limits: Limits) -> None:
        self.connections = Connections(
            limits, lambda refusal: (str(refusal).encode(), "text/plain"), logging.getLogger()
        )
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
        with self.connections.reading_answer(connection_of(request), data, len(LARGE)):
            response = web.StreamResponse()
            response.content_length = len(LARGE)
            await response.prepare(request)
            self.polling.release()
            await response.write(LARGE)
            await response.write_eof()
        return response


def run(test: Callable[[World], Awaitable[None]], limits: Limits = LIMITS) -> None:
    async def limited() -> None:
        async with asyncio.timeout(PATIENCE), World(limits) as world:
            await test(world)

    asyncio.run(limited())


def test_half_of_the_connections_of_an_address_may_poll() -> None:
    async def check(world: World) -> None:
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

    run(check)


def test_authenticated_connections_are_closed_last() -> None:
    async def check(world: World) -> None:
        authenticated = await world.connect()
        assert await authenticated.get("/token") == 200
        silent = [await world.connect() for _ in range(7)]
        assert await (await world.connect()).get("/now") == 200  # the ninth connection
        assert await silent[0].reader.read() == b""  # the longest silence of those that are not authenticated
        assert await authenticated.get("/now") == 200

    run(check)


def test_a_full_address_loses_its_own_connections() -> None:
    """Also if another address has a connection that is not authenticated. All addresses of this machine are one."""
    connections = Connections(LIMITS, _format, logging.getLogger())
    dropped: list[str] = []

    def connection(address: str) -> Any:
        one = mock.Mock(has_unread_data=False, drop=lambda: dropped.append(address))
        one.account = connections.admit(one, address)
        return one

    connection("10.0.0.2")
    for _ in range(8):
        one = connection("10.0.0.1")
        one.account.idle[one] = one.account.silent.pop(one)  # authenticated
    assert not dropped
    connection("10.0.0.1")
    assert dropped == ["10.0.0.1"]


def test_a_burst_of_requests_does_not_lock_out_other_clients() -> None:
    """More requests than an address may have connections arrive before the server has handled the first one."""
    burst = 128

    async def check(world: World) -> None:
        for steps in range(12):  # of the event loop, between the burst and the other client
            with ExitStack() as stack:
                for _ in range(burst):
                    one = stack.enter_context(socket.create_connection(("127.0.0.1", world.port)))
                    one.sendall(b"GET /now HTTP/1.1\r\nHost: localhost\r\n\r\n")
                for _ in range(steps):
                    await asyncio.sleep(0)
                sock = socket.create_connection(("127.0.0.1", world.port))
                sock.sendall(b"GET /now HTTP/1.1\r\nHost: localhost\r\n\r\n")
                other = Client(*await asyncio.open_connection(sock=sock))
                assert await other.status() == 200, steps
                other.writer.transport.abort()

    run(check, replace(LIMITS, max_connections=burst))


def test_answers_that_clients_read_slowly_leave_no_memory_for_others() -> None:
    """The same data may be sent to several clients."""

    async def check(world: World) -> None:
        slow = await world.connect()
        slow.send("/large")
        await world.polling.acquire()
        other = await world.connect()
        assert await other.get("/large?other=1") == 503
        other.send("/large")
        await world.polling.acquire()
        assert [await client.status() for client in (slow, other)] == [200, 200]
        assert await other.get("/large?other=1") == 200

    run(check)
