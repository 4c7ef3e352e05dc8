"""From a chunk on /bass/Audio to the ILD message, both seen from another process.

``/usr/bin/python3 benchmarks/latency.py`` starts real nodes on a master of its own, builds the default tree and
measures with only the ILD port subscribed, and then with all ports subscribed from a third process. A block is computed
when its last chunk is there: of the message with `lastFrameIndex` L the newest frame is number L - 1, which came with
that chunk. Times count from its arrival in the measuring process, and, which is longer by what bass and ROS take to
deliver it, from the moment that bass had it.
"""

from __future__ import annotations

import argparse
import os
import sys
import time

import graph
import numpy as np

from rosafe.interface import FIXED


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


def report(what: str, seconds: np.ndarray) -> None:
    """Print the result of one measurement."""
    for since, row in zip(("arrived", "acquired"), 1000 * seconds, strict=True):
        median, late, worst = np.percentile(row, [50, 99, 100])
        print(f"{what + ', since it ' + since:50} {len(row):5d} {median:8.1f} {late:8.1f} {worst:8.1f}", flush=True)


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Latency from /bass/Audio to the ILD port in another process.")
    parser.add_argument("--messages", type=int, default=600, help="how many ILD messages (default %(default)s)")
    parser.add_argument("--block", type=int, default=2205, help="frames per block and chunk (default %(default)s)")
    parser.add_argument("--port-seconds", type=float, default=1.0, help="length of the ports (default %(default)s)")
    options = parser.parse_args()
    with graph.bench() as bench:
        bench.build(options.block, options.port_seconds, options.block)
        print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; blocks of {options.block}; ms")
        print(f"{'':50} {'count':>5} {'median':>8} {'p99':>8} {'max':>8}")
        report("only ILD subscribed", measure(bench, options.block, options.messages))
        taker = bench.subscribe(graph.topic(kind) for kind in FIXED)
        report("all ports subscribed elsewhere", measure(bench, options.block, options.messages))
        taker.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
