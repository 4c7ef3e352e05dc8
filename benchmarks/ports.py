"""What the output ports can carry: serialising and reading the large message, and all ports subscribed for a while.

``/usr/bin/python3 benchmarks/ports.py`` prints the times for the message of the gammatone port, one second of 31
channels for two ears, which is 22 MB. Then it starts real nodes on a master of its own and subscribes to all seven
ports of the default tree from another process: blocks of 12000 with ports of one second, and blocks of 882 with short
ones. It counts what came on every port against what the audio says there must be, and the memory of both processes.
The exit code is 1 where frames were lost, or where a process has grown.
"""

from __future__ import annotations

import io
import itertools
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import graph
import numpy as np
from report import Report, arguments

from rosafe.component import generate
from rosafe.interface import CORE_REPRESENTATIONS
from rosafe.transport.buffer_list import BufferList

SETTLED = 5.0  # seconds until memory counts: windows and buffers are full by then
GROWTH = 64.0  # MB; a leak of one window in the time would be as much as that


# --- one large message ------------------------------------------------------------------------------------------


def times(count: int = 20) -> dict[str, float]:
    """Median ms of each step in the life of a 22 MB message, on this machine."""
    generate.ensure_messages()
    from rosAFE.msg import rosAFE_TimeFrequencySignalPortStruct

    from rosafe.ros import array_msg
    from rosafe.transport.publisher import send_pieces
    from rosafe.tree.sliding_window import SlidingWindow

    window = SlidingWindow((2, 31), graph.RATE)
    for seed in range(6):
        window.append(np.random.default_rng(seed).normal(size=(2, 31, 12000)))
    view = window.view()
    data_class = array_msg(rosAFE_TimeFrequencySignalPortStruct)
    message = data_class(numberOfChannels=31, framesOnPort=graph.RATE, left=view.select(0), right=view.select(1))

    def into_memory() -> None:
        message.serialize(io.BytesIO())

    def for_the_socket() -> None:
        message.serialize(BufferList())

    out = io.BytesIO()
    message.serialize(out)
    data = out.getvalue()
    ours, theirs = socket.socketpair()
    drain = threading.Thread(target=_drain, args=(theirs,))
    drain.start()

    def through_a_socket() -> None:
        out = BufferList()
        message.serialize(out)
        send_pieces(ours, out.pieces)

    found = {
        "serialise into memory (rospy's way)": _median(into_memory, count),
        "serialise for the socket (the node's way)": _median(for_the_socket, count),
        "serialise and send to another thread": _median(through_a_socket, count),
        "read": _median(lambda: data_class().deserialize(data), count),
        "for comparison: copy the bytes": _median(lambda: bytearray(data), count),
    }
    ours.close()
    drain.join()
    theirs.close()
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
    """What came on one port."""

    topic: str
    came: int  # messages
    expected: int
    lost: int  # audio frames that no window showed


def count(topic: str, indexes: list[int], block: int, window: int) -> Port:
    """Messages against blocks: on every port `lastFrameIndex` goes on by one block per message.

    A message that was skipped costs frames only where the next window does not reach back so far.
    """
    seen = sorted({index for index in indexes if index})
    expected = (seen[-1] - seen[0]) // block + 1 if seen else 0
    lost = sum(max(0, later - earlier - max(window, block)) for earlier, later in itertools.pairwise(seen))
    return Port(topic, len(seen), expected, lost)


class Run(NamedTuple):
    """The result of one run; memory in MB, from when it had settled to the end."""

    ports: list[Port]
    node: tuple[float, float]
    subscriber: tuple[float, float]

    @property
    def lost(self) -> int:
        """Frames lost on all ports; a port on which nothing came counts as one."""
        return sum(port.lost for port in self.ports) + sum(port.came == 0 for port in self.ports)

    @property
    def growth(self) -> float:
        """MB by which a process has grown, the one that grew more."""
        return max(last - first for first, last in (self.node, self.subscriber))


def run(bench: graph.Bench, block: int, port_seconds: float, seconds: float) -> Run:
    """Subscribe to all ports from another process for so long; the tree is there and runs on blocks of `block`."""
    topics = [graph.topic(kind) for kind in CORE_REPRESENTATIONS]
    taker = bench.subscribe(topics)
    pids = bench.node, taker.child.process.pid
    settling = min(SETTLED, seconds / 2)
    time.sleep(settling)
    before = [graph.resident(pid) for pid in pids]
    time.sleep(seconds - settling)
    node, subscriber = zip(before, [graph.resident(pid) for pid in pids], strict=True)
    came = taker.close()
    window = round(port_seconds * graph.RATE)
    return Run([count(t, [int(index) for index, _ in came[t]], block, window) for t in topics], node, subscriber)


def report(page: Report, result: Run) -> None:
    """Print one run."""
    page.table(
        ["port", "came", "expected", "frames lost"],
        [[port.topic, str(port.came), str(port.expected), str(port.lost)] for port in result.ports],
    )
    for name, (first, last) in (("node", result.node), ("subscriber", result.subscriber)):
        page.say(f"* memory of the {name}: {first:.0f} MB at first, {last:.0f} MB at the end")
    page.say()


def main() -> int:
    """Measure, print, write."""
    parser = arguments("Serialisation of large ports, and all ports subscribed for a while.")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each run (default %(default)s)")
    parser.add_argument("--quick", action="store_true", help="leave out the times of a single message; writes nothing")
    options = parser.parse_args()
    page = Report(options, "What the ports carry")
    if not options.quick:
        page.table(["22 MB message", "median ms"], [[what, f"{spent:.2f}"] for what, spent in times().items()])
    lost = 0
    with graph.bench() as bench:
        for block, port_seconds, chunk in ((12000, 1.0, 2205), (882, 0.02, 882)):
            page.say(f"## Blocks of {block}, ports of {port_seconds:g} s, {options.seconds:g} s")
            page.say()
            bench.build(block, port_seconds, chunk)
            result = run(bench, block, port_seconds, options.seconds)
            report(page, result)
            lost += result.lost
            if result.growth > GROWTH:
                page.say(f"* grown by {result.growth:.0f} MB")
                lost += 1
            bench.call("/rosAFE/Stop")
    if not options.quick:
        page.write("ports.md")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
