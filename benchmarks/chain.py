"""Speed of the chain: by hand, through the tree, on a file; compared with numpy and scipy; in other configurations.

``/usr/bin/python3 benchmarks/chain.py`` prints tables and writes them to benchmarks/results. Times are milliseconds of
computing per second of sound, medians of warm blocks. On one core they are processor time, which is nearly independent
of other programs, and all implementations take turns. On two cores they are wall-clock time, which needs an idle
machine.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

for library in ("OMP", "OPENBLAS", "MKL"):  # before the import of numpy, so that it uses one core
    os.environ[f"{library}_NUM_THREADS"] = "1"
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

import arithmetic  # noqa: E402
import configurations  # noqa: E402
import kinds  # noqa: E402
import numpy as np  # noqa: E402
import report  # noqa: E402
import scipy  # noqa: E402
import yardstick  # noqa: E402

import rosafe  # noqa: E402
from rosafe.dsp import kernels  # noqa: E402
from rosafe.dsp.windows import window  # noqa: E402
from rosafe.processing import chain  # noqa: E402
from rosafe.representations import STAGES  # noqa: E402
from rosafe.representations.gammatone import Filterbank  # noqa: E402
from rosafe.representations.registry import CORE_KINDS  # noqa: E402

RATE = 44100
BLOCKS = (12000, 882, 220)
FEEDERS = ("input", "preProc", "gammatone", "ihc")  # each is the input of the next stage; ihc that of all others
LEAVES = ("ild", "ratemap", "crossCorrelation")
SECONDS = 20  # length of the sound in each run through the tree
FILE_SECONDS = 60
Steps = dict[str, Callable[[Any], Any]]
Cost = tuple[float, float]  # wall clock and processor time, ms per second of sound


def sound(samples: int, seed: int = 0) -> np.ndarray:
    """Return noise at a tenth of full scale, (2, samples) int32."""
    return (np.random.default_rng(seed).standard_normal((2, samples)) * 2e8).astype(np.int32)


def rosafe_steps() -> Steps:
    """Return the stages of `rosafe`."""
    return {kind: STAGES[kind](RATE).process for kind in CORE_KINDS}


def reference_steps() -> Steps:
    """Return the same stages of the reference in plain numpy and scipy."""
    frequencies = np.array(Filterbank(RATE).parameters["fb_cfHz"])
    return yardstick.chain(RATE, frequencies, window("hann", 2 * round(RATE / 100)))


def run(steps: Steps, block: np.ndarray, kept: dict[str, Any], spent: dict[str, list[float]] | None = None) -> None:
    """Compute one block of the chain; `kept` holds the outputs until the next block, as the tree does."""
    data: Any = block
    for kind, step in steps.items():
        begin = time.thread_time()
        kept[kind] = step(data)
        if spent is not None:
            spent.setdefault(kind, []).append(time.thread_time() - begin)
        if kind in FEEDERS:
            data = kept[kind]


def one_core(block: int, rounds: int) -> dict[str, Any]:
    """Measure each stage and the chain of both implementations in turn: ms per second of sound, and their ratio."""
    sides = {"reference": reference_steps(), "rosafe": rosafe_steps()}
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
    for kind in (*CORE_KINDS, "chain"):
        times = [chains[side] if kind == "chain" else stages[side][kind] for side in sides]
        slow, fast = (_typical(spent) * per_second for spent in times)
        result[kind] = {"reference": slow, "rosafe": fast, "ratio": slow / fast}
    return result


def _typical(times: list[float]) -> float:
    """Return the median, or the mean if a few blocks take most of the time because the others complete no frame."""
    return float(np.median(times) if np.percentile(times, 90) < 2 * np.median(times) else np.mean(times))


# --- through the tree -------------------------------------------------------------------------------------------


def _by_hand(steps: Steps, block: int, seconds: int) -> Cost:
    signal, kept = sound(seconds * RATE), {}
    wall, spent = time.perf_counter(), time.process_time()
    for at in range(0, signal.shape[1], block):
        run(steps, signal[:, at : at + block], kept)
    return 1000 * (time.perf_counter() - wall) / seconds, 1000 * (time.process_time() - spent) / seconds


def by_reference(block: int) -> Cost:
    """Measure the reference in plain numpy and scipy, on two seconds of sound."""
    return _by_hand(reference_steps(), block, 2)


def by_hand(block: int) -> Cost:
    """Measure the stages in sequence, without the tree."""
    return _by_hand(rosafe_steps(), block, SECONDS)


def through_tree(block: int, outputs: tuple[str, ...] = LEAVES, max_bytes: int = chain.MAX_BYTES) -> Cost:
    """Measure `rosafe.process`, which combines small blocks up to `max_bytes`."""
    chain.MAX_BYTES = max_bytes
    signal = sound(SECONDS * RATE)
    wall, spent = time.perf_counter(), time.process_time()
    rosafe.process(signal, RATE, block_frames=block, outputs=outputs)
    return 1000 * (time.perf_counter() - wall) / SECONDS, 1000 * (time.process_time() - spent) / SECONDS


def one_by_one(block: int) -> Cost:
    """Measure the tree without combining blocks, as in the node."""
    return through_tree(block, max_bytes=0)


def gammatone_alone(block: int) -> Cost:
    """Measure the output of the filterbank only, in the second run: new memory would cost far more in the first one."""
    through_tree(block, ("gammatone",))
    return through_tree(block, ("gammatone",))


def _settle(cores: Collection[int] = ()) -> None:
    """Initialise a new process: bind it to `cores`, if any, and make it keep memory after use.

    A virtual machine returns memory that the C library frees to its host; new pages cost more than the filters.
    """
    if cores:
        os.sched_setaffinity(0, cores)
    library, most_maps, trim_threshold = ctypes.CDLL(None), -4, -1  # M_MMAP_MAX and M_TRIM_THRESHOLD of malloc.h
    library.mallopt(most_maps, 0)
    library.mallopt(trim_threshold, 2**31 - 1)


class BoundProcess:
    """A process that is bound to some cores."""

    def __init__(self, cores: list[int]) -> None:
        self.executor = ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_settle, initargs=(cores,))

    def run(self, function: Callable[..., Cost], *arguments: Any) -> Cost:
        """Return the result of `function` in this process."""
        return self.executor.submit(function, *arguments).result()


def through(block: int, rounds: int, cores: list[int]) -> dict[str, float]:
    """Return medians over rounds in which all variants take turns: ms per second of sound.

    The limit of two cores is the speed of two simultaneous independent runs, on one core each.
    """
    processes = [BoundProcess([core]) for core in cores]
    both, alone = (
        BoundProcess(cores),
        BoundProcess([cores[0]]),
    )  # a separate process reuses its memory for large outputs
    found: dict[str, list[float]] = {}
    for turn in range(rounds + 1):
        one = processes[0]
        now = {
            "reference": one.run(by_reference, block)[1],
            "by hand": one.run(by_hand, block)[1],
            "tree, one core": one.run(through_tree, block)[1],
            "block by block": one.run(one_by_one, block)[1],
            "gammatone only": alone.run(gammatone_alone, block)[1],
        }
        if len(cores) > 1:
            for name, function in (("tree", through_tree), ("block by block", one_by_one)):
                running = [process.executor.submit(function, block) for process in processes]
                limit = float(np.mean([each.result()[0] for each in running])) / len(cores)
                now[f"{name}, limit of two cores"] = limit
                now[f"{name}, two cores"], now[f"{name}, processor time there"] = both.run(function, block)
        for name, cost in now.items():
            if turn:  # the first turn warms up
                found.setdefault(name, []).append(cost)
    for process in (*processes, both, alone):
        process.executor.shutdown()
    medians = {name: float(np.median(costs)) for name, costs in found.items()}
    ratios = {
        "times as fast": ("reference", "tree, one core"),
        "tree over hand": ("tree, one core", "by hand"),
        "block by block over hand": ("block by block", "by hand"),
    }
    if len(cores) > 1:
        ratios["times as fast, two cores"] = ("reference", "tree, two cores")
        for name in ("tree", "block by block"):
            ratios[f"{name}, of the limit"] = (f"{name}, limit of two cores", f"{name}, two cores")
    for name, (over, under) in ratios.items():  # ratios of times measured in the same round
        medians[name] = float(np.median(np.divide(found[over], found[under])))
    return medians


def offline(rounds: int) -> dict[str, float]:
    """Measure `rosafe process` on a file of a minute, from start to end: it reads a WAV file and writes NPZ."""
    walls = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "minute.wav"
        scipy.io.wavfile.write(path, RATE, sound(FILE_SECONDS * RATE).T)
        command = [sys.executable, "-m", "rosafe.commands", "process", str(path), "-o", f"{folder}/minute.npz"]
        command += ["--outputs", ",".join(LEAVES)]
        for _ in range(rounds):
            begin = time.perf_counter()
            subprocess.run(command, cwd=HERE.parent, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            walls.append(time.perf_counter() - begin)
        size = Path(folder, "minute.npz").stat().st_size / 1e6
    return {"seconds": float(np.median(walls)), "MB": size}


def in_new_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """Run a function in a new process, because memory left by one measurement speeds up the next one."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_settle) as executor:
        return executor.submit(function, *arguments).result()


# --- tables -----------------------------------------------------------------------------------------------------


def _say_stages(page: report.Report, rounds: int) -> None:
    for block in BLOCKS:
        page.say(f"## Stage by stage on one core, blocks of {block}")
        page.say()
        found = in_new_process(one_core, block, rounds)
        if block == BLOCKS[1]:
            blockwise = found
        rows = [[k, f"{t['reference']:.2f}", f"{t['rosafe']:.2f}", f"{t['ratio']:.1f}"] for k, t in found.items()]
        page.table(["stage", "reference", "rosafe", "times as fast"], rows)
    if kernels.status().compiled:
        _say_limits(page, blockwise, rounds)


def _say_limits(page: report.Report, found: dict[str, Any], rounds: int) -> None:
    """Compare the times of the stages with the limit of their arithmetic."""
    limits = in_new_process(arithmetic.limits, RATE, rounds)
    page.say(f"## Limit of the arithmetic on one core, blocks of {BLOCKS[1]}")
    page.say()
    page.say("The products and sums of each stage, at the rate of fused products that the same core was measured to")
    page.say("execute without access to memory. Cores that compute sums beside fused products can be faster.")
    page.say()
    limits["chain"] = sum(limits.values())
    rows = [[k, f"{ms:.2f}", f"{found[k]['rosafe']:.2f}", f"{ms / found[k]['rosafe']:.2f}"] for k, ms in limits.items()]
    page.table(["stage", "limit", "rosafe", "limit over rosafe"], rows)


def _say_tree(page: report.Report, rounds: int) -> None:
    cores = sorted(os.sched_getaffinity(0))[:2]
    page.say("## Through the tree: `rosafe.process`")
    page.say()
    page.say(f"{SECONDS} s of sound to {', '.join(LEAVES)}; processor time on one core, wall-clock time on two.")
    page.say("The limit is the speed of two simultaneous runs on one core each. All variants took turns.")
    page.say(
        f"Small blocks are combined, up to {chain.MAX_BYTES >> 20} MiB of a processor's output; the numbers do not"
    )
    page.say("change. Block by block: without combining blocks, as in the node.")
    page.say()
    found = {block: through(block, rounds, cores) for block in BLOCKS}
    names = list(found[BLOCKS[0]])
    rows = [[name, *(f"{found[block][name]:.2f}" for block in BLOCKS)] for name in names]
    page.table(["", *(f"blocks of {block}" for block in BLOCKS)], rows)


def _say_offline(page: report.Report) -> None:
    found = offline(3)
    page.say("## A file of a minute")
    page.say()
    ratio = FILE_SECONDS / found["seconds"]
    page.say(f"* `rosafe process` from start to end, including reading WAV and writing {found['MB']:.0f} MB of NPZ:")
    page.say(f"  {found['seconds']:.2f} s, {1000 / ratio:.1f} ms per second of sound, {ratio:.0f} times real time")
    page.say()


def _say_kinds(page: report.Report, rounds: int) -> None:
    page.say("## The other representations, compared with plain numpy and scipy")
    page.say()
    page.say("On one core, without parents; plain is benchmarks/plain.py on the whole signal at once.")
    page.say("`differ` is the largest difference relative to the largest number, or the share of different decisions.")
    page.say()
    head, *rows = kinds.table(in_new_process(kinds.measure, rounds))
    page.table(head, rows)


def _say_configurations(page: report.Report) -> None:
    measured = in_new_process(configurations.measure)
    page.say("## Other configurations")
    page.say()
    page.say("Cost per unit of work is relative to the default configuration.")
    page.say()
    for kind, found in measured.items():
        page.say(f"{kind}: a unit of work is {configurations.UNITS[kind]}.")
        page.say()
        page.table(
            [kind, "ms", "per unit of work"],
            [[text, f"{cost['ms']:.2f}", f"{cost['per unit']:.2f}"] for text, cost in found.items()],
        )
    worst = max(cost["per unit"] for found in measured.values() for cost in found.values())
    page.say(f"The most expensive unit of work costs {worst:.2f} times as much as that of the default configuration.")
    page.say()


def _say_rest(page: report.Report) -> None:
    small = in_new_process(configurations.small_blocks)
    page.say("## Small blocks")
    page.say()
    page.say("Microseconds for one block of the given number of samples, 31 channels.")
    page.say()
    rows = [[kind, *(f"{cost:.0f}" for cost in found.values())] for kind, found in small.items()]
    page.table(["stage", *map(str, configurations.SMALL_BLOCKS)], rows)
    first, memory = configurations.first_block(), in_new_process(configurations.memory)
    page.say("## Start-up, memory, silence")
    page.say()
    page.say(f"* a new process loads in {first['load']:.2f} s; its first block takes {first['first block']:.3f} s")
    page.say(f"* between blocks the default chain holds {memory['state']:.1f} MB; a stage uses up to")
    page.say(f"  {memory['scratch']:.1f} MB more while it computes, in addition to its output")
    page.say()
    page.say("Cost of silence after sound relative to the cost of sound (the whole chain):")
    page.say()
    silence = in_new_process(configurations.silence, "kernels")
    numpy_ratios = in_new_process(configurations.silence, "numpy", ("default",))
    rows = [[name, f"{ratio:.2f}"] for name, ratio in silence.items()]
    rows += [[f"{name}, numpy and scipy", f"{ratio:.2f}"] for name, ratio in numpy_ratios.items()]
    page.table(["chain", "silence / sound"], rows)


def main() -> int:
    """Measure, print and write."""
    parser = report.arguments(
        "Time the chain: by hand, through the tree, on a file, compared with plain numpy and scipy."
    )
    parser.add_argument("--rounds", type=int, default=5, help="number of turns of all variants (default 5)")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="only the default chain, by hand and through the tree, without writing files",
    )
    options = parser.parse_args()
    page = report.Report(options, "Times of the chain")
    page.say(f"* kernels: {kernels.status().detail.partition(';')[0]}")
    page.say(f"* numpy {np.__version__}, scipy {scipy.__version__}; ms of computing per second of sound, medians")
    page.say()
    _say_tree(page, options.rounds)
    _say_stages(page, options.rounds)
    if not options.quick:
        _say_offline(page)
        _say_kinds(page, options.rounds)
        _say_configurations(page)
        _say_rest(page)
        page.write("chain.md")
    return 0


if __name__ == "__main__":
    sys.exit(main())
