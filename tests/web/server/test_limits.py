"""Clients without a token neither fill the memory of genomixd and the live page nor lock out other clients."""

from __future__ import annotations

import asyncio
import http.client
import random
import re
import select
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

import pytest

from tests import harness
from tests.harness import Graph, Process, proc, wait_for
from tests.web.genomix import attacks
from tests.web.genomix import world as genomix
from tests.web.live import world as live

pytestmark = pytest.mark.ros

MEMORY = 50  # MB above that of an idle server
SENT = 30_000_000  # bytes of an attack, at most
OPENED = 600  # connections of an attack, at most
SECONDS = 2.0  # of an attack, at most


class Server(NamedTuple):
    process: Process
    port: int
    page: live.Live | None

    def memory(self, which: str = "VmRSS") -> int:
        """Return the megabytes now, or (VmHWM) the maximum since `reset`."""
        text = proc(self.process.pid, "status").read_text()
        found = re.search(rf"{which}:\s+(\d+)", text)
        assert found is not None
        return int(found[1]) // 1024

    def reset(self) -> None:
        proc(self.process.pid, "clear_refs").write_text("5")

    def serves(self) -> bool:
        """Return whether another client is served."""
        if self.page is not None:
            return asyncio.run(_page_opens(self.page))
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=harness.PATIENCE)
        connection.request("GET", "/components")
        with connection.getresponse() as answer:
            return answer.status == 200


async def _page_opens(page: live.Live) -> bool:
    async with live.page(page) as client:
        return "version" in await client.until("hello")


@pytest.fixture(scope="module")
def page(graph: Graph) -> Iterator[Server]:
    """A `rosafe live` that only this module uses."""
    with live.live(graph) as page:
        yield Server(page.process, page.port, page)


@pytest.fixture(scope="module")
def api(graph: Graph) -> Iterator[Server]:
    """A genomixd that only this module uses."""
    with genomix.genomixd(graph) as (process, port):
        yield Server(process, port, None)


@pytest.fixture(params=["page", "api"])
def server(request: pytest.FixtureRequest) -> Server:
    """Each of the two servers."""
    server: Server = request.getfixturevalue(request.param)
    return server


def flood(port: int, sent: bytes, together: int, refill: bool = True) -> None:
    """Send `sent` repeatedly on many connections and read nothing; closed connections are replaced."""
    end, total, opened = time.monotonic() + SECONDS, 0, 0
    done: dict[socket.socket, int] = {}  # bytes of `sent` that are sent
    try:
        while time.monotonic() < end and total < SENT and (refill or not opened or done):
            while len(done) < together and opened < (OPENED if refill else together):
                connection = socket.socket()
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                connection.connect(("127.0.0.1", port))
                connection.setblocking(False)
                done[connection] = 0
                opened += 1
            if not done:
                break
            for connection in select.select((), list(done), (), 0.1)[1]:
                try:
                    count = connection.send(sent[done[connection] :])
                except BlockingIOError:
                    continue
                except ConnectionError:
                    del done[connection]
                    connection.close()
                    continue
                done[connection] = (done[connection] + count) % len(sent)
                total += count
    finally:
        for connection in done:
            connection.close()


HOST = b"Host: 127.0.0.1\r\n"
TOKEN = b"GET /?token=x HTTP/1.1\r\n" + HOST
FILE = b"GET /panel.js HTTP/1.1\r\n" + HOST
LONG = b"".join(b"x%d: " % number + b"y" * 8000 + b"\r\n" for number in range(7))
UPGRADE = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: "
ATTACKS = {
    "pipelined": (TOKEN + b"\r\n", 1),
    "pipelined by many": (TOKEN + b"\r\n", 100),
    "files": (FILE + b"\r\n", 1),
    "files by many": (FILE + b"\r\n", 250),
    "another host": (b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n", 100),
    "long headers": (TOKEN + LONG + b"\r\n", 250),
    "many headers": (TOKEN + b"a:b\r\n" * 13_000 + b"\r\n", 250),
    "headers without an end": (TOKEN + LONG * 10, 250),
    "half a long request": (TOKEN + LONG, 250),
    "an endless line": (b"GET /?token=" + b"x" * 500_000, 250),
    "half a request": (b"GET /?tok", 300),
    "cookies": (TOKEN + b"Cookie: " + b"a=b;" * 2000 + b"\r\n\r\n", 100),
    "WebSocket": (b"GET /socket HTTP/1.1\r\n" + HOST + UPGRADE + b"A" * 22 + b"==\r\n\r\n" + b"\x82\xff" * 50_000, 250),
    "HTTP/1.0": (b"GET /?token=x HTTP/1.0\r\nConnection: keep-alive\r\n" + HOST + b"\r\n", 250),
    "bodies": (b"POST / HTTP/1.1\r\n" + HOST + b"Content-Length: 1000000000\r\n\r\n" + b"x" * 500_000, 250),
    "chunks": (b"POST / HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: chunked\r\n\r\n" + b"x" * 500_000, 250),
    "nothing valid": (random.Random(1).randbytes(200_000), 250),
    "empty lines": (b"\r\n" * 100_000, 250),
}


NAMES = list(ATTACKS)


@pytest.mark.parametrize(
    ("which", "names"),
    [
        ("page", NAMES[::2]),  # the servers share this code
        ("api", NAMES[1::2]),
        pytest.param("page", NAMES, marks=pytest.mark.exploration),
        pytest.param("api", NAMES, marks=pytest.mark.exploration),
    ],
    ids=["page", "api", "page-all", "api-all"],
)
def test_memory_without_a_token(request: pytest.FixtureRequest, which: str, names: list[str]) -> None:
    """The memory stays within its limit for each attack, and for all attacks together."""
    server: Server = request.getfixturevalue(which)
    assert server.serves()
    idle = server.memory()
    for name in names:
        sent, together = ATTACKS[name]
        server.reset()
        flood(server.port, sent * max(1, 50_000 // len(sent)), together)
        assert server.memory("VmHWM") <= idle + MEMORY, name
    assert server.serves()
    assert "Traceback" not in server.process.err


@pytest.mark.parametrize("sent", [b"", b"GET /?tok"], ids=["silent", "half"])
def test_silent_connections_do_not_lock_out_other_clients(server: Server, sent: bytes) -> None:
    with attacks.crowd(server.port, 300, sent):
        assert [server.serves() for _ in range(10)] == [True] * 10


def test_clients_that_do_not_read_a_file_do_not_lock_out_other_clients(page: Server) -> None:
    crowd = []
    try:
        for _ in range(300):
            one = socket.socket()
            crowd.append(one)
            one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            one.connect(("127.0.0.1", page.port))
            one.sendall(FILE + b"\r\n")
        assert [page.serves() for _ in range(10)] == [True] * 10
    finally:
        for one in crowd:
            one.close()


def test_clients_that_reconnect_do_not_lock_out_other_clients(page: Server, graph: Graph) -> None:
    """300 connections, each of which is replaced when the server closes it."""
    refill = (
        "import socket, selectors, sys\n"
        "selector, port = selectors.DefaultSelector(), int(sys.argv[1])\n"
        "while True:\n"
        "    while len(selector.get_map()) < 300:\n"
        "        one = socket.create_connection(('127.0.0.1', port))\n"
        "        selector.register(one, selectors.EVENT_READ)\n"
        "    print(end='.', flush=True)\n"
        "    for key, _ in selector.select(0.05):\n"
        "        selector.unregister(key.fileobj)\n"
        "        key.fileobj.close()\n"
    )
    with graph.start(harness.PYTHON, "-c", refill, str(page.port)) as crowd:
        wait_for(lambda: crowd.out)
        assert [page.serves() for _ in range(15)] == [True] * 15
        assert crowd.alive, crowd


@pytest.mark.parametrize(
    "request_",
    [
        TOKEN,
        b"GET /main.js?token=x HTTP/1.1\r\n" + HOST,
        b"GET /socket HTTP/1.1\r\n" + HOST + UPGRADE + b"A" * 22 + b"==\r\n",
    ],
)
def test_a_refusal_ends_the_connection(server: Server, request_: bytes) -> None:
    if server.page is None:
        request_ += b"Origin: http://evil.example\r\n"
    answer = exchange(server.port, request_ + b"\r\n" + request_ + b"\r\n")
    assert answer.startswith(b"HTTP/1.1 403 ") and answer.count(b"HTTP/1.1") == 1
    assert b"\r\nConnection: close\r\n" in answer


def exchange(port: int, sent: bytes) -> bytes:
    """Return everything that a server answers until it closes the connection."""
    answer = b""
    with socket.create_connection(("127.0.0.1", port), timeout=harness.PATIENCE) as connection:
        connection.sendall(sent)
        with suppress(ConnectionResetError):  # the server has not read everything that was sent
            while part := connection.recv(65536):
                answer += part
    return answer


def test_unfinished_long_requests_are_closed_for_a_complete_one(api: Server) -> None:
    """The oldest unfinished requests are closed first."""
    with attacks.crowd(api.port, 100, b"GET /components?x=" + b"x" * 200_000):
        connection = http.client.HTTPConnection("127.0.0.1", api.port, timeout=harness.PATIENCE)
        connection.request("GET", "/components?x=" + "x" * 200_000)
        with connection.getresponse() as answer:
            assert answer.status == 200
        connection.close()
