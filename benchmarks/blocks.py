"""Processor time of the node for blocks of 220 to 12000 frames, with one worker and two.

``/usr/bin/python3 benchmarks/blocks.py`` starts real nodes on a private master for each row. bass plays the device
``scene:`` at 44.1 kHz in chunks of the length of a block, at most 2205 frames, with 20 chunks on its port. rosAFE
computes the default tree of seven processors. The figures are averages over 12 s, which begin 2 s after the start;
each is the median of three such measurements, which alternate with those for one worker and with a subscriber.

The last line shows how much of the difference is due to the machine: the processor time of the same stages, without
nodes and in one thread, for blocks that follow each other at once, and for blocks with pauses between them.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import graph
import numpy as np
from report import Report, arguments

from rosafe.interface import CORE_REPRESENTATIONS
from rosafe.representations import STAGES

BLOCKS = (12000, 2205, 882, 441, 220)
CHUNK = 2205  # maximum frames per chunk
START_SECONDS = 2.0
PAUSED_BLOCK = 882  # frames; 20 ms
PAUSED_BLOCKS = 200
TICKS = os.sysconf("SC_CLK_TCK")


def processor_seconds(pid: int) -> float:
    """Return the processor time of a process so far, in user and system mode."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def load(bench: graph.Bench, seconds: float) -> list[float]:
    """Return the load of rosAFE and bass in per cent of a core, and the resident memory of rosAFE in MB."""
    time.sleep(START_SECONDS)
    pids = [bench.pid("/rosAFE"), bench.pid("/bass")]
    begin, before = time.monotonic(), [processor_seconds(pid) for pid in pids]
    time.sleep(seconds)
    elapsed = time.monotonic() - begin
    loads = [100 * (processor_seconds(pid) - old) / elapsed for pid, old in zip(pids, before, strict=True)]
    return [*loads, graph.resident(pids[0])]


def measure(block: int, workers: int | None, seconds: float, topics: Sequence[str] = ()) -> list[float]:
    """Return the figures of `load` for the default tree with blocks of `block` frames."""
    os.environ.pop("ROSAFE_WORKERS", None)
    if workers is not None:
        os.environ["ROSAFE_WORKERS"] = str(workers)
    with graph.bench() as bench:
        bench.build(block, 1.0, min(block, CHUNK))
        subscriber = bench.subscribe(topics) if topics else None
        figures = load(bench, seconds)
        if subscriber is not None:
            subscriber.close()
        health = bench.health()
    if health != "no frames lost":
        raise RuntimeError(f"blocks of {block}: {health}")
    return figures


def idle(seconds: float) -> tuple[float, float]:
    """Return the load of rosAFE in per cent of a core without sound, and with sound but without processors."""
    with graph.bench() as bench:
        silent = load(bench, seconds)[0]
        bench.start_sound(CHUNK)
        return silent, load(bench, seconds)[0]


def stages_alone(pause: float) -> float:
    """Return the processor time in ms of all stages of the default tree for one block, after pauses of `pause` s."""
    stages = {kind: STAGES[kind](graph.RATE) for kind in CORE_REPRESENTATIONS}
    sound = np.random.default_rng(0).integers(-(2**28), 2**28, (2, PAUSED_BLOCK), np.int32)
    spent = []
    for _ in range(PAUSED_BLOCKS):
        if pause:
            time.sleep(pause)
        outputs = {"": sound}
        begin = time.thread_time()
        for kind, stage in stages.items():
            output = stage.process(outputs[CORE_REPRESENTATIONS[kind].parent])
            outputs[kind] = output[0] if isinstance(output, tuple) else output
        spent.append(time.thread_time() - begin)
    return 1000 * float(np.median(spent))


def main() -> int:
    """Measure, print, write."""
    parser = arguments("Processor time of the node for blocks of different lengths.")
    parser.add_argument("--seconds", type=float, default=12.0, help="duration of a measurement (default %(default)s)")
    parser.add_argument("--blocks", type=int, nargs="+", default=BLOCKS, help="frames per block (default %(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="measurements of each figure (default %(default)s)")
    options = parser.parse_args()
    if options.seconds <= 0 or min(*options.blocks, options.rounds) < 1:
        parser.error("--seconds: above 0; --blocks, --rounds: at least 1")
    page = Report(options, "Blocks")
    page.say(f"* medians of {options.rounds} measurements of {options.seconds:g} s")
    page.say()
    found: list[list[str]] = []
    reference: list[float] = []
    for block in options.blocks:
        cases = [(None, []), (None, [graph.topic("ild")]), (1, [])]  # workers, subscribed topics
        measured = [
            [graph.in_child(measure, block, workers, options.seconds, topics) for workers, topics in cases]
            for _ in range(options.rounds)
        ]
        default, subscribed, single = np.median(measured, axis=0)
        reference = reference or [default[0], subscribed[0]]
        ratios = [default[0] / reference[0], subscribed[0] / reference[1]]
        figures = [f"{x:.1f}" for x in (default[0], ratios[0], subscribed[0], ratios[1], single[0], default[1])]
        found.append([str(block), *figures[:5], f"{default[0] / single[0]:.2f}", figures[5], f"{default[2]:.0f}"])
    base = f"over {options.blocks[0]}"
    head = ["frames per block", "rosAFE, %", base, "ILD subscribed, %", base, "1 worker, %", "2 workers over 1"]
    page.table([*head, "bass, %", "rosAFE, MB"], found)
    silent, connected = graph.in_child(idle, options.seconds)
    page.say()
    page.say(f"rosAFE without sound: {silent:.1f} % of a core; with sound, without processors: {connected:.1f} %.")
    page.say()
    seconds = PAUSED_BLOCK / graph.RATE
    page.say(
        f"The stages alone, {PAUSED_BLOCK} frames: {stages_alone(0):.2f} ms without pauses, "
        f"{stages_alone(seconds):.2f} ms with pauses of {1000 * seconds:.0f} ms."
    )
    page.write("blocks.md")
    return 0


if __name__ == "__main__":
    sys.exit(main())
