"""A table of misbehaving clients without a token, for genomixd and the live page.

They neither fill the memory of a server nor lock out other clients, and a refused request ends its connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import random
import re
import select
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

import aiohttp
import pytest

from tests import harness
from tests.harness import Graph, Process, proc, wait_for
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

    def files(self) -> int:
        return len(list(proc(self.process.pid, "fd").iterdir()))

    def serves(self, size: int = 1) -> bool:
        """Return whether another client is served."""
        if self.page is not None:
            return asyncio.run(_page_opens(self.page))
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=harness.PATIENCE)
        connection.request("GET", "/components?x=" + "x" * size)
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


# --- many connections -------------------------------------------------------------------------------------------


@contextlib.contextmanager
def flood(port: int, sent: bytes, together: int) -> Iterator[None]:
    """Send `sent` repeatedly on many connections and read nothing; closed connections are replaced, others remain.

    `NUMBER` in `sent` becomes the number of the connection.
    """
    end, total, opened = time.monotonic() + SECONDS, 0, 0
    done: dict[socket.socket, tuple[bytes, int]] = {}  # what a connection sends, and how much of it is sent
    try:
        while time.monotonic() < end and total < SENT and (opened < OPENED or done):
            while len(done) < together and opened < OPENED:
                connection = socket.socket()
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                connection.connect(("127.0.0.1", port))
                connection.setblocking(False)
                opened += 1
                text = sent.replace(b"NUMBER", b"%d" % opened)
                done[connection] = text * max(1, 50_000 // max(1, len(text))), 0
            if not sent:
                break
            for connection in select.select((), list(done), (), 0.1)[1]:
                text, start = done[connection]
                try:
                    count = connection.send(text[start:])
                except BlockingIOError:
                    continue
                except ConnectionError:
                    del done[connection]
                    connection.close()
                    continue
                done[connection] = text, (start + count) % len(text)
                total += count
        yield
    finally:
        for connection in done:
            connection.close()


HOST = b"Host: 127.0.0.1\r\n"
TOKEN = b"GET /?token=x HTTP/1.1\r\n" + HOST
FILE = b"GET /panel.js HTTP/1.1\r\n" + HOST
LISTEN = b"GET /session/listen?s=NUMBER HTTP/1.1\r\n" + HOST
LONG = b"".join(b"x%d: " % number + b"y" * 8000 + b"\r\n" for number in range(7))
UPGRADE = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: "
POST = b"POST / HTTP/1.1\r\n" + HOST
ATTACKS = {
    "silence": (b"", 300),
    "pipelined": (TOKEN + b"\r\n", 1),
    "pipelined by many": (TOKEN + b"\r\n", 100),
    "listening": (LISTEN + b"\r\n", 100),
    "files": (FILE + b"\r\n", 1),
    "another host": (b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n", 100),
    "files by many": (FILE + b"\r\n", 250),
    "half a request": (b"GET /?tok", 300),
    "long headers": (TOKEN + LONG + b"\r\n", 250),
    "many headers": (TOKEN + b"a:b\r\n" * 13_000 + b"\r\n", 250),
    "headers without an end": (TOKEN + LONG * 10, 250),
    "half a long request": (TOKEN + LONG, 250),
    "an endless line": (b"GET /?token=" + b"x" * 500_000, 250),
    "cookies": (TOKEN + b"Cookie: " + b"a=b;" * 2000 + b"\r\n\r\n", 100),
    "WebSocket": (b"GET /socket HTTP/1.1\r\n" + HOST + UPGRADE + b"A" * 22 + b"==\r\n\r\n" + b"\x82\xff" * 50_000, 250),
    "HTTP/1.0": (b"GET /?token=x HTTP/1.0\r\nConnection: keep-alive\r\n" + HOST + b"\r\n", 250),
    "bodies": (POST + b"Content-Length: 1000000000\r\n\r\n" + b"x" * 500_000, 250),
    "chunks": (POST + b"Transfer-Encoding: chunked\r\n\r\n" + b"x" * 500_000, 250),
    "nothing valid": (random.Random(1).randbytes(200_000), 250),
    "empty lines": (b"\r\n" * 100_000, 250),
}
NAMES = list(ATTACKS)


@pytest.mark.parametrize(("which", "names"), [("page", NAMES[::2]), ("api", NAMES[1::2])])  # they share this code
def test_attacks(request: pytest.FixtureRequest, which: str, names: list[str]) -> None:
    """Other clients are served, memory stays within its limit for each and all attacks, and all files are closed."""
    server: Server = request.getfixturevalue(which)
    assert server.serves()
    idle, files = server.memory(), server.files()
    for name in names:
        server.reset()
        with flood(server.port, *ATTACKS[name]):
            assert server.serves(), name
        assert server.memory("VmHWM") <= idle + MEMORY, name
    wait_for(lambda: server.files() < files + 30, what=lambda: f"{server.files()} files, {files} before")
    assert "Traceback" not in server.process.err


def test_unfinished_long_requests_are_closed_for_a_complete_one(api: Server) -> None:
    with flood(api.port, b"GET /components?x=" + b"x" * 200_000, 100):
        assert api.serves(size=200_000)


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


# --- single requests --------------------------------------------------------------------------------------------

LINE = b"GET / HTTP/1.1\r\n"
BODY = b"Content-Length: 5\r\n\r\nhello"
OTHER = b"http://evil.example"
# aiohttp of Debian 13 requires carriage returns
BARE = 200 if tuple(map(int, aiohttp.__version__.split(".")[:2])) < (3, 9) else 400
# Requests, and the statuses of the answers of genomixd and of the live page
REQUESTS: dict[bytes, tuple[int, int]] = {
    LINE + HOST + b"\r\n": (200, 200),
    LINE + b"Host: LocalHost:8080\r\n\r\n": (200, 200),
    LINE + b"Host: [::1]:8080\r\n\r\n": (200, 200),
    LINE + b"Host: evil.example\r\n\r\n": (403, 403),
    LINE + b"Host: 127.0.0.1.evil.example\r\n\r\n": (403, 403),
    LINE + b"Host:\r\n\r\n": (403, 403),
    LINE + HOST + b"Origin: " + OTHER + b"\r\n\r\n": (403, 403),
    LINE + HOST + b"Origin: null\r\n\r\n": (403, 403),
    LINE + HOST + b"Sec-Fetch-Site: cross-site\r\n\r\n": (403, 403),
    LINE + HOST + b"Sec-Fetch-Site: none\r\n\r\n": (403, 200),
    LINE + HOST + b"Sec-Fetch-Mode: no-cors\r\n\r\n": (403, 200),
    LINE + HOST + b"Sec-Fetch-Dest: image\r\n\r\n": (403, 200),
    LINE + HOST + b"Referer: " + OTHER + b"/page\r\n\r\n": (403, 200),
    LINE + HOST + b"User-Agent: Mozilla/5.0 (X11; Linux x86_64) Firefox/128.0\r\n\r\n": (403, 200),
    TOKEN + b"\r\n": (200, 403),
    b"GET /socket HTTP/1.1\r\n" + HOST + UPGRADE + b"A" * 22 + b"==\r\n\r\n": (404, 403),
    b"OPTIONS / HTTP/1.1\r\n" + HOST + b"Origin: " + OTHER + b"\r\n\r\n": (403, 403),
    **{method + b" / HTTP/1.1\r\n" + HOST + b"\r\n": (405, 405) for method in (b"PUT", b"DELETE", b"PATCH", b"TRACE")},
    b"CONNECT localhost:80 HTTP/1.1\r\n" + HOST + b"\r\n": (404, 404),
    POST + BODY: (405, 405),
    LINE + HOST + BODY: (400, 200),
    LINE + HOST + b"content-length: 05\r\n\r\nhello": (400, 200),
    LINE + HOST + b"Transfer-Encoding: chunked\r\n\r\n5\r\nhello": (400, 200),
    LINE + HOST + b"Content-Length: 0\r\n\r\n": (200, 200),
    LINE + HOST + b"Content-Length: -1\r\n\r\n": (400, 400),
    LINE + HOST + b"Upgrade: x\r\nConnection: Upgrade\r\n\r\n": (200, 200),
    LINE + HOST + b"X: " + b"y" * 100_000 + b"\r\n\r\n": (400, 400),
    b"GET /?x=" + b"x" * 400_000: (400, 400),
    b"GET / HTTP/1.1\nHost: localhost\n\n": (BARE, BARE),
    b"GET\r\n\r\n": (400, 400),
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n": (400, 400),
}


def test_requests(server: Server) -> None:
    for sent, statuses in REQUESTS.items():
        status = statuses[server.page is not None]
        answer = exchange(server.port, sent, twice=status == 403)
        assert answer.startswith((b"HTTP/1.1 %d " % status, b"HTTP/1.0 %d " % status)), (sent[:200], answer[:300])
        assert answer.count(b"HTTP/1.") == 1, sent[:200]  # a refusal ends the connection
        assert b"<html" not in answer or status == 200
    assert server.serves()
    assert "Traceback" not in server.process.err


def exchange(port: int, sent: bytes, twice: bool) -> bytes:
    """Return everything that a server answers until it closes the connection, or its first answer."""
    answer = b""
    with socket.create_connection(("127.0.0.1", port), timeout=harness.PATIENCE) as connection:
        with suppress(ConnectionError):
            connection.sendall(sent * (1 + twice))
        with suppress(ConnectionResetError):  # the server has not read everything that was sent
            while part := connection.recv(65536):
                answer += part
                if answer[9:12] in (b"200", b"404", b"405"):
                    break
    return answer
