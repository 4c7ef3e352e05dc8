"""All twenty-one representations live through the node: lost frames on their ports.

``/usr/bin/python3 benchmarks/everything.py`` starts real nodes with a private master, builds one processor of each kind
with its defaults, and subscribes from another process to all their ports, which are one block long. The exit code is 1
if a frame was lost on a port, or if the node reports lost sound.
"""

from __future__ import annotations

import os
import sys
import time

import graph
import report
from ports import count

from rosafe.interface import KINDS

PENDING = 10  # messages per port that may not have arrived at the end; gaps between messages always count


def build(bench: graph.Bench, block: int) -> None:
    """Start the sound, and add one processor of each kind, with ports of one block."""
    seconds = block / graph.RATE
    bench.call("/rosAFE/connect_port", local="Audio", remote=graph.AUDIO)
    bench.call("/bass/Acquire", device="scene:", sampleRate=graph.RATE, nFramesPerChunk=block, nChunksOnPort=20)
    bench.call("/rosAFE/InputProc", nFramesPerBlock=block, bufferSize_s_port=seconds)
    for kind in KINDS.values():
        if kind.parent:
            bench.call(f"/rosAFE/{kind.request}", name=kind.name, upperDepName=KINDS[kind.parent].name)


def main() -> int:
    """Measure, print and write."""
    parser = report.arguments("Run all representations live through the node, and count lost frames.")
    parser.add_argument("--seconds", type=float, default=60.0, help="duration (default %(default)s)")
    parser.add_argument("--block", type=int, default=4410, help="frames per block (default %(default)s)")
    options = parser.parse_args()
    if not 0 < options.seconds <= 86400 or not 1 <= options.block <= 441000:
        parser.error("--seconds: expected more than 0; --block: expected 1 to 441000")
    page = report.Report(options, "All representations at once")
    lost = 0
    with graph.bench() as bench:
        build(bench, options.block)
        topics = [graph.topic(kind) for kind in KINDS]
        subscriber = bench.subscribe(topics)
        page.say(
            f"{len(topics)} kinds, blocks of {options.block}, {options.seconds:g} s; all ports read by one process"
        )
        page.say()
        before = _seconds(bench.pid("/rosAFE"))
        time.sleep(options.seconds)
        busy = (_seconds(bench.pid("/rosAFE")) - before) / options.seconds
        received = subscriber.close()
        rows = []
        for topic in topics:
            port = count(topic, [int(index) for index, _ in received[topic]], options.block, options.block)
            expected = int(options.seconds * graph.RATE / options.block) - PENDING
            missing = port.lost + max(0, expected - port.received) * options.block
            rows.append([f"`{topic}`", str(port.received), str(port.expected), str(missing)])
            lost += missing
        page.table(["port", "messages", "expected", "frames lost"], rows)
        status = bench.health()
        page.say(f"* status of the node: {status}")
        page.say(f"* it used {busy:.2f} of {len(os.sched_getaffinity(0))} cores")
        page.say(f"* frames lost on all ports: {lost}")
    page.write("everything.md")
    return 1 if lost or "no frames lost" not in status else 0


def _seconds(pid: int) -> float:
    """Return the processor time that a process has used so far."""
    with open(f"/proc/{pid}/stat", encoding="utf-8") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    sys.exit(main())
