"""Number of default trees that two cores run in real time without a lost frame, in one process and in several.

``/usr/bin/python3 benchmarks/streams.py`` plays sound in real time into the ring that a rosAFE node reads, with several
default trees (filterbank to cross-correlation, 44.1 kHz) below one input. It searches for the largest number of trees
with short trials, and runs that number for a minute. It prints the latency for each number of trees, and the cost of a
tree on one core. ROS is not involved: benchmarks/ports.py measures ports and subscribers. It takes about four minutes;
`--seconds` and `--trial` make it shorter.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

for library in ("OMP", "OPENBLAS", "MKL"):
    os.environ[f"{library}_NUM_THREADS"] = "1"
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

import numpy as np  # noqa: E402
import report  # noqa: E402

RATE = 44100
PARENTS = {
    "preProc": "input",
    "gammatone": "preProc",
    "ihc": "gammatone",
    "ild": "ihc",
    "ratemap": "ihc",
    "crossCorrelation": "ihc",
}
MAX_LATE_BLOCKS = 2.0  # delay of the last result, in blocks; with more, the trees do not keep up
GOAL = 60
TREE_COUNTS = (1, 5, 10, 20)  # numbers of trees for which the cost on one core is measured
SETTLE_SECONDS = 1.0  # at the beginning; these results are ignored


class Played(NamedTuple):
    """The result of a trial; times in seconds."""

    trees: int
    lost: int  # frames
    late: float  # delay of the last result in blocks
    median: float  # latency from the last sample of a block to its ILD
    worst: float  # 99th percentile of the latency
    busy: float  # cores used by all processes
    cost: float  # processor time of a tree per second of sound

    @property
    def held(self) -> bool:
        """Whether the trees kept up."""
        return self.lost == 0 and self.late < MAX_LATE_BLOCKS


class Clock:
    """A listener that records the latency of each ILD block."""

    def __init__(self, block: int) -> None:
        self.begun = 0.0
        self.lateness: list[float] = []
        self._seconds = block / RATE
        self._lock = threading.Lock()

    def on_added(self, processor: Any) -> None:
        pass

    def on_executed(self, processor: Any, seconds: float) -> None:
        pass

    def on_removed(self, processor: Any) -> None:
        if processor.error is not None:
            print(f"{processor!r}: {processor.error!r}", file=sys.stderr)

    def on_released(self, processor: Any, block: Any) -> None:
        if processor.kind == "ild":
            late = time.monotonic() - self.begun - block.next_index / RATE
            with self._lock:
                self.lateness.append(late)


def play(trees: int, block: int, seconds: float, cores: list[int], begin: float) -> tuple[int, list[float], float]:
    """Play from `begin` (monotonic time); return lost frames, latencies after `SETTLE_SECONDS`, and processor time."""
    os.sched_setaffinity(0, cores)
    from rosafe.audio.stream.ring import AudioRing
    from rosafe.tree.tree import Tree

    noise = (np.random.default_rng(0).standard_normal((2, block)) * 2e8).astype(np.int32)
    ring, clock = AudioRing(lambda line: print(line, file=sys.stderr)), Clock(block)
    receive, tree = ring.connect(), Tree(clock)

    def feed(number: int) -> None:
        last = number * block
        receive(
            SimpleNamespace(
                sampleRate=RATE,
                lastFrameIndex=last,
                nChunksOnPort=1,
                nFramesPerChunk=block,
                left=noise[0],
                right=noise[1],
                stamp={"sec": 0, "nsec": 0},
            )
        )

    feed(1)
    reader = ring.open_reader(block, 1.0, lambda: False)
    assert reader is not None
    tree.add_input("input", reader, block, 0.05, 0.05)
    for number in range(trees):
        names = {kind: f"{kind}{number}" for kind in PARENTS} | {"input": "input"}
        for kind, parent in PARENTS.items():
            tree.add(kind, names[kind], names[parent])
    blocks = int(seconds * RATE / block)
    time.sleep(max(0.0, begin - time.monotonic()))
    clock.begun = time.monotonic() - block / RATE  # the first block is already in the ring
    clock.lateness.clear()
    spent = time.process_time()
    for number in range(2, blocks + 2):
        time.sleep(max(0.0, clock.begun + number * block / RATE - time.monotonic()))
        feed(number)
    time.sleep(MAX_LATE_BLOCKS * block / RATE)
    spent = time.process_time() - spent
    lost, lateness = ring.counters.lost + ring.behind, list(clock.lateness)
    tree.stop()
    return lost, lateness[int(SETTLE_SECONDS * RATE / block) * trees :], spent


def trial(trees: int, processes: int, block: int, seconds: float, cores: list[int]) -> Played:
    """Run `trees` trees, distributed over `processes` processes."""
    shares = [trees // processes + (number < trees % processes) for number in range(processes)]
    shares = [share for share in shares if share]
    with ProcessPoolExecutor(len(shares), mp_context=get_context("spawn")) as pool:
        begin = time.monotonic() + 2.0 + 0.1 * max(shares)  # time for all processes to build their trees
        runs = [pool.submit(play, share, block, seconds, cores, begin) for share in shares]
        results = [run.result() for run in runs]
    lateness = np.concatenate([np.array(late) for _, late, _ in results])
    spent = sum(spent for _, _, spent in results)
    expected = sum(shares) * int((seconds - SETTLE_SECONDS) * RATE / block)
    last = max(max(late[-share:], default=np.inf) for (_, late, _), share in zip(results, shares, strict=True))
    missing = max(0, expected - len(lateness)) if len(lateness) < 0.98 * expected else 0
    median, worst = np.percentile(lateness, [50, 99]) if len(lateness) else (np.inf, np.inf)
    lost = sum(lost for lost, _, _ in results) if max(lost for lost, _, _ in results) > MAX_LATE_BLOCKS * block else 0
    return Played(
        trees, lost + missing * block, last * RATE / block, median, worst, spent / seconds, spent / seconds / trees
    )


def search(page: report.Report, processes: int, block: int, options: Any, cores: list[int]) -> Played:
    """Find the largest number of trees in short trials, and confirm it, or a smaller number, in a long one."""
    held, failed, found = 0, options.most + 1, {}
    guess = min(options.most, GOAL)
    while failed - held > max(1, held // 16):
        found[guess] = trial(guess, processes, block, options.trial, cores)
        held, failed = (guess, failed) if found[guess].held else (held, guess)
        guess = min(options.most, 2 * held) if failed > options.most and held else (held + failed) // 2
        if guess in (held, failed, 0):
            break
    rows = [_row(played) for _, played in sorted(found.items())]
    page.table(["trees, short trials", "median ms", "p99 ms", "blocks late", "cores busy", "held"], rows)
    count = held
    while count:
        played = trial(count, processes, block, options.seconds, cores)
        if played.held:
            return played
        count = min(count - 1, count * 15 // 16)
    return Played(0, 0, 0.0, 0.0, 0.0, 0.0, 0.0)


def _row(played: Played) -> list[str]:
    late = f"{played.late:.1f}" if np.isfinite(played.late) else "never"
    return [
        str(played.trees),
        f"{1000 * played.median:.1f}",
        f"{1000 * played.worst:.1f}",
        late,
        f"{played.busy:.2f}",
        "yes" if played.held else "no",
    ]


def main() -> int:
    """Measure, print and write."""
    parser = report.arguments("Measure the number of default trees that two cores run in real time, and their latency.")
    parser.add_argument("--block", type=int, default=2205, help="frames per block (default %(default)s)")
    parser.add_argument("--seconds", type=float, default=60.0, help="duration of the final trial (default 60)")
    parser.add_argument("--trial", type=float, default=5.0, help="duration of each short trial (default 5)")
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2], help="numbers of processes (default 1 2)")
    parser.add_argument("--most", type=int, default=120, help="largest number of trees (default 120)")
    options = parser.parse_args()
    if (
        options.seconds <= SETTLE_SECONDS
        or options.trial <= SETTLE_SECONDS
        or options.block < 1
        or min(options.processes) < 1
    ):
        parser.error(f"--seconds, --trial: expected more than {SETTLE_SECONDS:g}; all others: expected at least 1")
    if not 1 <= options.most <= 200:
        parser.error("--most: expected 1 to 200")
    page = report.Report(options, "Many trees at once")
    cores = sorted(os.sched_getaffinity(0))[:2]
    page.say(
        f"Default trees at {RATE} Hz on {len(cores)} cores, in real time, blocks of {options.block} frames. Latency"
    )
    page.say("is from the last sample of a block to its ILD.")
    page.say()
    page.say("## One core, one process: cost of a tree")
    page.say()
    rows = []
    for trees in (count for count in TREE_COUNTS if count <= options.most):
        played = trial(trees, 1, options.block, options.trial, cores[:1])
        rows.append([*_row(played), f"{1000 * played.cost:.1f}"])
    page.table(["trees", "median ms", "p99 ms", "blocks late", "cores busy", "held", "ms per tree and second"], rows)
    for processes in options.processes:
        page.say(f"## Two cores, {'one process' if processes == 1 else f'{processes} processes'}")
        page.say()
        played = search(page, processes, options.block, options, cores)
        page.say(
            f"{played.trees} trees (goal {GOAL}) ran for {options.seconds:g} s without a lost frame: latency median"
            f" {1000 * played.median:.1f} ms, p99 {1000 * played.worst:.1f} ms; {played.busy:.2f} of {len(cores)} cores"
            f" used, {1000 * played.cost:.1f} ms per tree and second."
        )
        full = played.busy > 0.9 * len(cores)
        page.say("Limited by " + ("processor time." if full else "waiting for the GIL or for other workers."))
        page.say()
    page.write("streams.md")
    return 0


if __name__ == "__main__":
    sys.exit(main())
