"""Several nodes with one master, and remapped names."""

from __future__ import annotations

from tests.harness import SCRIPTS, Graph, wait_for
from tests.ros1.afe.session import Session, assert_holds, expected, noise, own_node, windowed

BLOCK = 2000


def test_two_instances_share_one_source(graph: Graph) -> None:
    """Each has its own tree, ports and activities, and the types of rosAFE."""
    with own_node(graph, name="left") as left, own_node(graph, name="right") as right:
        microphone = left.listen()
        right.microphone = microphone
        right.ok("connect_port", local="Audio", remote=microphone.topic)
        left.build("PreProc", "GammatoneProc", block=BLOCK, fb_nChannels=2)
        right.build("PreProc", block=BLOCK)
        right.ok("GammatoneProc", name="gammatone", fb_nChannels=3)
        signal = noise(2 * BLOCK)
        microphone.play(signal)
        for node, channels in ((left, 2), (right, 3)):
            message = node.read("gammatone", 2 * BLOCK + 1)
            truth = expected(signal, BLOCK, {"fb_nChannels": channels})
            assert_holds(message, "gammatone", windowed(truth["gammatone"], 1.0, 20000))
        left.ok("Stop")
        assert left.processors() == {}
        assert list(right.processors()) == ["input", "preProc", "gammatone"]
        assert left.goal("InputProc").active().running
        left.wait_activities(["InputProc"])
        right.wait_activities(["InputProc", "PreProc", "GammatoneProc"])
        left.ok("kill")
        assert left.process.wait() == 0
        microphone.play(noise(BLOCK))
        right.read("gammatone", 3 * BLOCK + 1)


def test_remapped_topics(graph: Graph) -> None:
    with own_node(
        graph, "bass/Audio:=/elsewhere/Audio", "/mapped/preProcPort/preProc:=/shown/here", name="mapped"
    ) as afe:
        microphone = afe.listen(topic="/elsewhere/Audio")
        afe.ok("connect_port", local="Audio", remote="bass/Audio")
        afe.build("PreProc", block=BLOCK)
        wait_for(lambda: microphone.subscribed)
        microphone.play(noise(BLOCK))
        message = graph.message("/shown/here", accept=lambda m: m.lastFrameIndex == BLOCK + 1)
        assert message.framesOnPort == 20000
        assert afe.topic("preProc") not in graph.topics()


def test_a_namespace_precedes_all_names(graph: Graph) -> None:
    with graph.start(str(SCRIPTS / "rosAFE-ros"), "__ns:=/robot") as process:
        wait_for(lambda: "/robot/rosAFE/kill" in graph.services(), what=lambda: str(process))
        afe = Session(graph, process, "robot/rosAFE")
        microphone = afe.listen(topic="/robot/bass/Audio")
        afe.ok("connect_port", local="Audio", remote="bass/Audio")  # relative to the namespace
        afe.build("PreProc", block=BLOCK)
        microphone.play(noise(BLOCK))
        afe.read("preProc", BLOCK + 1)
        afe.close()
