"""How fast the chain is: against plain numpy and scipy, in other configurations, and what else it costs.

``/usr/bin/python3 benchmarks/chain.py`` prints tables and writes them to benchmarks/results. Times
are milliseconds of computing per second of sound, medians of warm blocks. On one core it is the thread's own processor
time that counts, which other programs on the machine hardly touch; both sides take turns. For two cores it is the clock
on the wall: let the machine be quiet.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

for library in ("OMP", "OPENBLAS", "MKL"):  # before numpy is imported: one core is one core
    os.environ[f"{library}_NUM_THREADS"] = "1"
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

import configurations  # noqa: E402
import numpy as np  # noqa: E402
import report  # noqa: E402
import scipy  # noqa: E402
import yardstick  # noqa: E402

import rosafe  # noqa: E402
from rosafe.dsp import kernels  # noqa: E402
from rosafe.dsp.windows import window  # noqa: E402
from rosafe.representations import STAGES  # noqa: E402
from rosafe.representations.filterbank import Filterbank  # noqa: E402

RATE = 44100
BLOCKS = (12000, 882)
FEEDERS = ("input", "preProc", "gammatone", "ihc")  # the chain goes on from these; the other three all take ihc
Steps = dict[str, Callable[[Any], Any]]


def sound(samples: int, seed: int = 0) -> np.ndarray:
    """Noise of a tenth of full scale, (2, samples) int32."""
    return (np.random.default_rng(seed).standard_normal((2, samples)) * 2e8).astype(np.int32)


def ours(rate: float, **parameters: dict[str, Any]) -> Steps:
    """A step for each stage of `rosafe`."""
    return {kind: stage(rate, **parameters.get(kind, {})).process for kind, stage in STAGES.items()}


def plain(rate: float) -> Steps:
    """The same of the yardstick."""
    frequencies = np.array(Filterbank(rate).parameters["fb_cfHz"])
    return yardstick.chain(rate, frequencies, window("hann", 2 * round(rate / 100)))


def run(steps: Steps, block: np.ndarray, kept: dict[str, Any], spent: dict[str, list[float]] | None = None) -> None:
    """One block through the chain; `kept` holds the outputs until the next ones come, as the tree does."""
    taken: Any = block
    for kind, step in steps.items():
        begin = time.thread_time()
        kept[kind] = step(taken)
        if spent is not None:
            spent.setdefault(kind, []).append(time.thread_time() - begin)
        if kind in FEEDERS:
            taken = kept[kind]


def one_core(block: int, rounds: int) -> dict[str, Any]:
    """Each stage and the whole chain, of both sides in turn: ms per second of sound, and how many times as fast."""
    sides = {"yardstick": plain(RATE), "rosafe": ours(RATE)}
    stages: dict[str, dict[str, list[float]]] = {side: {} for side in sides}
    chains: dict[str, list[float]] = {side: [] for side in sides}
    kept: dict[str, dict[str, Any]] = {side: {} for side in sides}
    signal, blocks = sound(block), max(8, round(RATE / block))
    for _ in range(rounds):
        for side, steps in sides.items():
            for number in range(blocks):
                begin = time.thread_time()
                run(steps, signal, kept[side])
                if number > 2:
                    chains[side].append(time.thread_time() - begin)
            for _ in range(blocks):
                run(steps, signal, kept[side], stages[side])
    per_second = 1000 * RATE / block
    result = {}
    for kind in (*STAGES, "chain"):
        times = [chains[side] if kind == "chain" else stages[side][kind] for side in sides]
        slow, fast = (float(np.median(spent)) * per_second for spent in times)
        result[kind] = {"yardstick": slow, "rosafe": fast, "ratio": slow / fast}
    return result


def two_cores(block: int, rounds: int, seconds: int = 10) -> dict[str, Any]:
    """The threaded tree on all outputs of `rosafe.process` against the yardstick on one core, by the wall clock."""
    signal = sound(seconds * RATE)
    steps = plain(RATE)
    kept: dict[str, Any] = {}
    times: dict[str, list[float]] = {"yardstick": [], "rosafe": []}
    for _ in range(rounds):
        begin = time.perf_counter()
        for at in range(0, 2 * RATE, block):
            run(steps, signal[:, at : at + block], kept)
        times["yardstick"].append((time.perf_counter() - begin) * 500)
        begin = time.perf_counter()
        rosafe.process(signal, RATE, block_frames=block, outputs=("ild", "ratemap", "crossCorrelation"))
        times["rosafe"].append((time.perf_counter() - begin) * 1000 / seconds)
    slow, fast = (float(np.median(spent)) for spent in times.values())
    return {"yardstick": slow, "rosafe": fast, "ratio": slow / fast}


def apart(function: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """The result of a function in a process of its own: memory that one measurement leaves speeds up the next one."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        return executor.submit(function, *arguments).result()


def machine() -> dict[str, Any]:
    """What it ran on."""
    model = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    except OSError as problem:
        model = f"{model} ({problem})"
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "kernels": kernels.status().detail.partition(";")[0],
    }


def main() -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description="Time the chain, against plain numpy and scipy too.")
    parser.add_argument("--rounds", type=int, default=7, help="how often both sides take their turn (default 7)")
    parser.add_argument("--quick", action="store_true", help="only the default chain on one core")
    parser.add_argument("--results", type=Path, default=HERE / "results", help="where to write (default %(default)s)")
    options = parser.parse_args()
    measured: dict[str, Any] = {"machine": machine()}
    measured["one core"] = {str(block): apart(one_core, block, options.rounds) for block in BLOCKS}
    if not options.quick:
        measured["two cores"] = {str(block): apart(two_cores, block, options.rounds) for block in BLOCKS}
        measured["configurations"] = configurations.measure()
        measured["small blocks (us)"] = configurations.small_blocks()
        measured["first block (s)"] = configurations.first_block()
        measured["memory (MB)"] = configurations.memory()
        measured["silence over sound"] = {
            "kernels": apart(configurations.silence, "kernels"),
            "twins": apart(configurations.silence, "twins", ("default",)),
        }
    text = report.as_markdown(measured)
    print(text)
    if not options.quick:
        options.results.mkdir(parents=True, exist_ok=True)
        (options.results / "chain.json").write_text(json.dumps(measured, indent=2) + "\n")
        (options.results / "chain.md").write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
