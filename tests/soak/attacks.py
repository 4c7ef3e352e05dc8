"""What those who mean ill do to the nodes in a round of the soak: one function for each, which raises AssertionError.

After each, and where that can be asked for while it lasts, a fresh call of a service, a fresh listener and an HTTP call
are answered within 2 s, and nothing of it is left: `World.unharmed`.
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

from rosafe.bass.socket_client import SocketClient
from rosafe.component import serialization
from tests.genomix.world import HttpError
from tests.harness import run_together, wait_for
from tests.ros.session import reader
from tests.soak import peers
from tests.soak.peers import Address, crowd, doors, pour
from tests.soak.world import PEAK_MEMORY, World, following, later, recorded

NODES = ("rosAFE", "bass")
TOO_MUCH = 3 * PEAK_MEMORY  # bytes that are sent to who should not take them
GARBAGE = (
    b"GET / HTTP/1.1\r\n\r\n",
    b"\0",
    b"\x10\0\0\0half",
    b"\xff" * 100,
    b"POST /RPC2 HTTP/1.1\r\nContent-Length: 9",
)
SESSIONS, ABSENT = 1100, 200  # more than genomixd keeps; loads that wait for nobody
AUDIO = "::binaudio::portStruct"


# --- connections ------------------------------------------------------------------------------------------------


def silence_and_browsers(world: World, chance: random.Random) -> None:
    """Connections that say nothing, or something else than they should, and stay."""
    with ExitStack() as stack:
        for node in NODES:
            for address in doors(world.graph, node).values():
                for text in (b"", *GARBAGE):
                    stack.enter_context(peers.connect(address, text))
        world.unharmed("while they stay")


def many_connections(world: World, chance: random.Random) -> None:
    """As many connections as come into somebody's mind, to every port of a node at once."""
    for node in NODES:
        with ExitStack() as stack:
            for address in doors(world.graph, node).values():
                stack.enter_context(crowd(address, world.size.connections))
            stack.enter_context(crowd(world.socket_address, world.size.connections // 10))


def no_descriptors_left(world: World, chance: random.Random) -> None:
    """A node that may open no more files than it has, while everybody connects."""
    for process, node in ((world.afe.process, "rosAFE"), (world.bass, "bass")):
        addresses = doors(world.graph, node).values()
        with following(world) as follower, few_files(process.pid, 20), ExitStack() as stack:
            for address in addresses:
                stack.enter_context(crowd(address, 100, b"\x10"))
            follower.goes_on()


@contextmanager
def few_files(pid: int, more: int) -> Iterator[None]:
    """A process may open only so many files more than it has."""
    soft, hard = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    names = [int(path.name) for path in Path(f"/proc/{pid}/fd").iterdir()]
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (max(names) + more, hard))
    try:
        yield
    finally:
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (soft, hard))


# --- lengths ----------------------------------------------------------------------------------------------------


def a_message_of_4_gib(world: World, chance: random.Random) -> None:
    """A publisher of Audio, and clients of services, say that so much is to come, and send it."""
    publisher = peers.LyingPublisher("/bass/Audio", serialization.message_class("bass", AUDIO), TOO_MUCH)
    with world.bounded_memory(), publisher.known(world.graph):
        wait_for(publisher.closed.is_set, what=lambda: f"end of the connection, {publisher.sent} bytes were sent")
    for node in NODES:
        address = doors(world.graph, node)["TCPROS"]
        with world.bounded_memory(), peers.connect(address, peers.call_header(f"/{node}/Stop") + peers.MOST) as client:
            assert pour(client, TOO_MUCH) < TOO_MUCH, f"{node} takes whatever comes"


def a_bag_that_is_none(world: World, chance: random.Random) -> None:
    """A large file without anything in it, and one that begins like a bag."""
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
    """Names that libasound would run, load or write, through every door."""
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
        except HttpError as refused:
            assert refused.ex == "::bass::e_device", (name, refused)
        else:
            raise AssertionError(f"genomixd: {name} was taken")
    assert not mark.exists() and kept.read_text() == "precious"


def two_recorders(world: World, chance: random.Random) -> None:
    """Two who record to one file: one of them gets all of it, the other one is told."""
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
    """Connections to genomixd that begin a request, and do not go on; from two addresses."""
    texts = (b"", b"GET /components", b"GET /components HTTP/1.1\r\nHost: local")
    count = world.size.connections // len(texts)
    with ExitStack() as stack:
        for text in texts:
            stack.enter_context(crowd(world.http_address, count, text))
        world.unharmed("while they stay")


def requests_that_nobody_reads(world: World, chance: random.Random) -> None:
    """GETs one after the other, on a connection on which nothing is read."""
    request = b"GET /describe/rosAFE HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with world.bounded_memory(), ExitStack() as stack:
        clients = [stack.enter_context(peers.connect(world.http_address)) for _ in range(4)]
        run_together(len(clients), lambda number: pour(clients[number], 10_000 * len(request), request * 1000))
        world.unharmed("while they stay")


def sessions_and_absent_components(world: World, chance: random.Random) -> None:
    """As many named sessions as there may be, and clients that wait for components which are not there."""
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
        world.unharmed("while they wait")


def characters_that_are_none(world: World, chance: random.Random) -> None:
    """Half of a surrogate pair, wherever a text may stand."""
    for given in ("\ud800", "\udfff name", ["\ud800"], {"nameProc": "\ud800"}, {"\ud800": 1}):
        status, body = world.http.raw(f"/call/rosAFE/getDependencies?input={_quoted(json.dumps(given))}")
        assert (status, json.loads(body)["ex"]) == (400, "::genom::serialization"), (given, status, body)


def _quoted(text: str) -> str:
    return "".join(f"%{byte:02x}" for byte in text.encode())


def the_master_is_away(world: World, chance: random.Random) -> None:
    """genomixd goes on with what it has talked to."""
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
    """As many as DedicatedSocket serves, and none of them asks for anything."""
    with crowd(world.socket_address, 40):

        def served() -> int:
            try:
                with SocketClient(*world.socket_address) as client:
                    return client.newest()
            except OSError:  # turned away
                return 0

        wait_for(served, what="a place at the socket")


# --- all of it, for a while -------------------------------------------------------------------------------------


def a_mixed_load(world: World, chance: random.Random) -> None:
    """Subscribers that never read, clients that die, garbage everywhere, a master killed again and again."""
    over = later(world.size.mixed_seconds)
    topic = world.afe.topic("gammatone")
    message_class = serialization.message_class("rosAFE", "::rosAFE::TimeFrequencySignalPortStruct")
    addresses: list[Address] = [world.http_address, world.socket_address]
    for node in NODES:
        addresses += doors(world.graph, node).values()
    stop = threading.Event()
    rubbish = threading.Thread(target=_throw, args=(addresses, random.Random(chance.random()), stop))
    with following(world) as follower, ExitStack() as stack:
        for _ in range(20):
            stack.enter_context(peers.deaf_subscriber(world.graph, "rosAFE", topic, message_class))
        audio_class = serialization.message_class("bass", AUDIO)
        for _ in range(10):
            stack.enter_context(peers.deaf_subscriber(world.graph, "bass", "/bass/Audio", audio_class))
        stack.callback(rubbish.join)
        stack.callback(stop.set)
        rubbish.start()
        while True:
            with reader(world.graph, topic) as dying:
                world.http.call("rosAFE/getDependencies", ["input"])
                world.master.kill()
                follower.goes_on()
                os.kill(dying.pid, signal.SIGKILL)
            world.bring_master()
            if over():
                break
    assert not follower.wrong and not follower.lost, f"{follower.wrong}, {follower.lost} frames lost"


def _throw(addresses: list[Address], chance: random.Random, stop: threading.Event) -> None:
    """Garbage to all of these, until it is enough."""
    while not stop.wait(0.05):
        try:
            with peers.connect(chance.choice(addresses)) as connection:
                connection.settimeout(1.0)
                connection.sendall(chance.choice((*GARBAGE, chance.randbytes(chance.randrange(5000)), peers.MOST)))
        except OSError:  # they may close it, or be too busy
            continue


ATTACKS = (
    silence_and_browsers,
    many_connections,
    no_descriptors_left,
    a_message_of_4_gib,
    a_bag_that_is_none,
    names_of_devices,
    two_recorders,
    half_requests,
    requests_that_nobody_reads,
    sessions_and_absent_components,
    characters_that_are_none,
    the_master_is_away,
    clients_of_the_socket,
    a_mixed_load,
)
