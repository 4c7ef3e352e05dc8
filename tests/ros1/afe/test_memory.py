"""The settings of the C library's allocator are accepted, and a process releases unused memory and files."""

from __future__ import annotations

from pathlib import Path

import rospy
from std_msgs.msg import String

from tests.harness import PYTHON, ROOT, Graph, proc
from tests.plugins.stages import PLAIN, Fault, text_of
from tests.ros1.afe.session import Session, noise
from tests.soak.world import ResourceUse

# Allocates memory of all sizes in many threads, frees almost all, and prints the resident MiB.
SPREAD = """
import random, threading
from rosafe.system import malloc_tuning
malloc_tuning.limit_arenas()
def resident():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmRSS")).split()[1]) // 1024
kept, before = [], resident()
def work(seed):
    chance = random.Random(seed)
    pieces = [bytes(chance.randrange(1000, 300_000)) for _ in range(300)]
    kept.extend(pieces[::100])
threads = [threading.Thread(target=work, args=(seed,)) for seed in range(12)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
malloc_tuning.trim()
print(resident() - before)
"""

# Opens and ends topics. Each has an epoll object while it exists.
TOPICS = """
import gc, os, queue, rospy, threading
from rosafe.ros1.transport import registration
from rosafe.ros1.transport.publisher import Publisher
from std_msgs.msg import String
from tests.harness import wait_for

def polls():
    files = (os.path.realpath(f"/proc/self/fd/{number}") for number in os.listdir("/proc/self/fd"))
    return sum(file.endswith("[eventpoll]") for file in files)

gc.disable()
registration.init_node("opener", ["opener"])
heard = threading.Event()
kept = Publisher("/of_the_opener/kept", String), rospy.Subscriber("/of_the_opener/kept", String, lambda _: heard.set())
kept[0].publish(String("kept"))
assert heard.wait(60)  # the servers of the node run, which have epoll objects, too
before = polls()
for _ in range(6):
    received = queue.Queue()
    mine = Publisher("/of_the_opener", String)
    theirs = [rospy.Subscriber(name, String, received.put) for name in ("/of_the_test/text", "/of_the_opener")]
    mine.publish(String("mine"))
    print(sorted(received.get(timeout=60).data for _ in theirs), polls() >= before + 3)
    for topic in (mine, *theirs):
        topic.unregister()
del mine, theirs, topic
wait_for(lambda: polls() == before, what=lambda: f"{polls()} epoll objects, {before} before")
"""


def test_freed_memory_is_returned_to_the_system(graph: Graph) -> None:
    proc()
    done = graph.run(PYTHON, "-c", SPREAD, PYTHONPATH=str(ROOT))
    assert int(done.stdout) < 60, "of some 500 MiB"


def test_removed_processors_are_freed_without_garbage_collection(graph: Graph, tmp_path: Path) -> None:
    """They have tens of MB each, and Python looks for reference cycles only after very many allocations."""
    frames = 20_000
    (tmp_path / "uncollected.py").write_text(f"{text_of(Fault(PLAIN, '', ''))}\nimport gc\ngc.disable()\n")
    with graph.node("rosAFE-ros", "-i", "uncollected", ROSAFE_PLUGINS=str(tmp_path)) as process:
        session = Session(graph, process, "uncollected")
        microphone = session.build("PreProc", block=frames // 4)

        def cycle() -> None:
            session.ok("GammatoneProc", fb_nChannels=64)
            session.ok("IhcProc")
            microphone.play(noise(frames))
            session.read("ihc", microphone.index + 1)
            session.ok("removeProcessor", name="gammatone")

        cycle()
        before = ResourceUse.of(process.pid).memory
        for _ in range(10):
            cycle()
        after = ResourceUse.of(process.pid).memory
        session.close()
        assert (after - before) / 2**20 < 150, "of some 400 MiB"


def test_files_of_topics_that_have_ended_are_closed_without_garbage_collection(graph: Graph) -> None:
    proc()
    graph.client()
    text = rospy.Publisher("/of_the_test/text", String, latch=True, queue_size=1)
    text.publish(String("theirs"))
    done = graph.run(PYTHON, "-c", TOPICS, PYTHONPATH=str(ROOT))
    assert done.stdout.splitlines() == ["['mine', 'theirs'] True"] * 6, done
    text.unregister()
