"""Attacks on the nodes in a round of the soak: one function for each, which raises AssertionError.

After each attack, and during it if possible, a new service client, a new subscriber and an HTTP client are answered
within 2 s (`World.check_responsive`), and all resources are freed.
"""

from __future__ import annotations

import os
import random
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

from rosafe.ros1.bass.socket_client import SocketClient
from tests.harness import PATIENCE, wait_for
from tests.ros1.afe.attacker import HUGE, Target, length
from tests.ros1.afe.session import reader
from tests.soak.world import World, following, later

Address = tuple[str, int]
GARBAGE = (
    b"GET / HTTP/1.1\r\n\r\n",
    b"\0",
    b"\x10\0\0\0half",
    b"\xff" * 100,
    b"POST /RPC2 HTTP/1.1\r\nContent-Length: 9",
)


def targets(world: World) -> list[Target]:
    return [Target(world.graph, world.afe.process, "rosAFE"), Target(world.graph, world.bass, "bass")]


def addresses(world: World) -> list[Address]:
    """Return all addresses at which the nodes and genomixd listen."""
    ports = [address for target in targets(world) for address in target.ports.values()]
    return [world.http_address, world.socket_address, *ports]


@contextmanager
def crowd(address: Address, count: int, text: bytes = b"") -> Iterator[None]:
    """Open up to `count` connections and send `text` on each of them. Fewer are opened if the peer rejects them."""
    with ExitStack() as stack:
        with suppress(OSError):  # rejected
            for _ in range(count):
                sock = stack.enter_context(socket.create_connection(address, PATIENCE))
                with suppress(ConnectionError):
                    sock.sendall(text)
        yield


# --- connections ------------------------------------------------------------------------------------------------


def silence_and_browsers(world: World, chance: random.Random) -> None:
    """Connections that send nothing or garbage and stay open."""
    with ExitStack() as stack:
        for address in addresses(world):
            for text in (b"", *GARBAGE):
                stack.enter_context(crowd(address, 1, text))
        world.check_responsive("while they stay")


def many_connections(world: World, chance: random.Random) -> None:
    """Very many connections to every port of a node at the same time, and incomplete requests to genomixd."""
    for target in targets(world):
        with ExitStack() as stack:
            for address in target.ports.values():
                stack.enter_context(crowd(address, world.size.connections))
            stack.enter_context(crowd(world.socket_address, world.size.connections // 10))
            stack.enter_context(crowd(world.http_address, world.size.connections // 3, b"GET /components"))
            world.check_responsive("while they stay")


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
    afe, bass = targets(world)
    stop = threading.Event()
    garbage = threading.Thread(target=_send_garbage, args=(addresses(world), random.Random(chance.random()), stop))
    with following(world) as follower, ExitStack() as stack:
        for _ in range(20):
            stack.enter_context(afe.subscribe(topic.removeprefix("/rosAFE/"), "/deaf"))
        for _ in range(10):
            stack.enter_context(bass.subscribe("Audio", "/deaf"))
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
            with socket.create_connection(chance.choice(addresses), 1.0) as connection:
                connection.sendall(chance.choice((*GARBAGE, chance.randbytes(chance.randrange(5000)), length(HUGE))))
        except OSError:  # they may close it, or be too busy
            continue


ATTACKS = (
    silence_and_browsers,
    many_connections,
    the_master_is_away,
    clients_of_the_socket,
    a_mixed_load,
)
