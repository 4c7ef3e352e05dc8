"""Cost and latency of the ROS 2 node beside the ROS 1 nodes, which run at the same time on the same scene.

``/usr/bin/python3 benchmarks/ros2.py`` starts ROS 1 nodes with a private master, and the ROS 2 node with the wheels of
`scripts/install --tests`. It reports ratios of processor times: of the default tree in blocks of 882 frames with the
ILD subscribed, and of localizing. The ROS 2 node also does the work of bass. The latency is the time from the
acquisition of the block that completes a frame of the ILD until its message has arrived in another process. Memory is
measured with subscribers that come and go.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import graph
import numpy as np
from localizer_node import processor_seconds
from report import Report, arguments

from rosafe.interface import CORE_REPRESENTATIONS
from tests.harness import Process
from tests.ros2.network import Network, network, variables

BLOCK, SHORT_BLOCK = 882, 220
HOP, WINDOW = 441, 882  # of the ILD, in audio frames
SETTLE_SECONDS = 5.0
WARM_SECONDS = 60.0  # until the buffers of the tree have their size
START_SECONDS = 600.0  # including the model of the head
READER = """
import sys, time
import rclpy
from rosafe_msgs.msg import Representation, SoundSources
def show(message):
    stamp = message.header.stamp
    if hasattr(message, "first_frame"):
        print(time.time(), stamp.sec + 1e-9 * stamp.nanosec, message.first_frame, message.shape[-1], flush=True)
rclpy.init()
node = rclpy.create_node("reader")
kind = SoundSources if sys.argv[1].endswith("sources") else Representation
node.create_subscription(kind, sys.argv[1], show, 10)
print("ready", flush=True)
rclpy.spin(node)
"""


@contextmanager
def ros2(*parameters: str) -> Iterator[tuple[Network, Process]]:
    """Run the node of ROS 2 in a network of its own."""
    env = variables()
    if isinstance(env, str):
        raise SystemExit(env)
    with tempfile.TemporaryDirectory() as folder, network(env, Path(folder)) as net:
        yield net, net.node("device:=scene:", *parameters, XDG_CACHE_HOME=str(Path("~/.cache").expanduser()))


def read(net: Network, topic: str) -> Process:
    """Subscribe in another process."""
    reader = net.python(READER, topic)
    graph_wait(lambda: bool(reader.out))
    return reader


def graph_wait(condition: Any) -> None:
    """Wait for a condition."""
    end = time.monotonic() + START_SECONDS
    while not condition():
        if time.monotonic() > end:
            raise SystemExit("the node of ROS 2 does not start")
        time.sleep(0.1)


def used(seconds: float, *pids: int) -> list[float]:
    """Return the processor time of each process during `seconds`, in % of a core."""
    time.sleep(SETTLE_SECONDS)
    before = [processor_seconds(pid) for pid in pids]
    time.sleep(seconds)
    return [100 * (processor_seconds(pid) - begin) / seconds for pid, begin in zip(pids, before, strict=True)]


def tree(seconds: float) -> list[list[str]]:
    """Return the row of the default tree."""
    kinds = ", ".join(kind for kind, representation in CORE_REPRESENTATIONS.items() if representation.parent)
    with graph.bench() as bench, ros2(f"frames_per_block:={BLOCK}", f"representations:=[{kinds}]") as (net, node):
        bench.build(BLOCK, 1.0, BLOCK)
        bench.subscribe([graph.topic("ild")])
        reader = read(net, "/rosafe/ild")
        graph_wait(lambda: len(reader.out.splitlines()) > 9)
        bass, afe, second = used(seconds, bench.pid("/bass"), bench.pid("/rosAFE"), node.pid)
        return [row("default tree, blocks of 882 frames, ILD subscribed", bass, afe, second)]


def localizing(seconds: float) -> list[list[str]]:
    """Return the row of the localizer: the sources of both versions have a subscriber, so that speech is detected."""
    import rospy

    with graph.bench() as bench, ros2(f"frames_per_block:={BLOCK}", "localize:=true") as (net, node):
        bench.start_sound(BLOCK)
        bench.call("/rosAFE/InputProc", nFramesPerBlock=BLOCK)
        localizer = bench.start("rosafe", "localize")
        bench.session.wait(lambda: "localizing with" in localizer.err, "the localizer does not start", START_SECONDS)
        rospy.Subscriber("/localizer/sources", rospy.AnyMsg, lambda message: None)
        read(net, "/rosafe/sources")
        graph_wait(lambda: "localizing with" in node.err)
        pids = (bench.pid("/bass"), bench.pid("/rosAFE"), localizer.process.pid, node.pid)
        bass, *nodes, second = used(seconds, *pids)
        return [row("localizing", bass, sum(nodes), second)]


def row(name: str, bass: float, nodes: float, second: float) -> list[str]:
    """Return a row of the table of costs."""
    return [
        name,
        f"{bass:.1f}",
        f"{nodes:.1f}",
        f"{second:.1f}",
        f"{second / (bass + nodes):.2f}",
        f"{second / nodes:.2f}",
    ]


def latency(seconds: float) -> list[list[str]]:
    """Return the rows of the latency in short blocks."""
    with ros2(f"frames_per_block:={SHORT_BLOCK}", "representations:=[ild]") as (net, _):
        reader = read(net, "/rosafe/ild")
        time.sleep(SETTLE_SECONDS + seconds)
        lines = [line.split() for line in reader.out.splitlines()[1:-1]]
    arrived, stamps, first, count = np.array(lines, float)[-round(100 * seconds) :].T
    end = (first + count - 1) * HOP + WINDOW  # of the last frame
    acquired = np.ceil(end / SHORT_BLOCK) * SHORT_BLOCK  # of the block that completes it
    middle = first * HOP + WINDOW / 2
    delays = 1000 * (arrived - stamps - (acquired - middle) / graph.RATE)
    names = ("median", "99 %", "maximum")
    return [[name, f"{ms:.1f}"] for name, ms in zip(names, np.percentile(delays, [50, 99, 100]), strict=True)]


def memory(minutes: float) -> list[list[str]]:
    """Return the resident memory after a minute, and after subscribers that came and went."""
    with ros2("representations:=[ild, ratemap, crossCorrelation]") as (net, node):
        for topic in ("ild", "ratemap", "crossCorrelation"):
            read(net, f"/rosafe/{topic}").stop()
        time.sleep(WARM_SECONDS)
        begin, end = graph.resident(node.pid), time.monotonic() + 60 * minutes
        number = 0
        while time.monotonic() < end:
            reader = read(net, f"/rosafe/{('ild', 'ratemap', 'crossCorrelation')[number % 3]}")
            time.sleep(1.0)
            reader.close()
            number += 1
        return [["after a minute", f"{begin:.0f}"], [f"after {number} subscribers", f"{graph.resident(node.pid):.0f}"]]


def main() -> None:
    """Measure and write the report."""
    parser = arguments(str(__doc__).partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of each measurement (default %(default)g)")
    parser.add_argument(
        "--minutes", type=float, default=10.0, help="of subscribers that come and go (default %(default)g)"
    )
    options = parser.parse_args()
    report = Report(options, "The ROS 2 node")
    os.environ.pop("PYTHONPATH", None)
    costs = [*graph.in_child(tree, options.seconds), *graph.in_child(localizing, options.seconds)]
    head = ["processor time, % of a core", "bass", "rosAFE (and localizer)", "ROS 2", "ratio to all", "without bass"]
    report.table(head, costs)
    report.table(["from the acquisition of a block of 220 frames to its ILD, ms", ""], latency(options.seconds))
    report.table(["resident memory, MB", ""], memory(options.minutes))
    report.write("ros2.md")


if __name__ == "__main__":
    main()
