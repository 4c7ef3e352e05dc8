"""Many, invalid and disappearing clients: genomixd serves the others and releases all resources."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import socket

import aiohttp
import pytest

from tests import harness
from tests.web.genomix import world as worlds
from tests.web.genomix.test_server import live_activities, start_tree
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros


# --- web pages --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:8080"},
        {"Referer": "http://evil.example/page"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "none"},
        {"Sec-Fetch-Mode": "no-cors"},
        {"Sec-Fetch-Dest": "image"},
        {"User-Agent": "Mozilla/5.0 (X11; Linux x86_64; rv:128.0) Gecko/20100101 Firefox/128.0"},
        {"Host": "evil.example"},
        {"Host": "evil.example:8080"},
        {"Host": "localhost.evil.example"},
        {"Host": "127.0.0.1.evil.example"},
        {"Host": ""},
    ],
    ids=str,
)
def test_requests_from_web_pages_are_rejected(world: World, headers: dict[str, str]) -> None:
    for url in ("/call/bass/Acquire?input=%5B%22scene:%22%5D", "/session/listen?s=x", "/session/stop?s=x", "/none"):
        status, body = world.http.raw(url, headers=headers)
        assert (status, json.loads(body)["ex"]) == (403, "::genomix::e_forbidden")
    assert live_activities(world, "bass") == []


@pytest.mark.parametrize(
    "host", ["localhost", "LOCALHOST:80", "127.0.0.1", "[::1]:8080", "10.1.2.3", socket.gethostname()]
)
def test_names_of_this_machine_are_accepted(world: World, host: str) -> None:
    assert world.http.raw("/components", headers={"Host": host})[0] == 200


@pytest.mark.parametrize("method", ["HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE"])
def test_only_get(world: World, method: str) -> None:
    assert world.http.raw("/call/bass/Stop", method=method)[0] == 405
    headers = {"Origin": "http://evil.example", "Access-Control-Request-Method": "GET"}
    assert world.http.raw("/call/bass/Stop", method="OPTIONS", headers=headers)[0] == 403


# --- sizes and counts -------------------------------------------------------------------------------------------


def test_the_longest_list_is_accepted_and_longer_ones_are_rejected(world: World) -> None:
    start_tree(world.http)
    longest = [100 + 0.123456789012 * i for i in range(1024)]
    world.http.call("rosAFE/GammatoneProc", {"name": "long", "fb_cfHz": [str(f) for f in longest]})
    gammatones = world.http.call("rosAFE/getParameters")["parameters"]["gammatone"]
    assert gammatones[1]["fb_cfHz"] == longest
    assert world.http.raw("/call/rosAFE/PreProc?input=" + "x" * 300_000)[0] == 400
    assert world.http.raw("/components", headers={"X": "y" * 100_000})[0] == 400


FORGETFUL = """
from rosafe.web.genomix import sessions
sessions.MAX_REQUESTS = 50
"""


def test_requests_and_listeners_are_limited(world: World) -> None:
    async def get(client: aiohttp.ClientSession, url: str) -> str:
        """Return the error's name, empty for none."""
        async with client.get(f"http://127.0.0.1:{http.port}{url}") as response:
            return "" if response.status == 200 else str((await response.json(content_type=None))["ex"])

    async def check() -> None:
        async with aiohttp.ClientSession() as client:
            for _ in range(60):  # finished requests make room
                assert await get(client, "/send/bass/connect_service?s=many&input=%5B%22a%22,%22b%22%5D") == ""
            listeners = [await client.get(f"http://127.0.0.1:{http.port}/session/listen?s=s0") for _ in range(8)]
            assert await get(client, "/session/listen?s=s0") == "::genomix::e_tooMany"
            for listener in listeners:
                assert listener.status == 200
                listener.close()

    with worlds.changed_genomixd(world, FORGETFUL) as forgetful:
        http = forgetful.http
        asyncio.run(check())
        assert len(http.get("/requests", s="many")) == 50


@pytest.mark.parametrize(
    "garbage",
    [
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"GET\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET /" + b"a" * 400_000,
        b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
        b"\0" * 10_000,
    ],
    ids=range(7),
)
def test_invalid_data_does_not_affect_other_clients(world: World, garbage: bytes) -> None:
    with socket.create_connection(("127.0.0.1", world.port), timeout=harness.PATIENCE) as connection:
        try:
            connection.sendall(garbage)
            with contextlib.suppress(OSError):  # the server may have closed the connection
                connection.shutdown(socket.SHUT_WR)
            while connection.recv(65536):
                continue
        except ConnectionError:
            pass  # disconnected, as expected
    assert world.http.get("/components", s="fresh") == {}


# --- many at once -----------------------------------------------------------------------------------------------


def test_a_hundred_concurrent_clients(world: World) -> None:
    start_tree(world.http)

    async def client(number: int) -> list[str]:
        async with aiohttp.ClientSession(base_url=f"http://127.0.0.1:{world.port}") as http:
            answers = []
            for turn in range(3):
                session = {"s": f"client{number}"} if turn else {}
                query = {"input": json.dumps(["gammatone"]), **session}
                async with http.get("/call/rosAFE/getDependencies", params=query) as response:
                    answers.append((await response.json())["dependencies"][-1])
            return answers

    async def all_clients() -> list[list[str]]:
        return await asyncio.gather(*map(client, range(100)))

    assert asyncio.run(all_clients()) == [["gammatone"] * 3] * 100


def test_a_large_download_does_not_delay_other_clients(world: World) -> None:
    """A client that reads getSignals slowly, or not at all, does not delay others."""
    start_tree(world.http)

    def large() -> bool:
        return world.http.call("rosAFE/gammatonePort/gammatone")["gammatonePort"]["lastFrameIndex"] > 0

    harness.wait_for(large)
    slow = socket.create_connection(("127.0.0.1", world.port))
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    slow.sendall(b"GET /call/rosAFE/gammatonePort/gammatone HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert slow.recv(100).startswith(b"HTTP/1.1 200 OK")
    for _ in range(20):
        assert world.http.call("rosAFE/getDependencies", ["input"]) == {"dependencies": ["input"]}
    parts = [b""]
    while not parts[-1].endswith(b"0\r\n\r\n"):
        parts.append(slow.recv(1 << 20))
        assert parts[-1]
    assert b"".join(parts).count(b"dataN") == 2
    slow.close()


# --- clients that vanish ----------------------------------------------------------------------------------------


def open_files(pid: int) -> int:
    return len(list(harness.proc(pid, "fd").iterdir()))


def threads(pid: int) -> int:
    return len(list(harness.proc(pid, "task").iterdir()))


def test_disappeared_clients_leave_no_resources(world: World) -> None:
    start_tree(world.http)
    world.http.call("rosAFE/getDependencies", ["input"], s="survivor")
    pid = world.server.pid
    files, before = open_files(pid), threads(pid)
    for number in range(30):
        listener = socket.create_connection(("127.0.0.1", world.port))
        listener.sendall(f"GET /session/listen?s=v{number} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        assert listener.recv(100).startswith(b"HTTP/1.1 200")
        world.http.send("rosAFE/getDependencies", ["input"], s=f"v{number}")
        half = socket.create_connection(("127.0.0.1", world.port))
        half.sendall(b"GET /call/rosAFE/getSignals HTTP/1.1\r\nHost: loc")
        download = socket.create_connection(("127.0.0.1", world.port))
        download.sendall(b"GET /call/rosAFE/inputProcPort HTTP/1.1\r\nHost: localhost\r\n\r\n")
        download.recv(100)
        for connection in (listener, half, download):
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # a reset, as from a crash
            connection.close()
    harness.wait_for(lambda: open_files(pid) <= files + 8, what=lambda: f"{open_files(pid)} files, {files} before")
    assert threads(pid) <= before + 20  # the threads of the pool remain


def test_a_client_that_is_killed_takes_its_session_with_it(world: World) -> None:
    script = world.graph.home / "client.tcl"
    script.write_text(f"""
        package require genomix
        [genomix::connect 127.0.0.1:{world.port}] load bass
        set request [bass::Acquire scene: &]
        $request wait 300
        puts "[$request id] [$request status]"
        flush stdout
        vwait forever
    """)
    with world.graph.start("tclsh", str(script)) as client:
        assert harness.wait_for(lambda: client.out.strip()).endswith("sent")
        client.stop(signal.SIGKILL)
    # The activity belongs to the component and continues.
    harness.wait_for(lambda: live_activities(world, "bass") == ["Acquire"])
