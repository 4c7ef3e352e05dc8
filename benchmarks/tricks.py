"""Effect of each optimisation in the kernels: the kernels with and without it, in turn.

``/usr/bin/python3 benchmarks/tricks.py`` prints a table and writes it to benchmarks/results/tricks.md, in a few
minutes. An optimisation is removed from a copy of the sources by replacing text, and the copy is compiled like the
kernels. The workload is the default chain from the filterbank on (44.1 kHz, two ears, 31 channels), or a stage that is
not part of the chain, on one core, in processor time of the thread; on two cores in wall-clock time. Runs with and
without an optimisation alternate. The table has the median of their ratios.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

for threads in ("OMP", "OPENBLAS", "MKL"):  # before the import of numpy, so that it uses one core
    os.environ[f"{threads}_NUM_THREADS"] = "1"
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

import numpy as np  # noqa: E402
import report  # noqa: E402

import rosafe  # noqa: E402
from rosafe.dsp import kernels  # noqa: E402
from rosafe.dsp.kernels import build, loader  # noqa: E402
from rosafe.dsp.signal_format import SignalFormat  # noqa: E402
from rosafe.representations import STAGES  # noqa: E402

RATE = 44100.0
CHAIN = ("ild", "ratemap", "crossCorrelation")  # the stages after the hair cell
CHAIN_ON = {1: "the chain", 2: "the chain, through the tree on two cores"}


class Optimisation(NamedTuple):
    """An optimisation: a description, its source file, and the replacements that remove it."""

    text: str
    source: str
    without: tuple[tuple[str, str], ...]
    blocks: int = 882
    stage: str = ""  # empty for the chain
    cores: int = 1


SPLIT_ONCE = """
    const int64_t third = (n + WAYS - 1) / WAYS, third_lags = (lags + WAYS - 1) / WAYS;
    vec l_thirds[POINTS][(SPAN + MAX_LAGS) / WAYS + APART], r_thirds[POINTS][SPAN / WAYS + APART];
    vec once[POINTS][MAX_LAGS / WAYS + APART];
    put_zeros(l, n + lags - 1, WAYS * (third + third_lags));
    put_zeros(r, n, WAYS * third);
    for (int64_t t = 0; t < third + third_lags - 1; t++)
        UNROLL for (int k = 0; k < POINTS; k++) l_thirds[k][t] = third_of_l(k, l + WAYS * t);
    for (int64_t t = 0; t < third; t++)
        UNROLL for (int k = 0; k < POINTS; k++) r_thirds[k][t] = third_of_r(k, r + WAYS * t);
    for (int k = 0; k < POINTS; k++) direct(l_thirds[k], r_thirds[k], third, third_lags, once[k]);
    for (int64_t m = 0; m < third_lags; m++) {
        vec five[POINTS];
        UNROLL for (int k = 0; k < POINTS; k++) five[k] = once[k][m];
        combine(five, c + WAYS * m);
    }
    return;
"""
OPTIMISATIONS = (
    Optimisation(
        "25 instead of 81 products for every ninth sample (Toom's method, twice)",
        "correlation_blocks.c",
        (("    put_zeros(l, n + lags", "    direct(l, r, n, lags, c);\n    return;\n    put_zeros(l, n + lags"),),
    ),
    Optimisation(
        "the same, compared with five instead of nine products for every third sample",
        "correlation_blocks.c",
        (("    put_zeros(l, n + lags", SPLIT_ONCE + "    put_zeros(l, n + lags"),),
    ),
    Optimisation(
        "a compiler barrier that keeps sums of lags in registers",
        "correlation_blocks.c",
        (('if (LANES < 8) __asm__ volatile("");', ""),),
    ),
    Optimisation(
        "loading and storing several samples of all rows at a time instead of one",
        "vector.h",
        (
            (
                "vec tile[TILE]) {\n#if defined __AVX2__\n    quartet row",
                "vec tile[TILE]) {\n"
                "    UNROLL for (int i = 0; i < TILE; i++) tile[i] = gathered(rows, t + i);\n    return;\n"
                "#if defined __AVX2__\n    quartet row",
            ),
            (
                "    for (; t + TILE <= n; t += TILE) {\n        vec tile[TILE];\n        UNROLL",
                "    for (; t < 0;) {\n        vec tile[TILE];\n        UNROLL",
            ),
        ),
    ),
    Optimisation(
        "filterbank: four poles at a time in registers, instead of one",
        "gammatone.c",
        (("TOGETHER = 4,", "TOGETHER = 1,"), ("if (p > 0) {", "if (p > 0 && p % 4 == 0) {")),
    ),
    Optimisation(
        "ILD and ratemap: four independent sums",
        "framed.h",
        (("CHAINS = 4 }", "CHAINS = 1 }"), ("(sum[0] + sum[1]) + (sum[2] + sum[3])", "sum[0]")),
    ),
    Optimisation(
        "active waiting for the GIL after a kernel",
        "gil_handoff.c",
        (("if (replaced(0, mine)) return;", "return;"),),
        cores=2,
    ),
    Optimisation(
        "adaptation: sixteen rows at a time",
        "adaptation.c",
        (("ROWS = 16", "ROWS = LANES"),),
        stage="adaptation",
    ),
    Optimisation(
        "autocorrelation: no computation for the upper half of the input, which is 0",
        "autocorrelation.c",
        (
            ("there_from_half(x, n, twiddles);", "there(x, n, twiddles);"),
            ("t < (points < 4 ? 2 : 1) * points", "t < 2 * points"),
        ),
        stage="autocorrelation",
    ),
    Optimisation(
        "autocorrelation: squares without calls of pow",
        "autocorrelation.c",
        (("if (exponent == 1)", "if (0)"),),
        stage="autocorrelation",
    ),
    Optimisation(
        "modulation: sixteen filters at a time",
        "modulation.c",
        (("FILTERS = 16 ", "FILTERS = LANES "),),
        stage="amsFeatures",
    ),
    Optimisation(
        "precedence: no computation for the upper half of the input, which is 0",
        "precedence.c",
        (("size <= points && points >= 4;", "0;"),),
        stage="precedence",
    ),
    Optimisation(
        "gabor: four registers of frames, two of each ear, share a weight, instead of two",
        "gabor.c",
        (("TOGETHER = 4", "TOGETHER = 2"),),
        blocks=441 * 100,
        stage="gabor",
    ),
)


class Compilation(NamedTuple):
    """The folder, compiler and level for compiling libraries."""

    folder: Path
    compiler: str
    level: int

    @property
    def options(self) -> tuple[str, ...]:
        """Compiler options in addition to `build.FLAGS`. A removed optimisation may leave unused code."""
        return ("-Wno-unused", f"-march={build.ISA_LEVELS[platform.machine()][self.level]}")

    def libraries(self, optimisations: list[Optimisation]) -> list[Any]:
        """Return the library with all optimisations, and the libraries without each of `optimisations`."""
        objects = self.objects()
        with ThreadPoolExecutor(os.cpu_count()) as executor:
            return list(executor.map(lambda optimisation: self.library(optimisation, objects), (None, *optimisations)))

    def objects(self) -> dict[str, Path]:
        """Compile each source with all optimisations."""
        for path in sorted(build.HERE.glob("*.c")):
            command = [self.compiler, *build.FLAGS, *self.options, "-c", path, "-o", self.folder / f"{path.stem}.o"]
            subprocess.run([word for word in command if word != "-shared"], check=True)
        return {path.stem: path for path in self.folder.glob("*.o")}

    def library(self, optimisation: Optimisation | None, objects: dict[str, Path]) -> Any:
        """Return the library without `optimisation`, or with all if it is None.

        Raises
        ------
        ValueError
            If the text to be replaced is not in the source file.
        """
        folder = Path(tempfile.mkdtemp(dir=self.folder))
        for path in build.HERE.glob("*.[ch]"):
            if path.suffix == ".h" or (
                optimisation and (path.name == optimisation.source or f'"{optimisation.source}"' in path.read_text())
            ):
                shutil.copy(path, folder)
        if optimisation is not None:
            path = folder / optimisation.source
            text = path.read_text()
            for old, new in optimisation.without:
                if old not in text:
                    raise ValueError(f"{optimisation.source}: expected {old!r} for {optimisation.text!r}")
                text = text.replace(old, new)
            path.write_text(text)
        unchanged = [str(path) for name, path in objects.items() if not (folder / f"{name}.c").exists()]
        if optimisation is not None and optimisation.source == "vector.h":
            unchanged = []
            for path in build.HERE.glob("*.c"):
                shutil.copy(path, folder)
        levels = {self.level: build.ISA_LEVELS[platform.machine()][self.level]}
        options = (*self.options, *unchanged)
        return loader.load(build.compile_sources(self.compiler, levels, folder, folder, options)[self.level])


@contextmanager
def using(loaded: Any) -> Iterator[None]:
    """Make the stages call this library within the context."""
    before = kernels.loaded
    kernels.loaded = lambda: (loaded, loader.Status(True, "a variant"))
    try:
        yield
    finally:
        kernels.loaded = before


class StageWorkload:
    """Blocks of the default chain, or of a stage that is not part of it."""

    def __init__(self, optimisation: Optimisation) -> None:
        rng = np.random.default_rng(0)
        blocks = max(2, round(24000 / optimisation.blocks))
        self.sound = [0.1 * rng.standard_normal((2, optimisation.blocks)) for _ in range(blocks)]
        self.stage = optimisation.stage
        self.filterbank, self.hair_cell = STAGES["gammatone"](RATE), STAGES["ihc"](RATE)
        inner = [self.hair_cell.process(self.filterbank.process(block)) for block in self.sound]
        if not self.stage:
            self.stages = [STAGES[kind](RATE) for kind in CHAIN]
        elif self.stage == "gabor":
            rate = 100.0
            self.inputs = [np.abs(block[..., :: round(RATE / rate)]).copy() for block in inner]
            self.stages = [STAGES[self.stage](SignalFormat(RATE, rate, True, 441, 882))]
        else:
            self.inputs = inner
            self.stages = [STAGES[self.stage](RATE)]

    def run(self, number: int) -> float:
        """Compute one block; return the seconds of the thread."""
        if self.stage:
            begin = time.thread_time()
            kept: Any = self.stages[0].process(self.inputs[number])
            return time.thread_time() - begin
        begin = time.thread_time()
        filtered = self.filterbank.process(self.sound[number])
        inner = self.hair_cell.process(filtered)
        kept = [stage.process(inner) for stage in self.stages]
        spent = time.thread_time() - begin
        del kept
        return spent

    def turn(self, loaded: Any) -> float:
        """Compute all blocks; return the seconds."""
        with using(loaded):
            return sum(self.run(number) for number in range(len(self.sound)))


class TreeWorkload:
    """The default chain through the tree, on all cores, in wall-clock time."""

    SECONDS = 5  # length of the sound

    def __init__(self, optimisation: Optimisation) -> None:
        self.sound = 0.1 * np.random.default_rng(0).standard_normal((2, self.SECONDS * round(RATE)))
        self.blocks = optimisation.blocks

    def turn(self, loaded: Any) -> float:
        """Process the sound; return the seconds."""
        with using(loaded):
            begin = time.perf_counter()
            rosafe.process(self.sound, RATE, block_frames=self.blocks, outputs=CHAIN)
            return time.perf_counter() - begin


def measure(work: StageWorkload | TreeWorkload, optimised: Any, without: Any, rounds: int) -> float:
    """Return the additional time without an optimisation, relative to the time with it."""
    work.turn(without), work.turn(optimised)
    ratios = []
    for number in range(rounds):
        if number % 2:
            ratios.append(1 / (work.turn(optimised) / work.turn(without)))
        else:
            ratios.append(work.turn(without) / work.turn(optimised))
    return float(np.median(ratios)) - 1


def main() -> int:
    """Compile, measure, print and write."""
    parser = report.arguments("Time the kernels with and without each of their optimisations.")
    parser.add_argument("--rounds", type=int, default=25, help="number of turns (default %(default)s)")
    parser.add_argument(
        "--only", default="", metavar="TEXT", help="only optimisations whose row contains TEXT, without writing files"
    )
    parser.add_argument("--compiler", default="gcc", help="command of the compiler (default %(default)s)")
    parser.epilog = "example: /usr/bin/python3 benchmarks/tricks.py --rounds 50 --only Toom"
    options = parser.parse_args()
    chosen = [entry for entry in OPTIMISATIONS if options.only in f"{entry.text} {entry.source} {entry.stage}"]
    if options.rounds < 1:
        parser.error("--rounds: expected at least 1")
    if not chosen:
        parser.error(f"--only: no row contains {options.only!r}")
    if shutil.which(options.compiler) is None:
        parser.error(f"--compiler: {options.compiler!r} not found")
    if not kernels.status().compiled:
        sys.exit(f"tricks.py: kernels are not used: {kernels.status().detail}")
    page = report.Report(options, "Optimisations in the kernels")
    page.say(f"* compiler: {options.compiler}; the kernels in use are {kernels.status().detail.partition(';')[0]}")
    page.say()
    page.say("Additional time of the default chain, or of a stage that is not part of it, without an optimisation.")
    page.say()
    best = loader.load(min(build.libraries().items())[1]).rosafe_processor_level()
    levels = [level for level in build.libraries() if best >= level >= min(best, 3)]  # nearly all processors have AVX2
    names = [build.ISA_LEVELS[platform.machine()][level] for level in levels]
    shares: dict[Optimisation, list[str]] = {optimisation: [] for optimisation in chosen}
    with tempfile.TemporaryDirectory(prefix="tricks.") as scratch:
        for level, name in zip(levels, names, strict=True):
            folder = Path(scratch) / name
            folder.mkdir()
            with_all, *variants = Compilation(folder, options.compiler, level).libraries(chosen)
            cores = os.sched_getaffinity(0)
            for optimisation, variant in zip(chosen, variants, strict=True):
                os.sched_setaffinity(0, sorted(cores)[-optimisation.cores :])
                work = TreeWorkload(optimisation) if optimisation.cores > 1 else StageWorkload(optimisation)
                share = measure(work, with_all, variant, options.rounds)
                shares[optimisation].append(f"{share:.1%}")
                print(f"{name} {share:7.1%}  {optimisation.text}", file=sys.stderr)
            os.sched_setaffinity(0, cores)
    rows = [
        [entry.text, entry.source, str(entry.blocks), entry.stage or CHAIN_ON[entry.cores], *found]
        for entry, found in shares.items()
    ]
    page.table(["optimisation", "in", "blocks of", "of", *names], rows)
    if not options.only:
        page.write("tricks.md")
    return 0


if __name__ == "__main__":
    sys.exit(main())
