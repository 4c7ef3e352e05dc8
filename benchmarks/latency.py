"""Latency from a chunk on /bass/Audio to the ILD message, measured in another process.

``/usr/bin/python3 benchmarks/latency.py`` starts real nodes with a private master, and builds the default tree. It
measures with only the ILD port subscribed, for blocks and chunks of several lengths, and for long blocks also with all
ports subscribed by a third process. A block is computed
when its last chunk has arrived: the newest frame of the message with `lastFrameIndex` L has number L - 1, and is part
of that chunk. Times are counted from the arrival of the chunk in the measuring process, and from its acquisition by
bass. The latter includes the delivery by bass and ROS. The second table is that of benchmarks/localizer_node.py.
"""

from __future__ import annotations

import sys
import time

import graph
import localizer_node
import numpy as np
from report import Report, arguments

from rosafe.interface import CORE_REPRESENTATIONS

BLOCKS = (2205, 882, 441, 220)
MIN_BLOCK_OF_ALL = 2205  # frames; with shorter blocks, all ports together exceed 1 GB/s
HOP_SECONDS = 0.01  # of the ILD: it has at most one message for each


def latencies(received: dict[str, list[list[float]]]) -> np.ndarray:
    """Return seconds from arrival and acquisition of a chunk to the ILD message that it completes: (2, messages)."""
    chunks = {int(index): moments for index, *moments in received[graph.AUDIO]}
    results = [(int(index) - 1, moment) for index, moment in received[graph.topic("ild")]]
    pairs = [[moment - begin for begin in chunks[last]] for last, moment in results if last > 0 and last in chunks]
    return np.array(pairs).T


def measure(bench: graph.Bench, block: int, messages: int) -> np.ndarray:
    """Return the latencies of `messages` ILD messages."""
    timer = bench.subscribe([graph.AUDIO, graph.topic("ild")])
    time.sleep(1.0 + messages * max(block / graph.RATE, HOP_SECONDS))
    return latencies(timer.close())[:, -messages:]


def rows(setting: str, seconds: np.ndarray) -> list[list[str]]:
    """Return the rows of one measurement."""
    found = []
    for since, row in zip(("arrived", "was acquired"), 1000 * seconds, strict=True):
        percentiles = np.percentile(row, [50, 99, 100])
        found.append([f"{setting}, since it {since}", str(len(row)), *(f"{ms:.1f}" for ms in percentiles)])
    return found


def run(block: int, port_seconds: float, messages: int) -> list[list[str]]:
    """Return the rows of the table for blocks and chunks of `block` frames."""
    with graph.bench() as bench:
        bench.build(block, port_seconds, block)
        found = rows("only ILD subscribed", measure(bench, block, messages))
        if block >= MIN_BLOCK_OF_ALL:
            subscriber = bench.subscribe(graph.topic(kind) for kind in CORE_REPRESENTATIONS)
            found += rows("all ports subscribed elsewhere", measure(bench, block, messages))
            subscriber.close()
    return [[str(block), *row] for row in found]


def main() -> int:
    """Measure, print and write."""
    parser = arguments("Latency from /bass/Audio to the ILD port in another process.")
    parser.add_argument("--messages", type=int, default=600, help="number of ILD messages (default %(default)s)")
    parser.add_argument("--blocks", type=int, nargs="+", default=BLOCKS, help="frames per block (default %(default)s)")
    parser.add_argument("--port-seconds", type=float, default=1.0, help="length of the ports (default %(default)s)")
    options = parser.parse_args()
    if options.messages < 1 or min(options.blocks) < 1:
        parser.error("--messages, --blocks: expected at least 1")
    page = Report(options, "Latency")
    found: list[list[str]] = []
    for block in options.blocks:
        found += graph.in_child(run, block, options.port_seconds, options.messages)
    page.table(["frames per block", "ms", "count", "median", "p99", "max"], found)
    localizer_node.add_to(page)
    page.write("latency.md")
    return 0


if __name__ == "__main__":
    sys.exit(main())
