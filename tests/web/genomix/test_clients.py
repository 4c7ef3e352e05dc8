"""Many, invalid and disappearing clients of a running genomixd: it serves the others and releases all resources."""

from __future__ import annotations

import json
import re
import resource
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from urllib.parse import quote

import pytest

from tests import harness
from tests.harness import proc, wait_for
from tests.web.genomix import world as worlds
from tests.web.genomix.test_server import start_tree
from tests.web.genomix.world import HttpError, World

pytestmark = pytest.mark.ros

GET = "GET {} HTTP/1.1\r\nHost: localhost\r\n\r\n"
# Small attacks reach these limits: a fifth of the sessions and of the connections, little memory and time.
SMALL = """
from dataclasses import replace
from rosafe.web.genomix import routes, sessions
from rosafe.web.server import connections
routes.LIMITS = replace(routes.LIMITS, max_connections=400, max_answers=50 * 2**20)
sessions.MAX_SESSIONS, sessions.MAX_REQUESTS = 200, 50
connections.STALL_SECONDS = 1.0
"""


@pytest.fixture(scope="module")
def small_world(shared_world: World) -> Iterator[World]:
    """The world of the module, with a genomixd for a few clients."""
    with worlds.changed_genomixd(shared_world, SMALL) as world:
        yield world


@pytest.fixture
def small(world: World, small_world: World) -> World:
    """The same, with idle components."""
    return small_world


@contextmanager
def crowd(port: int, requests: list[str]) -> Iterator[list[socket.socket]]:
    """Open connections that each have sent some text and read nothing."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    with ExitStack() as stack:
        sockets = []
        for text in requests:
            connection = stack.enter_context(socket.socket())
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            connection.settimeout(harness.PATIENCE)
            connection.connect(("127.0.0.1", port))
            with suppress(ConnectionError):  # already disconnected
                connection.sendall(text.encode("latin-1"))
            sockets.append(connection)
        yield sockets


def open_files(pid: int) -> int:
    return len(list(proc(pid, "fd").iterdir()))


def served(world: World) -> None:
    """A new HTTP client and a new Tcl client are served."""
    assert list(world.http.call("rosAFE/getParameters", s=f"fresh{time.monotonic()}")) == ["parameters"]
    script = "set g [genomix::connect $address]; $g load rosAFE; show [dict keys [rosAFE::getParameters]]"
    assert world.lines(script) == ["parameters"]


# --- connections and requests -----------------------------------------------------------------------------------


def test_an_idle_client_continues_after_an_attack(small: World) -> None:
    """Its connection is closed for other clients and it opens a new one; its event connection remains open."""
    world = small
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
        wait_for(lambda: "ready" in client.out, what=lambda: repr(client))
        with crowd(world.port, ["GET /call/rosAFE/getSignals HTTP/1.1\r\nHost: loc"] * 500):
            wait_for(lambda: "idle connections are closed" in world.server.err)
            served(world)
            go.touch()
            assert client.wait() == 0
        assert client.out.split() == ["ready", "done"]
    assert world.server.err.count("connection limit reached, now by loopback") < 100  # once a minute


def test_pipelined_requests_are_answered_in_order(world: World) -> None:
    """Queued and fragmented requests are answered; empty lines before a request are ignored."""
    names = [f"p{number}" for number in range(600)]
    urls = [f"/session/start?s={name}" for name in names[:200]] + [f"/nothing/{name}" for name in names[200:]]
    sent = b"".join(b"\r\n" + GET.format(url).encode() for url in urls)
    with socket.create_connection(("127.0.0.1", world.port), timeout=90) as connection, ThreadPoolExecutor(1) as pool:
        sending = pool.map(connection.sendall, (sent[i : i + 999] for i in range(0, len(sent), 999)))
        answers = b""
        while answers.count(b"HTTP/1.1 ") < len(names) or not answers.endswith(b"}"):
            part = connection.recv(65536)
            assert part
            answers += part
        assert len(list(sending)) == len(sent) // 999 + 1
    assert re.findall(r"(?:\r\n\r\n|GET /nothing/)(p\d+)", answers.decode()) == names


def test_a_large_download_does_not_delay_other_clients(world: World) -> None:
    start_tree(world.http)
    wait_for(lambda: world.http.call("rosAFE/gammatonePort/gammatone")["gammatonePort"]["lastFrameIndex"] > 0)
    with crowd(world.port, [GET.format("/call/rosAFE/gammatonePort/gammatone")]) as (slow,):
        assert slow.recv(100).startswith(b"HTTP/1.1 200 OK")
        for _ in range(20):
            assert world.http.call("rosAFE/getDependencies", ["input"]) == {"dependencies": ["input"]}
        parts = [b""]
        while not parts[-1].endswith(b"0\r\n\r\n"):
            parts.append(slow.recv(1 << 20))
            assert parts[-1]
        assert b"".join(parts).count(b"dataN") == 2


# --- sessions, requests and loads -------------------------------------------------------------------------------


def test_requests_and_listeners_are_limited(small: World) -> None:
    for _ in range(60):  # finished requests make room
        small.http.send("bass/connect_service", ["a", "b"], s="many")
    assert len(small.http.get("/requests", s="many")) == 50
    with ExitStack() as stack:
        for _ in range(8):
            stack.enter_context(small.http.listening(s="s0"))
        with pytest.raises(AssertionError), small.http.listening(s="s0"):
            pass
        status, body = small.http.raw("/session/listen?s=s0")
        assert (status, json.loads(body)["ex"]) == (503, "::genomix::e_tooMany")


def test_absent_components_do_not_delay_load(world: World) -> None:
    absent = [GET.format(f"/load/absent{number}") for number in range(200)]
    with world.graph.node("bass-ros", "-i", "waited"), crowd(world.port, absent) as waiting:
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


# --- clients that vanish ----------------------------------------------------------------------------------------


def test_waiting_clients_that_vanish_are_forgotten(small: World) -> None:
    """Their requests would otherwise wait for an hour and occupy connections."""
    world = small
    number = world.http.send("bass/Acquire", {"device": "scene:"}, ack=1)
    for _ in range(12):
        with crowd(world.port, [GET.format(f"/request/wait?s=t&id={number}")] * 20):
            pass

    def listening() -> bool:
        with suppress(AssertionError), world.http.listening(s="t"):  # rejected while they occupy all connections
            return True
        return False

    wait_for(listening)
    assert world.http.get("/request/wait", id=number, s="t", ms=10)["status"] == "sent"


def test_disappeared_clients_leave_no_resources(world: World) -> None:
    start_tree(world.http)
    world.http.call("rosAFE/getDependencies", ["input"], s="survivor")
    pid = world.server.pid

    def threads() -> int:
        return len(list(proc(pid, "task").iterdir()))

    files, before = open_files(pid), threads()
    for number in range(30):
        world.http.send("rosAFE/getDependencies", ["input"], s=f"v{number}")
        urls = (f"/session/listen?s=v{number}", "/call/rosAFE/inputProcPort")
        with crowd(world.port, [*map(GET.format, urls), "GET /call/rosAFE/getSignals HTTP/1.1\r\nHost: loc"]) as gone:
            assert all(one.recv(100).startswith(b"HTTP/1.1 200") for one in gone[:2])
            for connection in gone:  # a reset, as from a crash
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    wait_for(lambda: open_files(pid) <= files + 8, what=lambda: f"{open_files(pid)} files, {files} before")
    assert threads() <= before + 20  # the threads of the pool remain


# --- texts ------------------------------------------------------------------------------------------------------


def test_unpaired_surrogates_are_rejected_everywhere(world: World) -> None:
    half, bad = quote('"\\ud800"'), "%ED%A0%80"
    name, device = quote('"nameProc"'), quote('"device"')
    urls = [
        *(
            f"/call/rosAFE/getDependencies?input={given}"
            for given in (f"[{half}]", f"{{{name}:{half}}}", "[%22\xff%22]")
        ),
        f"/call/rosAFE/request?input=[{half}]",
        f"/call/bass/Acquire?input={{{device}:{half}}}",
        f"/send/bass/Acquire?argv=[{half}]&oneway=1",
        f"/call/rosAFE/ildPort/{bad}",
        f"/call/rosAFE/ildPort?element={bad}",
        f"/call/{bad}/getSignals",
        f"/load/{bad}",
        f"/load/rosAFE?i={bad}",
        f"/load/rosAFE?as={bad}",
        f"/components?s={bad}",
        f"/components?syntax={bad}",
        f"/request/status?id={bad}",
        "/\xff",
    ]
    with crowd(world.port, [GET.format(url) for url in urls]) as connections:
        assert [connection.recv(12)[9:] for connection in connections] == [b"400"] * len(urls)
    assert "Traceback" not in world.server.err
    reported = "GENOM ::genom::serialization {what {URL: expected UTF-8}}"
    assert (
        world.lines(r"""
        set g [genomix::connect $address]
        $g load rosAFE
        show [lindex [failure {rosAFE::getDependencies [list nameProc \ud800]}] 1]
        show [lindex [failure {rosAFE::ildPort \udfff}] 1]
        show [lindex [failure {$g load bass -i \ud800}] 1]
    """)
        == [reported] * 3
    )
    command = ("sh", "-c", r"""rosafe request ild --connect "$(printf '\355\240\200')" """)
    done = world.graph.run(*command, check=False)
    assert done.returncode == 1 and "Traceback" not in done.stderr and done.stderr.count("\n") == 1
    with pytest.raises(HttpError, match="contains an unpaired UTF-16 surrogate"):
        world.http.call("bass/Acquire", ["\ud800"])
