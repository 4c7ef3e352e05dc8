"""What two cores bring over one: the default tree on the same sound, as fast as it goes, bound to one core and to two.

``/usr/bin/python3 benchmarks/cores.py`` takes turns between the two, each turn in a process of its own, and prints
medians. It is the clock on the wall that counts: let the machine be quiet. About half of the work is cross-correlation,
and one processor's blocks come one after the other, so that twice as fast is the most that any number of cores can do.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

for library in ("OMP", "OPENBLAS", "MKL"):  # before numpy is imported: all threads are those of the tree
    os.environ[f"{library}_NUM_THREADS"] = "1"
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402

RATE = 44100
OUTPUTS = ("ild", "ratemap", "crossCorrelation")


def run(cores: list[int], block: int, seconds: float) -> float:
    """The time for a second of sound, in ms, on `cores` alone."""
    os.sched_setaffinity(0, cores)
    import rosafe

    signal = (np.random.default_rng(0).standard_normal((2, round(seconds * RATE))) * 2e8).astype(np.int32)
    rosafe.process(signal[:, : 2 * block], RATE, block_frames=block, outputs=OUTPUTS)
    begin = time.perf_counter()
    rosafe.process(signal, RATE, block_frames=block, outputs=OUTPUTS)
    return 1000 * (time.perf_counter() - begin) / seconds


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="What two cores bring over one.")
    parser.add_argument("--rounds", type=int, default=7, help="how often both take their turn (default %(default)s)")
    parser.add_argument("--seconds", type=float, default=20.0, help="of sound in each turn (default %(default)s)")
    parser.add_argument(
        "--blocks", type=int, nargs="+", default=[12000, 882], help="frames per block (default 12000 882)"
    )
    options = parser.parse_args()
    cores = sorted(os.sched_getaffinity(0))[:2]
    if len(cores) < 2:
        print("this machine has one core only", file=sys.stderr)
        return 1
    print(f"load {os.getloadavg()[0]:.1f}; ms per second of sound")
    print(f"{'':18} {'one core':>9} {'two cores':>10} {'times':>6}")
    for block in options.blocks:
        walls: dict[int, list[float]] = {1: [], 2: []}
        for _ in range(options.rounds):
            for count, found in walls.items():
                with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
                    found.append(executor.submit(run, cores[:count], block, options.seconds).result())
        one, two = (float(np.median(found)) for found in walls.values())
        print(f"blocks of {block:8d} {one:9.2f} {two:10.2f} {one / two:6.2f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
