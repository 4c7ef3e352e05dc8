"""From a chunk on /bass/Audio to the ILD message, both seen from another process.

``/usr/bin/python3 benchmarks/latency.py`` starts real nodes on a master of its own, builds the default tree and
measures with only the ILD port subscribed, and then with all ports subscribed from a third process. A block is computed
when its last chunk is there: of the message with `lastFrameIndex` L the newest frame is number L - 1, which came with
that chunk. Times count from its arrival in the measuring process, and, which is longer by what bass and ROS take to
deliver it, from the moment that bass had it.
"""

from __future__ import annotations

import sys
import time

import graph
import numpy as np
from report import Report, arguments

from rosafe.interface import CORE_REPRESENTATIONS


def latencies(came: dict[str, list[list[float]]]) -> np.ndarray:
    """Seconds from arrival and from acquisition of a chunk to the ILD message that it completes: (2, messages)."""
    chunks = {int(index): moments for index, *moments in came[graph.AUDIO]}
    results = [(int(index) - 1, moment) for index, moment in came[graph.topic("ild")]]
    pairs = [[moment - begin for begin in chunks[last]] for last, moment in results if last > 0 and last in chunks]
    return np.array(pairs).T


def measure(bench: graph.Bench, block: int, messages: int) -> np.ndarray:
    """Latencies of so many ILD messages."""
    timer = bench.subscribe([graph.AUDIO, graph.topic("ild")])
    time.sleep(1.0 + messages * block / graph.RATE)
    return latencies(timer.close())[:, -messages:]


def rows(what: str, seconds: np.ndarray) -> list[list[str]]:
    """The result of one measurement."""
    found = []
    for since, row in zip(("arrived", "acquired"), 1000 * seconds, strict=True):
        percentiles = np.percentile(row, [50, 99, 100])
        found.append([f"{what}, since it {since}", str(len(row)), *(f"{ms:.1f}" for ms in percentiles)])
    return found


def main() -> int:
    """Measure, print, write."""
    parser = arguments("Latency from /bass/Audio to the ILD port in another process.")
    parser.add_argument("--messages", type=int, default=600, help="how many ILD messages (default %(default)s)")
    parser.add_argument("--block", type=int, default=2205, help="frames per block and chunk (default %(default)s)")
    parser.add_argument("--port-seconds", type=float, default=1.0, help="length of the ports (default %(default)s)")
    options = parser.parse_args()
    if options.messages < 1 or options.block < 1:
        parser.error("--messages, --block: at least 1")
    page = Report(options, "Latency")
    with graph.bench() as bench:
        bench.build(options.block, options.port_seconds, options.block)
        found = rows("only ILD subscribed", measure(bench, options.block, options.messages))
        taker = bench.subscribe(graph.topic(kind) for kind in CORE_REPRESENTATIONS)
        found += rows("all ports subscribed elsewhere", measure(bench, options.block, options.messages))
        taker.close()
    page.table([f"blocks of {options.block}, ms", "count", "median", "p99", "max"], found)
    page.write("latency.md")
    return 0


if __name__ == "__main__":
    sys.exit(main())
