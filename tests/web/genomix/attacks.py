"""Attacks of hostile HTTP clients on genomixd, for tests and the soak; each takes the port to attack.

    with attacks.half_requests(port):
        ...  # genomixd must serve other clients now

All their connections are closed at the end of the ``with`` block.
"""

from __future__ import annotations

import contextlib
import http.client
import resource
import select
import socket
import time
from collections.abc import Iterator
from urllib.parse import quote

GET = "GET {} HTTP/1.1\r\nHost: localhost\r\n\r\n"


@contextlib.contextmanager
def crowd(port: int, count: int, sent: bytes = b"", host: str = "127.0.0.1") -> Iterator[list[socket.socket]]:
    """Open `count` connections that each have `sent` some bytes and read nothing."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    with contextlib.ExitStack() as stack:
        sockets = []
        for _ in range(count):
            connection = socket.socket()
            stack.callback(connection.close)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            connection.bind((host, 0))
            connection.settimeout(60)
            connection.connect(("127.0.0.1", port))
            with contextlib.suppress(ConnectionError):  # already disconnected
                connection.sendall(sent)
            sockets.append(connection)
        yield sockets


def half_requests(port: int, count: int = 2000) -> contextlib.AbstractContextManager[list[socket.socket]]:
    """Connections that each send half of a request."""
    return crowd(port, count, b"GET /call/rosAFE/getSignals HTTP/1.1\r\nHost: loc")


def silence(port: int, count: int = 2000) -> contextlib.AbstractContextManager[list[socket.socket]]:
    """Connections that send nothing."""
    return crowd(port, count)


def long_halves(port: int, count: int = 1500) -> contextlib.AbstractContextManager[list[socket.socket]]:
    """Connections that each send 200 KiB of a request without an end."""
    return crowd(port, count, b"GET /call/rosAFE/getSignals?input=" + b"x" * 200_000)


def bodies(port: int, count: int = 100) -> contextlib.AbstractContextManager[list[socket.socket]]:
    """Requests that announce a gigabyte, and send some of it."""
    head = "POST /call/rosAFE/getSignals HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000000000\r\n\r\n"
    return crowd(port, count, head.encode() + b"x" * 500_000)


def listeners(port: int, count: int = 2000) -> contextlib.AbstractContextManager[list[socket.socket]]:
    """Connections that listen to events, eight for each session, which is the maximum."""
    return _one_by_one(port, [f"/session/listen?s=listener{number // 8}" for number in range(count)])


def unread_answers(port: int, url: str, count: int = 200) -> contextlib.AbstractContextManager[list[socket.socket]]:
    """Request large answers and do not read them."""
    return crowd(port, count, GET.format(url).encode())


def absent_loads(port: int, count: int = 200) -> contextlib.AbstractContextManager[list[socket.socket]]:
    """Request to load that number of components that do not exist."""
    return _one_by_one(port, [f"/load/absent{number}" for number in range(count)])


@contextlib.contextmanager
def _one_by_one(port: int, urls: list[str]) -> Iterator[list[socket.socket]]:
    with crowd(port, len(urls)) as sockets:
        for connection, url in zip(sockets, urls, strict=True):
            with contextlib.suppress(ConnectionError):
                connection.sendall(GET.format(url).encode())
        yield sockets


@contextlib.contextmanager
def pipelined(port: int, count: int = 1_000_000, seconds: float = 20.0) -> Iterator[int]:
    """Send up to that number of requests on one connection without reading; return the number that was sent."""
    request = GET.format("/components").encode()
    block = memoryview(request * 1000)
    end = time.monotonic() + seconds
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.setblocking(False)
        sent = 0
        while sent < count * len(request) and time.monotonic() < end:
            if not select.select((), (connection,), (), 2.0)[1]:
                break  # the server has stopped reading
            try:
                sent += connection.send(block[sent % len(request) :])
            except ConnectionError:
                break
        yield sent // len(request)


def named_sessions(port: int, count: int = 999) -> None:
    """Start sessions with different names, and abandon them."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=90)
    for number in range(count):
        connection.request("GET", f"/session/start?s=attack{number}")
        connection.getresponse().read()
    connection.close()


def surrogates(port: int) -> list[int]:
    """Send unpaired surrogates and invalid UTF-8 in place of every text; return the statuses of the answers."""
    half, bad = quote('"\\ud800"'), "%ED%A0%80"
    urls = [
        f"/call/rosAFE/getDependencies?input=[{half}]",
        f"/call/rosAFE/getDependencies?input={{{quote(chr(34) + 'nameProc' + chr(34))}:{half}}}",
        f"/call/rosAFE/getDependencies?input={{{half}:1}}",
        f"/call/rosAFE/request?input=[{half}]",
        f"/call/bass/Acquire?input={{{quote(chr(34) + 'device' + chr(34))}:{half}}}",
        f"/send/bass/Acquire?input=[{half}]&s=x",
        f"/send/bass/Acquire?argv=[{half}]&oneway=1",
        f"/call/rosAFE/ildPort/{bad}",
        f"/call/rosAFE/ildPort?element={bad}",
        f"/call/{bad}/getSignals",
        f"/call/rosAFE/{bad}",
        f"/load/{bad}",
        f"/load/rosAFE?i={bad}",
        f"/load/rosAFE?as={bad}",
        f"/unload/{bad}",
        f"/describe/{bad}",
        f"/components?s={bad}",
        f"/components?syntax={bad}",
        f"/request/status?id={bad}",
        f"/{bad}",
        "/call/rosAFE/getDependencies?input=[%22\xff%22]",
        "/\xff",
    ]
    statuses = []
    for url in urls:
        with socket.create_connection(("127.0.0.1", port), timeout=90) as connection:
            connection.sendall(GET.format(url).encode("latin-1"))
            statuses.append(int(connection.recv(12).split()[1]))
    return statuses
