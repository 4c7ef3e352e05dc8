"""Faults of the nodes in a round of the soak: one function for each, which raises AssertionError."""

from __future__ import annotations

import os
import random
import signal
from typing import Any

import numpy as np
import rospy

from rosafe.ros1.component import serialization
from tests.harness import freeze, run_together, wait_for
from tests.ros1.afe.session import error_of, reader
from tests.soak.world import NAMES, World, following, wait_out

CHANGES = [
    ("fb_nGamma", "3"),
    ("fb_bwERBs", "1.2"),
    ("fb_nChannels", "5"),
    ("fb_lowFreqHz", "200"),
    ("fb_cfHz", "500 1000"),
    ("fb_nGamma", "0"),
    ("fb_highFreqHz", "nan"),
    ("fb_type", "drnl"),
]


def subscriber_dies(world: World, chance: random.Random) -> None:
    """A subscriber of the largest messages is stopped and then killed."""
    with reader(world.graph, world.afe.topic("gammatone")) as process:
        freeze(process.pid)
        index = world.afe.read("input").lastFrameIndex
        wait_for(lambda: world.afe.read("input").lastFrameIndex > index + 2 * world.size.block)
        os.kill(process.pid, signal.SIGKILL)


def garbage(world: World, chance: random.Random) -> None:
    """A second publisher of Audio sends malformed messages between those of bass."""
    message_class = serialization.message_class("bass", "::binaudio::portStruct")
    publisher = rospy.Publisher("/bass/Audio", message_class, queue_size=100, tcp_nodelay=True)
    try:
        wait_for(lambda: publisher.get_num_connections(), what="rosAFE connects to the second publisher")
        before = world.counters()["refused"]
        texts = [b"", b"\1", bytes(35), chance.randbytes(3000), bytes(20) + b"\xff" * 64, bytes(8_000_000)]
        silence = np.zeros(1000, np.int32)
        invalid: list[dict[str, Any]] = [
            {"sampleRate": 0, "left": silence, "right": silence},
            {"left": silence, "right": silence[1:]},
            {"left": silence[:0], "right": silence[:0]},
            {"lastFrameIndex": 2**64 - 1, "left": silence, "right": silence},
        ]
        for text in texts:
            message = message_class()
            message.serialize = lambda out, text=text: out.write(text)
            publisher.publish(message)
        for fields in invalid:
            valid = {"sampleRate": world.size.rate, "nChunksOnPort": 1, "nFramesPerChunk": 1000, "lastFrameIndex": 5}
            publisher.publish(message_class(**{**valid, **fields}))
        world.refused += len(texts) + len(invalid)
        world.afe.health(lambda entries: int(entries["refused"]) >= before + len(texts) + len(invalid))
    finally:
        publisher.unregister()


def crowd(world: World, chance: random.Random) -> None:
    """Hundreds of processors are added, get a block and are removed."""
    count = world.size.crowd

    def each(client: int, request: str, field: str, **more: Any) -> None:
        for number in range(client, count, 8):
            world.afe.ok(request, **{field: f"crowd{number}"}, **more)

    run_together(8, lambda client: each(client, "IldProc", "name"))
    assert len(world.afe.processors()["ild"]) == count + 1
    for number in (0, count - 1):
        wait_for(lambda name=f"crowd{number}": world.afe.read("ild", name=name).lastFrameIndex > 0)  # type: ignore[misc]
    run_together(8, lambda client: each(client, "removeProcessor", "name"))


def cycles(world: World, chance: random.Random) -> None:
    """Branches of the tree are added and removed."""
    for number in range(world.size.cycles):
        world.afe.ok("GammatoneProc", name="come", fb_nChannels=2)
        world.afe.ok("IhcProc", name="and", upperDepName="come")
        world.afe.ok("RatemapProc", name=f"go{number}", upperDepName="and")
        world.afe.ok("removeProcessor", name="come")


def clients(world: World, chance: random.Random) -> None:
    """Eight clients send random requests for their own and each other's branches."""
    seed = chance.random()

    def work(client: int) -> None:
        random_numbers = random.Random(f"{seed} {client}")
        for _ in range(25):
            name = f"client{random_numbers.randrange(8)}"
            requests: list[tuple[str, dict[str, Any]]] = [
                ("GammatoneProc", {"name": name, "fb_nChannels": 2}),
                ("IhcProc", {"name": f"{name}_ihc", "upperDepName": name}),
                ("IldProc", {"name": f"{name}_ild", "upperDepName": f"{name}_ihc"}),
                ("removeProcessor", {"name": name}),
                ("getDependencies", {"nameProc": f"{name}_ild"}),
                ("getSignals", {}),
                ("getParameters", {}),
                ("PreProc", {"name": NAMES["ihc"]}),
                ("modifyParameter", {"nameProc": name, "nameParam": "fb_nGamma", "newValue": "2"}),
            ]
            request, fields = random_numbers.choice(requests)
            response = world.afe.call(request, **fields)
            if not response.genom_success:
                error_of(response)

    run_together(8, work)
    for name in [n for n in world.afe.processors()["gammatone"] if n.startswith("client")]:
        world.afe.ok("removeProcessor", name=name)


def changes(world: World, chance: random.Random) -> None:
    """Parameters of a running processor are changed to valid and invalid values."""
    world.afe.ok("GammatoneProc", name="changing", fb_nChannels=2)
    for name, value in chance.sample(CHANGES, len(CHANGES)):
        response = world.afe.call("modifyParameter", nameProc="changing", nameParam=name, newValue=value)
        assert response.genom_success == (value not in ("0", "nan")), (name, value, response.genom_exdetail)
    index = world.afe.read("input").lastFrameIndex
    wait_for(lambda: world.afe.read("gammatone", name="changing").lastFrameIndex > index)
    world.afe.ok("removeProcessor", name="changing")


def master_dies(world: World, chance: random.Random) -> None:
    """The master is killed, and another one is started at the same address."""
    world.master.kill()
    world.bring_master()


def bass_is_stopped_briefly(world: World, chance: random.Random) -> None:
    """bass is stopped for less than the length of its window: no frame is lost."""
    with world.held(world.bass):
        wait_out(0.5)


def genomix_requests(world: World, chance: random.Random) -> None:
    """Requests by genomixd."""
    port = world.http.call(f"rosAFE/ildPort/{NAMES['ild']}")["ildPort"]
    assert port["framesOnPort"] == 100 and port["right"] == {"dataN": []}
    assert world.http.call("rosAFE/getDependencies", [NAMES["ild"]])["dependencies"][0] == NAMES["input"]
    assert world.http.call("bass/Audio")["Audio"]["sampleRate"] == world.size.rate


def subscribers_come_and_go(world: World, chance: random.Random) -> None:
    """Subscribers of the localizer, pages and subscribers in ROS 2, some of which are killed."""
    for _ in range(3):
        world.robot.visit(chance)
    world.robot.check()


DURING = (
    subscriber_dies,
    garbage,
    crowd,
    cycles,
    clients,
    changes,
    master_dies,
    bass_is_stopped_briefly,
    genomix_requests,
    subscribers_come_and_go,
)


def the_source_dies_and_the_node_is_held(world: World) -> None:
    """bass is killed and restarted, and rosAFE reconnects. Then rosAFE is stopped for longer than a window.

    Each frame on the input's port is the one with its number, or it is zero and counted as lost. The number of lost
    frames depends on the system, which buffers some messages for a process that does not read.
    """
    blocks = 3 * world.size.block
    world.acquire()
    with following(world) as follower:
        wait_for(lambda: follower.index > blocks)
        world.bass.stop(signal.SIGKILL)
        world.start_bass()
        world.acquire()
        wait_for(lambda: follower.begun == 2 and follower.index > blocks, what="another stream")
        assert follower.lost == 0
        before = world.counters()["lost"]
        with world.held(world.afe.process):
            wait_out(1.5 * world.window_seconds)
        index, _ = world.audio()
        wait_for(lambda: follower.index > index, what="rosAFE catches up")
    assert not follower.wrong, follower.wrong
    assert follower.lost <= world.counters()["lost"] - before
