"""Attacks on the nodes in a round of the soak: one function for each, which raises AssertionError.

After each attack, and during it if possible, a new service client, a new subscriber and an HTTP client are answered
within 2 s (`World.check_responsive`), and all resources are freed.
"""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from rosafe.ros1.bass.socket_client import SocketClient
from rosafe.ros1.component import serialization
from tests.harness import run_together, wait_for
from tests.ros1.afe.session import reader
from tests.soak import peers
from tests.soak.peers import Address, crowd, flood, node_addresses
from tests.soak.world import PEAK_MEMORY, World, following, later, recorded
from tests.web.genomix.world import HttpError

NODES = ("rosAFE", "bass")
TOO_MUCH = 3 * PEAK_MEMORY  # bytes, which the receiver should not accept
GARBAGE = (
    b"GET / HTTP/1.1\r\n\r\n",
    b"\0",
    b"\x10\0\0\0half",
    b"\xff" * 100,
    b"POST /RPC2 HTTP/1.1\r\nContent-Length: 9",
)
SESSIONS, ABSENT = 1100, 200  # more than the limit of genomixd; requests to load components that do not exist
AUDIO = "::binaudio::portStruct"


# --- connections ------------------------------------------------------------------------------------------------


def silence_and_browsers(world: World, chance: random.Random) -> None:
    """Connections that send nothing or garbage and stay open."""
    with ExitStack() as stack:
        for node in NODES:
            for address in node_addresses(world.graph, node).values():
                for text in (b"", *GARBAGE):
                    stack.enter_context(peers.connect(address, text))
        world.check_responsive("while they stay")


def many_connections(world: World, chance: random.Random) -> None:
    """Very many connections to every port of a node at the same time."""
    for node in NODES:
        with ExitStack() as stack:
            for address in node_addresses(world.graph, node).values():
                stack.enter_context(crowd(address, world.size.connections))
            stack.enter_context(crowd(world.socket_address, world.size.connections // 10))


def no_descriptors_left(world: World, chance: random.Random) -> None:
    """A node that has reached its limit of open files, and many clients that connect."""
    for process, node in ((world.afe.process, "rosAFE"), (world.bass, "bass")):
        addresses = node_addresses(world.graph, node).values()
        with following(world) as follower, few_files(process.pid, 20), ExitStack() as stack:
            for address in addresses:
                stack.enter_context(crowd(address, 100, b"\x10"))
            follower.wait_for_block()


@contextmanager
def few_files(pid: int, more: int) -> Iterator[None]:
    """Let a process open only `more` files in addition to the open ones."""
    soft, hard = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    names = [int(path.name) for path in Path(f"/proc/{pid}/fd").iterdir()]
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (max(names) + more, hard))
    try:
        yield
    finally:
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (soft, hard))


# --- lengths ----------------------------------------------------------------------------------------------------


def a_message_of_4_gib(world: World, chance: random.Random) -> None:
    """A publisher of Audio and clients of services announce a message of 4 GiB, and send data."""
    publisher = peers.LyingPublisher("/bass/Audio", serialization.message_class("bass", AUDIO), TOO_MUCH)
    with world.bounded_memory(), publisher.registered(world.graph):
        wait_for(publisher.closed.is_set, what=lambda: f"end of the connection, {publisher.sent} bytes were sent")
    for node in NODES:
        address = node_addresses(world.graph, node)["TCPROS"]
        with (
            world.bounded_memory(),
            peers.connect(address, peers.call_header(f"/{node}/Stop") + peers.MAX_LENGTH) as client,
        ):
            assert flood(client, TOO_MUCH) < TOO_MUCH, f"{node} accepts data without a limit"


def an_invalid_bag(world: World, chance: random.Random) -> None:
    """A large empty file, and files that begin like a bag."""
    path = world.graph.home / "none.bag"
    for head in (b"", b"#ROSBAG V2.0\n", b"#ROSBAG V1.2\n", b"#ROSBAG V2.0\n\xff\xff\xff\x7f" + b"\xff" * 100):
        with path.open("wb") as file:
            file.write(head)
            file.truncate(2**33)
        with world.bounded_memory():
            world.refuses(f"bag:{path}")
    path.unlink()


# --- names ------------------------------------------------------------------------------------------------------


def names_of_devices(world: World, chance: random.Random) -> None:
    """Device names with which libasound would run a command or write a file, by every interface."""
    mark, kept = world.graph.home / "mark", world.graph.home / "kept"
    kept.write_text("precious")
    run = f"|touch {mark}"
    names = [
        f"tee:null,'{run}',raw",
        f"tee:null,'{kept}',raw",
        f"tee:null,{kept},raw",
        f"plug:\"file:'{run}',raw\"",
        f"plug:SLAVE='file:FILE={run}'",
        f"plug:\"tee:null,'{run}',raw\"",
        f"plug:SLAVE=\"tee:null,'{kept}',raw\"",
        f"file:FILE='{run}',raw",
        f'plug:{{type file slave.pcm null file "{run}" format raw}}',
        "{type null}",
        "null\ntype file",
        "plug:'" * 500,
    ]
    for name in names:
        world.refuses(name)
    for name in chance.sample(names[:10], 2):
        done = world.graph.run("rosafe", "record", "--device", name, "--seconds", "0.1", check=False)
        assert done.returncode == 1 and "Traceback" not in done.stderr, (name, done)
        try:
            world.http.call("bass/Acquire", {"device": name})
        except HttpError as problem:
            assert problem.ex == "::bass::e_device", (name, problem)
        else:
            raise AssertionError(f"genomixd: {name} was accepted")
    assert not mark.exists() and kept.read_text() == "precious"


def two_recorders(world: World, chance: random.Random) -> None:
    """Two clients that record to one file: one of them gets all of it, the other one an error."""
    path = world.graph.home / "take.wav"
    record = ("rosafe", "record", str(path), "--seconds", "1")
    done = run_together(2, lambda _: world.graph.run(*record, check=False))
    codes = sorted(one.returncode for one in done)
    assert codes == [0, 1], done
    refusal = next(one for one in done if one.returncode)
    assert refusal.stderr.count("\n") == 1 and "Traceback" not in refusal.stderr, refusal
    assert recorded(world, path) == world.size.rate
    path.unlink()


# --- HTTP -------------------------------------------------------------------------------------------------------


def half_requests(world: World, chance: random.Random) -> None:
    """Connections to genomixd with incomplete requests."""
    texts = (b"", b"GET /components", b"GET /components HTTP/1.1\r\nHost: local")
    count = world.size.connections // len(texts)
    with ExitStack() as stack:
        for text in texts:
            stack.enter_context(crowd(world.http_address, count, text))
        world.check_responsive("while they stay")


def responses_that_are_not_read(world: World, chance: random.Random) -> None:
    """Successive GET requests on a connection whose responses are not read."""
    request = b"GET /describe/rosAFE HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with world.bounded_memory(), ExitStack() as stack:
        clients = [stack.enter_context(peers.connect(world.http_address)) for _ in range(4)]
        run_together(len(clients), lambda number: flood(clients[number], 10_000 * len(request), request * 1000))
        world.check_responsive("while they stay")


def sessions_and_absent_components(world: World, chance: random.Random) -> None:
    """The maximum number of sessions, and clients that wait for components that do not exist."""
    for number in range(SESSIONS):
        try:
            world.http.get("/session/start", s=f"{chance.random()}{number}")
        except HttpError as full:
            assert full.ex == "::genomix::e_tooMany", full
            break
    load = b"GET /load/absent%d HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
    with ExitStack() as stack:
        for number in range(ABSENT):
            stack.enter_context(peers.connect(world.http_address, load % number))
        assert world.quick("load", lambda: world.http.get("/load/bass", s="honest"))["component"] == "bass"
        world.check_responsive("while they wait")


def unpaired_surrogates(world: World, chance: random.Random) -> None:
    """An unpaired surrogate in any text."""
    for given in ("\ud800", "\udfff name", ["\ud800"], {"nameProc": "\ud800"}, {"\ud800": 1}):
        status, body = world.http.raw(f"/call/rosAFE/getDependencies?input={_quoted(json.dumps(given))}")
        assert (status, json.loads(body)["ex"]) == (400, "::genom::serialization"), (given, status, body)


def _quoted(text: str) -> str:
    return "".join(f"%{byte:02x}" for byte in text.encode())


def the_master_is_away(world: World, chance: random.Random) -> None:
    """genomixd continues to serve the components that it is connected to."""
    assert world.http.call("rosAFE/getDependencies", ["input"]) == {"dependencies": ["input"]}
    assert world.http.call("bass/genom_state")["genom_state"]
    world.master.kill()
    try:
        answer = world.quick("call without a master", lambda: world.http.call("rosAFE/getDependencies", ["input"]))
        assert answer == {"dependencies": ["input"]}
        assert world.http.call("bass/genom_state")["genom_state"]
    finally:
        world.bring_master()


def clients_of_the_socket(world: World, chance: random.Random) -> None:
    """The maximum number of clients of DedicatedSocket, without a request."""
    with crowd(world.socket_address, 40):

        def served() -> int:
            try:
                with SocketClient(*world.socket_address) as client:
                    return client.newest()
            except OSError:  # rejected
                return 0

        wait_for(served, what="a place at the socket")


# --- all attacks together ---------------------------------------------------------------------------------------


def a_mixed_load(world: World, chance: random.Random) -> None:
    """Subscribers that never read, clients that are killed, garbage on all ports, and a master that is killed often."""
    time_is_over = later(world.size.mixed_seconds)
    topic = world.afe.topic("gammatone")
    message_class = serialization.message_class("rosAFE", "::rosAFE::TimeFrequencySignalPortStruct")
    addresses: list[Address] = [world.http_address, world.socket_address]
    for node in NODES:
        addresses += node_addresses(world.graph, node).values()
    stop = threading.Event()
    garbage = threading.Thread(target=_send_garbage, args=(addresses, random.Random(chance.random()), stop))
    with following(world) as follower, ExitStack() as stack:
        for _ in range(20):
            stack.enter_context(peers.deaf_subscriber(world.graph, "rosAFE", topic, message_class))
        audio_class = serialization.message_class("bass", AUDIO)
        for _ in range(10):
            stack.enter_context(peers.deaf_subscriber(world.graph, "bass", "/bass/Audio", audio_class))
        stack.callback(garbage.join)
        stack.callback(stop.set)
        garbage.start()
        while True:
            with reader(world.graph, topic) as dying:
                world.http.call("rosAFE/getDependencies", ["input"])
                world.master.kill()
                follower.wait_for_block()
                os.kill(dying.pid, signal.SIGKILL)
            world.bring_master()
            if time_is_over():
                break
    assert not follower.wrong and not follower.lost, f"{follower.wrong}, {follower.lost} frames lost"


def _send_garbage(addresses: list[Address], chance: random.Random, stop: threading.Event) -> None:
    """Send garbage to all addresses until `stop` is set."""
    while not stop.wait(0.05):
        try:
            with peers.connect(chance.choice(addresses)) as connection:
                connection.settimeout(1.0)
                connection.sendall(
                    chance.choice((*GARBAGE, chance.randbytes(chance.randrange(5000)), peers.MAX_LENGTH))
                )
        except OSError:  # they may close it, or be too busy
            continue


ATTACKS = (
    silence_and_browsers,
    many_connections,
    no_descriptors_left,
    a_message_of_4_gib,
    an_invalid_bag,
    names_of_devices,
    two_recorders,
    half_requests,
    responses_that_are_not_read,
    sessions_and_absent_components,
    unpaired_surrogates,
    the_master_is_away,
    clients_of_the_socket,
    a_mixed_load,
)
