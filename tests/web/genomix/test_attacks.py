"""Attacks on a running genomixd: other clients are served meanwhile, and its resources are released afterwards."""

from __future__ import annotations

import asyncio
import http.client
import json
import logging
import re
import select
import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from typing import cast

import aiohttp
import pytest

from rosafe.web.genomix.routes import LIMITS
from rosafe.web.server.connections import ClientAccount, Connections, HttpConnection, _address
from rosafe.web.server.refusal import HttpRefusal
from tests import harness
from tests.web.genomix import attacks
from tests.web.genomix import world as worlds
from tests.web.genomix.test_fuzz import LINKS, open_files, resident
from tests.web.genomix.test_server import start_tree
from tests.web.genomix.world import HttpError, World

pytestmark = pytest.mark.ros

MUCH = 40  # MB that an attack may take

# Short time limits and little memory.
HASTY = """
from dataclasses import replace
from rosafe.web.genomix import routes
from rosafe.web.server import connections
routes.LIMITS = replace(routes.LIMITS, request_seconds=1.0, max_answers=50 * 2**20)
connections.STALL_SECONDS = 1.0
connections.YIELD_SECONDS = 0.2
"""
# A fifth of the connections, of the memory for requests and of the sessions: small attacks reach these limits.
SMALL = """
from dataclasses import replace
from rosafe.web.genomix import routes, sessions
routes.LIMITS = replace(routes.LIMITS, max_connections=400, max_header_bytes=4 * 2**20)
sessions.MAX_SESSIONS = 200
"""


def served(world: World) -> None:
    """A new HTTP client and a new Tcl client are served."""
    assert list(world.http.call("rosAFE/getParameters", s=f"fresh{time.monotonic()}")) == ["parameters"]
    script = "set g [genomix::connect $address]; $g load rosAFE; show [dict keys [rosAFE::getParameters]]"
    assert world.lines(script) == ["parameters"]


@pytest.fixture(scope="module")
def hasty_world(shared_world: World) -> Iterator[World]:
    """The world of the module, with a genomixd that has short time limits."""
    with worlds.changed_genomixd(shared_world, HASTY) as world:
        yield world


@pytest.fixture
def hasty(world: World, hasty_world: World) -> World:
    """The same, with idle components."""
    return hasty_world


@pytest.fixture(scope="module")
def small_world(shared_world: World) -> Iterator[World]:
    """The world of the module, with a genomixd for a few clients."""
    with worlds.changed_genomixd(shared_world, SMALL) as world:
        yield world


@pytest.fixture
def small(world: World, small_world: World) -> World:
    """The same, with idle components."""
    return small_world


# --- connections ------------------------------------------------------------------------------------------------

Crowd = Callable[[int, int], AbstractContextManager[list[socket.socket]]]


@pytest.mark.parametrize(
    ("crowd", "count"),
    [
        (attacks.half_requests, 500),
        (attacks.silence, 500),
        (attacks.long_halves, 400),  # 80 MB
        (attacks.bodies, 100),  # 50 MB
        (attacks.listeners, 300),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_crowd_does_not_lock_out_other_clients(small: World, crowd: Crowd, count: int) -> None:
    world = small
    served(world)
    pid = world.server.pid
    files, memory = open_files(pid), resident(pid)
    with crowd(world.port, count):
        harness.wait_for(lambda: world.http.raw("/components")[0] == 200)  # when the last one is processed
        assert resident(pid) < memory + MUCH
        served(world)
    served(world)
    most = files + LINKS  # connections to the components, which it has loaded meanwhile
    harness.wait_for(lambda: open_files(pid) <= most, what=lambda: f"{open_files(pid)} files, {files} before")


def test_an_idle_client_continues_afterwards(world: World) -> None:
    """Its connection is closed for other clients and it opens a new one; its event connection remains open."""
    go = world.graph.home / "go"
    script = world.graph.home / "idle.tcl"
    script.write_text(f"""
        package require genomix
        set g [genomix::connect 127.0.0.1:{world.port}]
        $g load bass
        set request [bass::Acquire scene: &]
        while {{[$request wait 100] eq "sent" && [dict get [bass::Audio] Audio lastFrameIndex] == 0}} continue
        puts ready
        flush stdout
        while {{![file exists {go}]}} {{after 20}}
        bass::Stop
        puts [$request wait]
    """)
    with world.graph.start("tclsh", str(script)) as client:
        harness.wait_for(lambda: "ready" in client.out, what=lambda: repr(client))
        with attacks.half_requests(world.port):
            harness.wait_for(lambda: "idle connections are closed" in world.server.err)
            go.touch()
            assert client.wait() == 0
        assert client.out.split() == ["ready", "done"]
    reported = world.server.err.count("connection limit reached, now by loopback")
    assert 1 <= reported < 100  # once a minute


def test_unread_answers_stop_the_requests(world: World) -> None:
    memory = resident(world.server.pid)
    with attacks.pipelined(world.port) as sent:
        assert sent < 500_000  # some wait in the kernel
        assert resident(world.server.pid) < memory + 30
        served(world)
    served(world)


def test_pipelined_requests_are_answered_in_order(world: World) -> None:
    """Queued and fragmented requests are answered; empty lines before a request are ignored."""
    names = [f"p{number}" for number in range(600)]
    urls = [f"/session/start?s={name}" for name in names[:200]] + [f"/nothing/{name}" for name in names[200:]]
    sent = b"".join(b"\r\n" + attacks.GET.format(url).encode() for url in urls)
    with socket.create_connection(("127.0.0.1", world.port), timeout=90) as connection, ThreadPoolExecutor(1) as pool:
        sending = pool.map(connection.sendall, (sent[i : i + 999] for i in range(0, len(sent), 999)))
        answers = b""
        while answers.count(b"HTTP/1.1 ") < len(names) or not answers.endswith(b"}"):
            part = connection.recv(65536)
            assert part
            answers += part
        assert len(list(sending)) == len(sent) // 999 + 1
    assert re.findall(r"(?:\r\n\r\n|GET /nothing/)(p\d+)", answers.decode()) == names


@pytest.mark.parametrize("sent", ["", "GET /components HTTP/1.1\r\nHo"])
def test_a_request_without_an_end(hasty: World, sent: str) -> None:
    """At once, and on a connection that was used before."""
    with socket.create_connection(("127.0.0.1", hasty.port), timeout=90) as connection:
        connection.sendall(sent.encode())
        assert connection.recv(1000).startswith(b"HTTP/1.1 408 ")
    if sent:
        used = http.client.HTTPConnection("127.0.0.1", hasty.port, timeout=90)
        used.request("GET", "/components")
        assert used.getresponse().read() == b"{}"
        assert not select.select((used.sock,), (), (), 1.5)[0]  # a connection may be idle
        used.request("GET", "/components")
        assert used.getresponse().read() == b"{}"
        used.sock.sendall(sent.encode())
        assert used.sock.recv(1000).startswith(b"HTTP/1.1 408 ")


def test_a_request_that_arrives_byte_by_byte(hasty: World) -> None:
    """The time limit applies to the complete request."""
    with socket.create_connection(("127.0.0.1", hasty.port), timeout=90) as connection:
        connection.sendall(b"GET /components HTTP/1.1\r\nHost: localhost\r\nX: ")
        end = time.monotonic() + harness.PATIENCE
        while not select.select((connection,), (), (), 0.1)[0]:
            connection.sendall(b"x")
            assert time.monotonic() < end
        assert connection.recv(1000).startswith(b"HTTP/1.1 408 ")


# Debian 13's version requires carriage returns.
BARE_LINE_FEEDS = 200 if tuple(map(int, aiohttp.__version__.split(".")[:2])) < (3, 9) else 400


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (b"POST /call/bass/Stop HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n\r\nhello", 405),
        (b"GET /call/bass/Stop HTTP/1.1\r\nHost: localhost\r\ncontent-length: 05\r\n\r\nhello", 400),
        (b"GET /call/bass/Stop HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nhello", 400),
        (b"GET /call/bass/Stop HTTP/1.1\r\nHost: localhost\r\nContent-Length: 0\r\n\r\n", 200),
        (b"GET /call/bass/Stop HTTP/1.1\nHost: localhost\n\n", BARE_LINE_FEEDS),
        (b"GET /components HTTP/1.1\r\nHost: localhost\r\nUpgrade: x\r\nConnection: Upgrade\r\n\r\n", 200),
        (b"CONNECT localhost:80 HTTP/1.1\r\nHost: localhost\r\n\r\n", 404),
    ],
    ids=range(7),
)
def test_requests_have_no_body(world: World, sent: bytes, status: int) -> None:
    with socket.create_connection(("127.0.0.1", world.port), timeout=90) as connection:
        connection.sendall(sent)
        answer = http.client.HTTPResponse(connection)
        answer.begin()
        assert answer.status == status
        assert json.load(answer).get("ex") == (None if status == 200 else "::genomix::e_url")
    served(world)


# --- answers ----------------------------------------------------------------------------------------------------


def test_unread_answers_are_dropped(hasty: World, world: World) -> None:
    """They are dropped immediately if the memory is needed, and otherwise after a time limit."""
    start_tree(world.http)
    url = "/call/rosAFE/getSignals"
    harness.wait_for(lambda: len(world.http.raw(url)[1]) > 10_000)
    pid = hasty.server.pid
    hasty.http.call("rosAFE/gammatonePort/gammatone")  # it connects to the component
    files, memory = open_files(pid), resident(pid)
    port = "/call/rosAFE/gammatonePort/gammatone?syntax=packed"
    with attacks.unread_answers(hasty.port, port, 100) as unread:  # of 3 MB; most of them share one
        for connection in unread:
            assert select.select((connection,), (), (), harness.PATIENCE)[0]
        assert resident(pid) < memory + 200
        assert hasty.http.raw("/components")[0] == 200
        # All of them are closed; the connections to the component remain.
        harness.wait_for(lambda: open_files(pid) < files + 50, what=lambda: f"{open_files(pid)} files")


def test_the_total_size_of_answers_is_limited() -> None:
    every = connections_with(max_answers=100)
    one, two, three = (Fake(every) for _ in range(3))
    samples = object(), object(), object()

    def taken(client: Fake, number: int, size: int) -> AbstractContextManager[None]:
        return every.reading_answer(client, samples[number], size)  # type: ignore[arg-type]

    with taken(one, 0, 1000):  # a single answer may be too large while it is the only one
        with pytest.raises(HttpRefusal, match="clients are reading"), taken(two, 1, 1):
            pass
        with taken(two, 0, 1000):  # the same data
            one.stalls = True
            with pytest.raises(HttpRefusal, match="clients are reading"), taken(three, 1, 1):
                pass
            assert (one.dropped, two.dropped) == (True, False)
    with taken(one, 0, 60), taken(two, 1, 40):
        one.stalls, one.dropped = False, False
        two.stalls = True
        with taken(three, 2, 40):
            assert (one.dropped, two.dropped) == (False, True)


def connections_with(**limits: int) -> Connections:
    """A server's connections, with other limits than genomixd's."""
    return Connections(replace(LIMITS, **limits), lambda refusal: (b"", ""), logging.getLogger("test"))


class Fake:
    """A connection as `Connections` sees it."""

    has_unread_data = False

    def __init__(self, every: Connections) -> None:
        self.stalls = False
        self.dropped = False
        self.account = ClientAccount("")
        self.every = every

    def stalled(self, seconds: float) -> bool:
        return self.stalls

    def drop(self) -> None:
        self.dropped = True
        self.every.forget(self)  # type: ignore[arg-type]


# --- which connections are closed -------------------------------------------------------------------------------------


class Room:
    """A server with room for eight connections, four from one address."""

    def __init__(self) -> None:
        self.every = connections_with(max_connections=8)

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


def test_the_longest_idle_connection_is_closed_first() -> None:
    server = Room()
    mine = [server.come("me") for _ in range(2)]
    crowd = [server.come("crowd", busy=number == 0) for number in range(10)]
    # Six connections of the crowd were closed, but not the one in use, and none of other clients.
    assert [one.dropped for one in crowd if one] == [False] + [True] * 6 + [False] * 3
    others = [server.come("other") for _ in range(2)]  # now it is full
    assert server.come("third") is not None  # one of the client with most connections is closed
    assert [one.dropped for one in crowd[7:] if one] == [True, False, False]
    assert not any(one.dropped for one in (*mine, *others) if one)


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
    server = Room()
    owner = [server.come("loopback") for _ in range(2)]
    for one in owner:
        server.authenticate(one)
    silent = [server.come("loopback") for _ in range(4)]
    assert [one.dropped for one in silent if one] == [True, True, False, False]
    for one in silent[2:]:
        server.authenticate(one)
    assert not any(one.dropped for one in owner if one)
    assert server.come("loopback") is not None
    assert [one.dropped for one in owner if one] == [True, False]


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("127.0.0.1", "127.8.9.10", True),
        ("127.0.0.1", "::1", True),
        ("::ffff:127.0.0.1", "::1", True),
        ("10.0.0.1", "::ffff:10.0.0.1", True),
        ("10.0.0.1", "10.0.0.2", False),
        ("2001:db8::1", "2001:db8::ffff:2", True),
        ("2001:db8::1", "2001:db8:0:1::1", False),
        ("fe80::1%eth0", "fe80::1", True),
        ("10.0.0.1", "127.0.0.1", False),
    ],
)
def test_addresses_of_one_client(one: str, other: str, same: bool) -> None:
    assert (_address((one, 1)) == _address((other, 2))) is same


# --- sessions and loads -----------------------------------------------------------------------------------------


def test_many_sessions_do_not_lock_out_other_clients(small: World) -> None:
    world = small
    world.http.get("/load/bass", s="mine")
    with world.http.listening(s="mine") as events:
        number = world.http.send("bass/Acquire", {"device": "scene:"}, s="mine", ack=1)
        assert next(events)[0] == "request"
        attacks.named_sessions(world.port, 400)
        served(world)
        assert world.http.status(number, s="mine")["status"] == "sent"  # it has a listener
    world.http.call("bass/Stop")


def test_absent_components_do_not_delay_load(world: World) -> None:
    with world.graph.node("bass-ros", "-i", "waited"), attacks.absent_loads(world.port) as waiting:
        assert world.http.get("/load/bass", i="waited")["instance"] == "waited"
        for connection in waiting:
            assert connection.recv(12).endswith(b" 502")
    served(world)


def test_many_names_for_one_component(world: World) -> None:
    """The oldest component names of a session are dropped; an instance is found again by its own name."""
    for number in range(70):
        world.http.get("/load/bass", s="names", **{"as": f"x{number}"})
    loaded = world.http.get("/components", s="names")
    assert len(loaded) == 64 and "x69" in loaded and "x0" not in loaded
    assert world.http.call("x0/Stop", s="names", i="bass") == {}
    assert world.http.call("bass/Stop", s="names") == {}


def test_waiting_clients_that_vanish_are_forgotten(small: World) -> None:
    """Their requests would otherwise wait for an hour and occupy connections."""
    world = small
    number = world.http.send("bass/Acquire", {"device": "scene:"}, ack=1)

    async def wait_and_vanish() -> None:
        url = f"/request/wait?s=t&id={number}"
        for _ in range(12):
            writers = []
            for _ in range(20):
                _, writer = await asyncio.open_connection("127.0.0.1", world.port)
                writer.write(attacks.GET.format(url).encode())
                await writer.drain()
                writers.append(writer)
            for writer in writers:
                writer.close()
                await writer.wait_closed()

    asyncio.run(wait_and_vanish())

    def listening() -> bool:
        with suppress(AssertionError), world.http.listening(s="t"):  # rejected while they occupy all connections
            return True
        return False

    harness.wait_for(listening)
    assert world.http.get("/request/wait", id=number, s="t", ms=10)["status"] == "sent"
    world.http.call("bass/Stop")


# --- texts ------------------------------------------------------------------------------------------------------


def test_unpaired_surrogates_are_rejected_everywhere(world: World) -> None:
    assert set(attacks.surrogates(world.port)) == {400}
    assert "Traceback" not in world.server.err
    reported = "GENOM ::genom::serialization {what {URL: expected UTF-8}}"
    script = r"""
        set g [genomix::connect $address]
        $g load rosAFE
        show [lindex [failure {rosAFE::getDependencies [list nameProc \ud800]}] 1]
        show [lindex [failure {rosAFE::ildPort \udfff}] 1]
        show [lindex [failure {$g load bass -i \ud800}] 1]
    """
    assert world.lines(script) == [reported] * 3
    command = ("sh", "-c", r"""rosafe request ild --connect "$(printf '\355\240\200')" """)
    done = world.graph.run(*command, check=False)
    assert done.returncode == 1 and "Traceback" not in done.stderr and done.stderr.count("\n") == 1
    with pytest.raises(HttpError, match="contains an unpaired UTF-16 surrogate"):
        world.http.call("bass/Acquire", ["\ud800"])
    served(world)
