"""Throughput of the output ports: serialising and reading a large message, and all ports subscribed for a while.

``/usr/bin/python3 benchmarks/ports.py`` prints the times for the message of the gammatone port: one second of 31
channels for two ears, which is 22 MB. Then it starts real nodes with a private master, and subscribes to all seven
ports of the default tree from another process: blocks of 12000 with ports of one second, and blocks of 882 with short
ports. It compares the messages on every port with the number expected from the audio, and measures the memory of both
processes. The exit code is 1 if frames were lost, or if a process has grown.
"""

from __future__ import annotations

import io
import itertools
import math
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import graph
import numpy as np
from report import Report, arguments

from rosafe.interface import CORE_REPRESENTATIONS
from rosafe.ros1.component import generate
from rosafe.ros1.transport.publisher import BufferList

SETTLE_SECONDS = 5.0  # after this time windows and buffers are full
UNSUBSCRIBED_SECONDS = 2.0  # in this time the node ends a connection and drops the messages that wait for it
MAX_GROWTH = 64.0  # MB; the leak of one window would exceed this


# --- one large message ------------------------------------------------------------------------------------------


def times(count: int = 20) -> dict[str, float]:
    """Measure the median ms of each step in the processing of a 22 MB message."""
    generate.ensure_messages()
    from rosAFE.msg import rosAFE_TimeFrequencySignalPortStruct

    from rosafe.ros import array_msg
    from rosafe.ros1.transport.publisher import send_pieces
    from rosafe.tree.history import SlidingWindow

    window = SlidingWindow((2, 31), graph.RATE)
    for seed in range(6):
        window.append(np.random.default_rng(seed).normal(size=(2, 31, 12000)))
    view = window.padded_view(window.frames)
    data_class = array_msg(rosAFE_TimeFrequencySignalPortStruct)
    message = data_class(numberOfChannels=31, framesOnPort=graph.RATE, left=view.select(0), right=view.select(1))

    def into_memory() -> None:
        message.serialize(io.BytesIO())

    def for_the_socket() -> None:
        message.serialize(BufferList())

    out = io.BytesIO()
    message.serialize(out)
    data = out.getvalue()
    sender, receiver = socket.socketpair()
    drain = threading.Thread(target=_drain, args=(receiver,))
    drain.start()

    def through_a_socket() -> None:
        out = BufferList()
        message.serialize(out)
        send_pieces(sender, out.pieces)

    found = {
        "serialise into memory (as rospy)": _median(into_memory, count),
        "serialise for the socket (as the node)": _median(for_the_socket, count),
        "serialise and send to another thread": _median(through_a_socket, count),
        "read": _median(lambda: data_class().deserialize(data), count),
        "for comparison: copy the bytes": _median(lambda: bytearray(data), count),
    }
    sender.close()
    drain.join()
    receiver.close()
    return found


def _drain(sock: socket.socket) -> None:
    room = bytearray(2**20)
    while sock.recv_into(room):
        continue


def _median(function: Callable[[], Any], count: int) -> float:
    spent = []
    for _ in range(count + 3):
        begin = time.perf_counter()
        function()
        spent.append(time.perf_counter() - begin)
    return 1000 * float(np.median(spent[3:]))


# --- all ports for a while --------------------------------------------------------------------------------------


class Port(NamedTuple):
    """The messages received on a port."""

    topic: str
    received: int  # messages
    expected: int
    lost: int  # audio frames that were in no window


def count(topic: str, indexes: list[int], block: int, window: int) -> Port:
    """Compare messages with blocks: on every port `lastFrameIndex` increases by one block per message.

    The frames of a skipped message are lost only if they are not in the next window.
    """
    seen = sorted({index for index in indexes if index})
    expected = (seen[-1] - seen[0]) // block + 1 if seen else 0
    lost = sum(max(0, later - earlier - max(window, block)) for earlier, later in itertools.pairwise(seen))
    return Port(topic, len(seen), expected, lost)


class Run(NamedTuple):
    """The result of one run; least memory in MB, at the beginning and at the end.

    The memory of the node is measured before and after the subscription, while no message waits to be sent. The memory
    of the subscriber is measured during the subscription.
    """

    ports: list[Port]
    node: tuple[float, float]
    subscriber: tuple[float, float]

    @property
    def lost(self) -> int:
        """Frames lost on all ports; a port without messages counts as one."""
        return sum(port.lost for port in self.ports) + sum(port.received == 0 for port in self.ports)

    @property
    def growth(self) -> float:
        """Growth in MB of the process that has grown more."""
        return max(last - first for first, last in (self.node, self.subscriber))


def least_memory(pid: int, seconds: float) -> float:
    """Return the least memory of a process in MB during some seconds."""
    end, least = time.monotonic() + seconds, math.inf
    while time.monotonic() < end:
        least = min(least, graph.resident(pid))
        time.sleep(0.05)
    return least


def run(bench: graph.Bench, block: int, port_seconds: float, seconds: float) -> Run:
    """Subscribe to all ports of the running tree from another process for `seconds`.

    An earlier subscription makes the buffers for serialization, which do not count as growth.
    """
    topics = [graph.topic(kind) for kind in CORE_REPRESENTATIONS]
    node = bench.pid("/rosAFE")
    earlier = bench.subscribe(topics)
    time.sleep(SETTLE_SECONDS)
    earlier.close()
    node_before = least_memory(node, UNSUBSCRIBED_SECONDS)

    reader = bench.subscribe(topics)
    pid, settling = reader.child.process.pid, min(SETTLE_SECONDS, seconds / 2)
    time.sleep(settling)
    quarter = (seconds - settling) / 4
    first = least_memory(pid, quarter)
    time.sleep(2 * quarter)
    last = least_memory(pid, quarter)
    received = reader.close()

    window = round(port_seconds * graph.RATE)
    ports = [count(topic, [int(index) for index, _ in received[topic]], block, window) for topic in topics]
    return Run(ports, (node_before, least_memory(node, UNSUBSCRIBED_SECONDS)), (first, last))


def report(page: Report, result: Run) -> None:
    """Print one run."""
    page.table(
        ["port", "received", "expected", "frames lost"],
        [[port.topic, str(port.received), str(port.expected), str(port.lost)] for port in result.ports],
    )
    for name, (first, last) in (("node", result.node), ("subscriber", result.subscriber)):
        page.say(f"* memory of the {name}: {first:.0f} MB at the beginning, {last:.0f} MB at the end")
    page.say()


def main() -> int:
    """Measure, print and write."""
    parser = arguments("Measure the serialisation of a large message, and all ports subscribed for a while.")
    parser.add_argument("--seconds", type=float, default=60.0, help="duration of each run (default %(default)s)")
    parser.add_argument("--quick", action="store_true", help="omit the times of a single message, and write no files")
    options = parser.parse_args()
    page = Report(options, "Throughput of the ports")
    if not options.quick:
        page.table(["22 MB message", "median ms"], [[step, f"{spent:.2f}"] for step, spent in times().items()])
    lost = 0
    with graph.bench() as bench:
        for block, port_seconds, chunk in ((12000, 1.0, 2205), (882, 0.02, 882)):
            page.say(f"## Blocks of {block}, ports of {port_seconds:g} s, {options.seconds:g} s")
            page.say()
            bench.build(block, port_seconds, chunk)
            result = run(bench, block, port_seconds, options.seconds)
            report(page, result)
            lost += result.lost
            if result.growth > MAX_GROWTH:
                page.say(f"* a process has grown by {result.growth:.0f} MB")
                lost += 1
            bench.call("/rosAFE/Stop")
    if not options.quick:
        page.write("ports.md")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
