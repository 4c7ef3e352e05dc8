"""Others that fail: subscribers that stop or die, a source that is killed, a master that is gone; endless cycles."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

from tests.harness import PYTHON, ROOT, Graph, MasterProcess, Process, wait_for
from tests.ros.session import Session, noise, own_node

BLOCK = 2000

# Prints the index of each message that comes.
SUBSCRIBER = """
import sys, rospy
from rosAFE.msg import rosAFE_TimeFrequencySignalPortStruct as Message
rospy.init_node("reader", anonymous=True)
rospy.Subscriber(sys.argv[1], Message, lambda m: print(m.lastFrameIndex, flush=True), buff_size=2**22)
rospy.spin()
"""


def reader(graph: Graph, topic: str) -> Process:
    process = graph.start(PYTHON, "-c", SUBSCRIBER, topic)
    wait_for(lambda: process.out, 20, lambda: str(process))
    return process


def test_a_subscriber_that_stops_reading_holds_nobody_up(afe: Session) -> None:
    """It is stopped amid messages of 5 MB; the tree, another subscriber and all requests go on; then it is killed."""
    microphone = afe.build("PreProc", "GammatoneProc", block=BLOCK, fb_nChannels=16)
    topic = afe.topic("gammatone")
    with reader(afe.graph, topic) as stuck, reader(afe.graph, topic) as well:
        os.kill(stuck.pid, signal.SIGSTOP)
        for block in range(1, 13):
            microphone.play(noise(BLOCK))
            wait_for(lambda index=str(block * BLOCK + 1): index in well.out.split(), what=lambda: well.out)
        afe.ok("removeProcessor", name="gammatone")
        assert topic not in afe.graph.topics()
        afe.ok("GammatoneProc", fb_nChannels=16)
        microphone.play(noise(BLOCK))
        wait_for(lambda: str(13 * BLOCK + 1) in well.out.split(), what="the new processor, to the one that reads")
        os.kill(stuck.pid, signal.SIGKILL)
        microphone.play(noise(BLOCK))
        wait_for(lambda: str(14 * BLOCK + 1) in well.out.split())


def test_a_subscriber_that_is_killed_is_forgotten(afe: Session) -> None:
    microphone = afe.build("PreProc", "GammatoneProc", block=BLOCK, fb_nChannels=16)

    def connections() -> int:
        """TCP connections to this topic, as the node itself tells (getBusInfo)."""
        import xmlrpc.client

        import rosgraph

        address = rosgraph.Master("/harness").lookupNode("/rosAFE")
        info = xmlrpc.client.ServerProxy(address).getBusInfo("/harness")[2]  # type: ignore[index]
        return sum(entry[4] == afe.topic("gammatone") for entry in info)

    with reader(afe.graph, afe.topic("gammatone")) as process:
        assert connections() == 1
        os.kill(process.pid, signal.SIGKILL)
        for block in range(1, 4):
            microphone.play(noise(BLOCK))
            afe.read("preProc", block * BLOCK + 1)
        wait_for(lambda: connections() == 0)


def test_bass_is_killed_and_comes_back(graph: Graph) -> None:
    """Nothing but a new Acquire is needed; the index begins anew, and so do the blocks."""
    with own_node(graph) as afe:
        with graph.node("bass-ros") as bass:
            assert graph.call("/bass/Acquire", device="scene:", sampleRate=20000, nFramesPerChunk=1000).genom_success
            afe.ok("connect_port", local="Audio", remote="bass/Audio")
            afe.ok("InputProc", nFramesPerBlock=BLOCK)
            afe.ok("PreProc")
            wait_for(lambda: afe.read("preProc").lastFrameIndex > 5 * BLOCK)
            bass.stop(signal.SIGKILL)
        before = afe.read("preProc").lastFrameIndex
        with graph.node("bass-ros"):
            assert graph.call("/bass/Acquire", device="scene:", sampleRate=20000, nFramesPerChunk=1000).genom_success
            message = wait_for(
                lambda: next((m for m in [afe.read("preProc")] if 0 < m.lastFrameIndex < before), None), timeout=20
            )
            assert (message.lastFrameIndex - 1) % BLOCK == 0
            health = afe.health(lambda entries: int(entries["streams"]) > 1)
            assert health["lost"] == "0"
        assert "Traceback" not in afe.process.err


def test_the_master_dies(private_graph: tuple[Graph, MasterProcess], tmp_path: Path) -> None:
    """Who is connected is served; what needs the master is refused at once; the node ends cleanly."""
    graph, master = private_graph
    dead = tmp_path / "dead"
    path = f"{ROOT}:{graph.env['PYTHONPATH']}"
    with graph.node("rosAFE-ros") as node:
        command = [PYTHON, "-m", "tests.ros.lonely_client", "/rosAFE", str(dead)]
        with graph.start(*command, cwd=ROOT, PYTHONPATH=path) as client:
            wait_for(lambda: "ready" in client.out or not client.alive, 30, lambda: str(client))
            master.kill()
            dead.touch()
            wait_for(lambda: not client.alive or "{" in client.out, 30, lambda: f"{client} {node}")
            seen: dict[str, Any] = json.loads(client.out.split("ready", 1)[-1] or "{}")
            assert seen == {
                "flows": True,
                "GammatoneProc": "::genom::port_io",
                "connect_port": "::genom::port_io",
                "processors": [1, 1, 0],
                "states": True,
                "removed": True,
                "left": [1, 0],
            }, client
            assert node.alive
            assert node.stop(signal.SIGTERM) == 0
            assert "Traceback" not in node.err, node.err


def threads_and_memory(pid: int) -> tuple[int, int]:
    """Threads and resident bytes of a process."""
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return int(status["Threads"]), int(status["VmRSS"].split()[0]) * 1024


def test_cycles_of_creation_and_removal_leave_nothing(afe: Session) -> None:
    microphone = afe.build("PreProc", block=BLOCK)

    def cycle(number: int) -> None:
        afe.ok("GammatoneProc", fb_nChannels=2)
        afe.ok("IhcProc")
        afe.ok("IldProc", name=f"ild{number}")
        afe.ok("removeProcessor", name="gammatone")

    for number in range(10):
        cycle(number)
    microphone.play(noise(BLOCK))
    afe.read("preProc", BLOCK + 1)
    wait_for(lambda: afe.wait_activities(["InputProc", "PreProc"]))
    threads, memory = threads_and_memory(afe.process.pid)
    for number in range(60):
        cycle(number)
    assert afe.processors() == {"input": ["input"], "preProc": ["preProc"]}
    wait_for(lambda: threads_and_memory(afe.process.pid)[0] <= threads + 2, what="threads end")
    assert threads_and_memory(afe.process.pid)[1] < memory + 2**24
    microphone.play(noise(BLOCK))
    afe.read("preProc", 2 * BLOCK + 1)


def test_all_slots_full_and_empty_again(afe: Session) -> None:
    """31 processors of each kind but the input: 187 in all, then one removal takes 186 of them."""
    microphone = afe.build("PreProc", "GammatoneProc", "IhcProc", block=BLOCK, fb_nChannels=2)
    for number in range(30):
        for request in ("PreProc", "GammatoneProc", "IhcProc"):
            fields = {"fb_nChannels": 2} if request == "GammatoneProc" else {}
            afe.ok(request, name=f"{request}{number}", **fields)
    for number in range(31):
        for request in ("IldProc", "RatemapProc", "CrossCorrelationProc"):
            afe.ok(request, name=f"{request}{number}")
    assert sum(map(len, afe.processors().values())) == 187
    microphone.play(noise(BLOCK))
    afe.read("crossCorrelation", BLOCK + 1, name="CrossCorrelationProc30", timeout=30)
    assert len(afe.ok("getSignals").signals.crossCorrelation) == 31
    afe.ok("Stop")
    assert afe.processors() == {}
    assert not [t for t in afe.graph.topics() if t.startswith("/rosAFE/ildPort/")]
