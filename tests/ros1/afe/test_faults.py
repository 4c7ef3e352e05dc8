"""Failures of other processes: stopped or killed subscribers, a killed source, a lost master; many cycles."""

from __future__ import annotations

import os
import random
import signal
import socket
from contextlib import ExitStack
from typing import Any
from urllib.parse import urlsplit

import rosservice
from actionlib_msgs.msg import GoalStatus

from rosafe.interface import CORE_REPRESENTATIONS, MAX_ACTIVITIES
from tests.harness import Graph, freeze, run_together, wait_for
from tests.ros1.afe.session import Session, error_of, noise, own_node
from tests.soak.world import ResourceUse

BLOCK = 2000


def test_bass_is_killed_and_restarted(graph: Graph) -> None:
    """Only a new Acquire is needed; frame index and blocks start again."""
    with own_node(graph) as afe:
        with graph.node("bass-ros") as bass:
            with graph.collect("/bass/Audio") as audio, graph.collect("/own/inputProcPort") as blocks:
                afe.wait_activities([])
            assert (audio, blocks) == ([], []), "advertised, and silent until a request"
            assert graph.call("/bass/Acquire", device="scene:", sampleRate=20000, nFramesPerChunk=1000).genom_success
            afe.ok("connect_port", local="Audio", remote="bass/Audio")
            afe.ok("InputProc", nFramesPerBlock=BLOCK)
            afe.ok("PreProc")
            wait_for(lambda: afe.read("preProc").lastFrameIndex > 5 * BLOCK)
            bass.stop(signal.SIGKILL)
        before = afe.read("preProc").lastFrameIndex
        with graph.node("bass-ros"):
            assert graph.call("/bass/Acquire", device="scene:", sampleRate=20000, nFramesPerChunk=1000).genom_success
            wait_for(lambda: 1 < afe.read("preProc").lastFrameIndex < before)
            assert (afe.read("preProc").lastFrameIndex - 1) % BLOCK == 0
            health = afe.health(lambda entries: int(entries["streams"]) > 1)
            assert health["lost"] == "0"
        assert "Traceback" not in afe.process.err


def test_random_requests_of_eight_clients(afe: Session) -> None:
    """After simultaneous random requests, processors, activities and ports still agree."""
    microphone = afe.listen()
    names = [f"n{number}" for number in range(6)]
    changes = [("ihc_method", "hilbert"), ("ild_hSizeSec", "0.005"), ("fb_nChannels", "3"), ("pp_bRemoveDC", "1")]

    def work(number: int) -> None:
        chance = random.Random(number)
        for _ in range(30):
            name, other = chance.choice(names), chance.choice(names)
            parameter, value = chance.choice(changes)
            requests: list[tuple[str, dict[str, Any]]] = [
                ("InputProc", {"name": name, "nFramesPerBlock": chance.choice([500, BLOCK])}),
                ("GammatoneProc", {"name": name, "upperDepName": other, "fb_nChannels": 2}),
                *((r, {"name": name, "upperDepName": other}) for r in ("PreProc", "IhcProc", "IldProc", "RatemapProc")),
                ("modifyParameter", {"nameProc": name, "nameParam": parameter, "newValue": value}),
                ("removeProcessor", {"name": name}),
                ("getDependencies", {"nameProc": name}),
                ("abort_activity", {"activity": chance.randrange(1, 200)}),
                ("getSignals", {}),
                ("getParameters", {}),
                ("Stop", {}),
            ]
            request, fields = chance.choice(requests)
            response = afe.call(request, **fields)
            if not response.genom_success:
                error_of(response)
        microphone.play(noise(500, number))

    run_together(8, work)
    there = afe.processors()
    afe.wait_activities([CORE_REPRESENTATIONS[kind].request for kind, members in there.items() for _ in members])
    topics = {afe.topic(kind, name) for kind, members in there.items() for name in members if kind != "input"}
    assert {t for t in afe.graph.topics() if "Port/" in t and t.startswith("/rosAFE/")} == topics
    for members in there.values():
        for name in members:
            chain = afe.ok("getDependencies", nameProc=name).dependencies
            assert chain[-1] == name and chain[0] == there["input"][0]


def test_many_clients_can_connect_at_the_same_time(afe: Session) -> None:
    """While the node cannot accept them (here: stopped), the system completes their connections."""
    address = urlsplit(rosservice.get_service_uri("/rosAFE/getParameters"))
    freeze(afe.process.pid)
    try:
        with ExitStack() as stack:
            for _ in range(40):  # with rospy's own backlog, the sixth would have to retry after a second
                stack.enter_context(socket.create_connection((address.hostname, address.port), timeout=0.9))
    finally:
        os.kill(afe.process.pid, signal.SIGCONT)
    afe.build("PreProc")


def test_all_slots_of_a_task_are_used_and_freed(afe: Session) -> None:
    """With the maximum number of processors of one kind all work, one more is rejected, and none stays."""
    microphone = afe.build("PreProc", "GammatoneProc", "IhcProc", block=BLOCK, fb_nChannels=2)
    afe.wait_activities(["InputProc", "PreProc", "GammatoneProc", "IhcProc"])
    before = ResourceUse.of(afe.process.pid)
    limit = MAX_ACTIVITIES - 1
    share = (limit + 7) // 8

    def fill(client: int) -> None:
        for number in range(client * share, min(limit, (client + 1) * share)):
            afe.ok("IldProc", name=f"ild{number}")

    run_together(8, fill)
    assert len(afe.processors()["ild"]) == limit >= 200
    assert afe.refused("IldProc", name="more") == ("::genom::too_many_activities", {})
    goal = afe.goal("IldProc", name="more")
    goal.result()
    assert goal.status() == GoalStatus.REJECTED
    afe.ok("RatemapProc")  # another task has slots
    microphone.play(noise(BLOCK))
    for name in ("ild0", f"ild{limit - 1}"):
        assert afe.read("ild", BLOCK + 1, name=name).framesOnPort == 100
    wait_for(lambda: {len(s.left.dataN) for s in afe.ok("getSignals").signals.ild} == {2})
    assert ResourceUse.of(afe.process.pid).threads <= before.threads + 2 * (limit + 1) + 16, "two for each processor"
    afe.ok("removeProcessor", name="ild7")
    afe.ok("IldProc", name="more")
    afe.ok("Stop")
    assert afe.processors() == {}
    # on a busy machine, the master needs more than the second for which a request waits to remove hundreds of topics
    wait_for(lambda: not [t for t in afe.graph.topics() if t.startswith("/rosAFE/ildPort/")])
    wait_for(lambda: ResourceUse.of(afe.process.pid).threads <= before.threads, what="threads end")
    assert ResourceUse.of(afe.process.pid).memory < before.memory + 2**26
    wait_for(lambda: ResourceUse.of(afe.process.pid).files < before.files + 50, what="the end of files of topics")
