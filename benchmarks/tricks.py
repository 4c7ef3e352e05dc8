"""What each trick in the kernels brings: the kernels once with it and once without, in turn.

``/usr/bin/python3 benchmarks/tricks.py`` prints the table and writes it to benchmarks/results/tricks.md, in some
minutes. A trick is taken out of a copy of the sources by replacing text, and the copy is compiled as the kernels are.
What runs is the default chain from the filterbank on (44.1 kHz, two ears, 31 channels), or a stage that is not in it,
on one core; the processor time of the thread counts, and where two cores work the clock on the wall. Each turn with a
trick stands beside one without it: the median of these ratios is what the table has.
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

for threads in ("OMP", "OPENBLAS", "MKL"):  # before numpy is imported: one core is one core
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
CHAIN = ("ild", "ratemap", "crossCorrelation")  # behind the hair cell
CHAIN_ON = {1: "the chain", 2: "the chain, through the tree on two cores"}


class Trick(NamedTuple):
    """A trick, where it is, and the texts that go when it goes."""

    text: str
    source: str
    without: tuple[tuple[str, str], ...]
    blocks: int = 882
    stage: str = ""  # by default the chain
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
TRICKS = (
    Trick(
        "25 products for 81 of every ninth sample (Toom's way, twice)",
        "correlation_blocks.c",
        (("    put_zeros(l, n + lags", "    direct(l, r, n, lags, c);\n    return;\n    put_zeros(l, n + lags"),),
    ),
    Trick(
        "the same, instead of five products for nine of every third sample",
        "correlation_blocks.c",
        (("    put_zeros(l, n + lags", SPLIT_ONCE + "    put_zeros(l, n + lags"),),
    ),
    Trick(
        "the barrier that keeps sums of lags in registers",
        "correlation_blocks.c",
        (('if (LANES < 8) __asm__ volatile("");', ""),),
    ),
    Trick(
        "several samples of all rows at a time from and to memory, instead of one",
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
    Trick(
        "filterbank: four poles at a time in registers, instead of one",
        "gammatone.c",
        (("TOGETHER = 4,", "TOGETHER = 1,"), ("if (p > 0) {", "if (p > 0 && p % 4 == 0) {")),
    ),
    Trick(
        "ILD and ratemap: four sums that do not wait for one another",
        "framed.h",
        (("CHAINS = 4 }", "CHAINS = 1 }"), ("(sum[0] + sum[1]) + (sum[2] + sum[3])", "sum[0]")),
    ),
    Trick(
        "who comes out of a kernel waits awake for the interpreter",
        "gil_handoff.c",
        (("if (replaced(0, mine)) return;", "return;"),),
        cores=2,
    ),
    Trick(
        "adaptation: sixteen rows at a time",
        "adaptation.c",
        (("ROWS = 16", "ROWS = LANES"),),
        stage="adaptation",
    ),
    Trick(
        "autocorrelation: the upper half of the input is known to be 0",
        "autocorrelation.c",
        (
            ("there_from_half(x, n, twiddles);", "there(x, n, twiddles);"),
            ("t < (points < 4 ? 2 : 1) * points", "t < 2 * points"),
        ),
        stage="autocorrelation",
    ),
    Trick(
        "autocorrelation: squares without the general power",
        "autocorrelation.c",
        (("if (exponent == 1)", "if (0)"),),
        stage="autocorrelation",
    ),
    Trick(
        "modulation: sixteen filters at a time",
        "modulation.c",
        (("FILTERS = 16 ", "FILTERS = LANES "),),
        stage="amsFeatures",
    ),
    Trick(
        "precedence: the upper half of the input is known to be 0",
        "precedence.c",
        (("size <= points && points >= 4;", "0;"),),
        stage="precedence",
    ),
    Trick(
        "gabor: two registers of frames share a weight",
        "gabor.c",
        (("TOGETHER = 2", "TOGETHER = 1"),),
        blocks=441 * 100,
        stage="gabor",
    ),
)


class Workshop(NamedTuple):
    """Where libraries are compiled, and how."""

    folder: Path
    compiler: str
    level: int

    @property
    def options(self) -> tuple[str, ...]:
        """Of the compiler, beside `build.FLAGS`; what a trick leaves behind may be of no use."""
        return ("-Wno-unused", f"-march={build.ISA_LEVELS[platform.machine()][self.level]}")

    def libraries(self, tricks: list[Trick]) -> list[Any]:
        """The library with all tricks, and without each of these."""
        objects = self.objects()
        with ThreadPoolExecutor(os.cpu_count()) as executor:
            return list(executor.map(lambda trick: self.library(trick, objects), (None, *tricks)))

    def objects(self) -> dict[str, Path]:
        """Each source with all tricks, compiled."""
        for path in sorted(build.HERE.glob("*.c")):
            command = [self.compiler, *build.FLAGS, *self.options, "-c", path, "-o", self.folder / f"{path.stem}.o"]
            subprocess.run([word for word in command if word != "-shared"], check=True)
        return {path.stem: path for path in self.folder.glob("*.o")}

    def library(self, trick: Trick | None, objects: dict[str, Path]) -> Any:
        """The library with or without a trick.

        Raises
        ------
        ValueError
            Where the sources are no longer what the trick says.
        """
        folder = Path(tempfile.mkdtemp(dir=self.folder))
        for path in build.HERE.glob("*.[ch]"):
            if path.suffix == ".h" or (
                trick and (path.name == trick.source or f'"{trick.source}"' in path.read_text())
            ):
                shutil.copy(path, folder)
        if trick is not None:
            path = folder / trick.source
            text = path.read_text()
            for old, new in trick.without:
                if old not in text:
                    raise ValueError(f"{trick.source} has no {old!r}, which {trick.text!r} is about")
                text = text.replace(old, new)
            path.write_text(text)
        unchanged = [str(path) for name, path in objects.items() if not (folder / f"{name}.c").exists()]
        if trick is not None and trick.source == "vector.h":
            unchanged = []
            for path in build.HERE.glob("*.c"):
                shutil.copy(path, folder)
        levels = {self.level: build.ISA_LEVELS[platform.machine()][self.level]}
        options = (*self.options, *unchanged)
        return loader.load(build.compile_sources(self.compiler, levels, folder, folder, options)[self.level])


@contextmanager
def using(loaded: Any) -> Iterator[None]:
    """Within this, the stages call this library."""
    before = kernels.loaded
    kernels.loaded = lambda: (loaded, loader.Status(True, "a variant"))
    try:
        yield
    finally:
        kernels.loaded = before


class Work:
    """Blocks of the default chain, or of a stage that is not in it."""

    def __init__(self, trick: Trick) -> None:
        rng = np.random.default_rng(0)
        blocks = max(2, round(24000 / trick.blocks))
        self.sound = [0.1 * rng.standard_normal((2, trick.blocks)) for _ in range(blocks)]
        self.stage = trick.stage
        self.filterbank, self.hair_cell = STAGES["gammatone"](RATE), STAGES["ihc"](RATE)
        inner = [self.hair_cell.process(self.filterbank.process(block)) for block in self.sound]
        if not self.stage:
            self.stages = [STAGES[kind](RATE) for kind in CHAIN]
        elif self.stage == "gabor":
            rate = 100.0
            self.given = [np.abs(block[..., :: round(RATE / rate)]).copy() for block in inner]
            self.stages = [STAGES[self.stage](SignalFormat(RATE, rate, True, 441, 882))]
        else:
            self.given = inner
            self.stages = [STAGES[self.stage](RATE)]

    def run(self, number: int) -> float:
        """One block; returns seconds of the thread."""
        if self.stage:
            begin = time.thread_time()
            kept: Any = self.stages[0].process(self.given[number])
            return time.thread_time() - begin
        begin = time.thread_time()
        filtered = self.filterbank.process(self.sound[number])
        inner = self.hair_cell.process(filtered)
        kept = [stage.process(inner) for stage in self.stages]
        spent = time.thread_time() - begin
        del kept
        return spent

    def turn(self, loaded: Any) -> float:
        """All blocks."""
        with using(loaded):
            return sum(self.run(number) for number in range(len(self.sound)))


class Tree:
    """The default chain through the tree, on as many cores as there are; it is the clock on the wall that counts."""

    SECONDS = 5  # of sound

    def __init__(self, trick: Trick) -> None:
        self.sound = 0.1 * np.random.default_rng(0).standard_normal((2, self.SECONDS * round(RATE)))
        self.blocks = trick.blocks

    def turn(self, loaded: Any) -> float:
        """All of it."""
        with using(loaded):
            begin = time.perf_counter()
            rosafe.process(self.sound, RATE, block_frames=self.blocks, outputs=CHAIN)
            return time.perf_counter() - begin


def measure(work: Work | Tree, with_it: Any, without: Any, rounds: int) -> float:
    """What a trick brings, as a share of the time with it."""
    work.turn(without), work.turn(with_it)
    ratios = []
    for number in range(rounds):
        if number % 2:
            ratios.append(1 / (work.turn(with_it) / work.turn(without)))
        else:
            ratios.append(work.turn(without) / work.turn(with_it))
    return float(np.median(ratios)) - 1


def main() -> int:
    """Compile, measure, print, write."""
    parser = report.arguments("Time the kernels with and without each of their tricks.")
    parser.add_argument("--rounds", type=int, default=25, help="turns of each side (default %(default)s)")
    parser.add_argument("--only", default="", metavar="TEXT", help="the tricks whose line has this; writes nothing")
    parser.add_argument("--compiler", default="gcc", help="as one types it (default %(default)s)")
    parser.epilog = "example: /usr/bin/python3 benchmarks/tricks.py --rounds 50 --only Toom"
    options = parser.parse_args()
    tricks = [trick for trick in TRICKS if options.only in f"{trick.text} {trick.source} {trick.stage}"]
    if options.rounds < 1 or not tricks:
        parser.error("no rounds" if tricks else f"no trick has {options.only!r} in its line")
    if shutil.which(options.compiler) is None:
        parser.error(f"there is no compiler {options.compiler!r} here")
    if not kernels.status().compiled:
        sys.exit(f"tricks.py: there are no kernels here: {kernels.status().detail}")
    page = report.Report(options, "What each trick in the kernels brings")
    page.say(f"* compiler: {options.compiler}; the kernels in use are {kernels.status().detail.partition(';')[0]}")
    page.say()
    page.say("How much more time the default chain takes without it, or a stage that is not in the chain.")
    page.say()
    best = loader.load(min(build.libraries().items())[1]).rosafe_processor_level()
    levels = [level for level in build.libraries() if best >= level >= min(best, 3)]  # SSE is nobody's any more
    names = [build.ISA_LEVELS[platform.machine()][level] for level in levels]
    shares: dict[Trick, list[str]] = {trick: [] for trick in tricks}
    with tempfile.TemporaryDirectory(prefix="tricks.") as scratch:
        for level, name in zip(levels, names, strict=True):
            folder = Path(scratch) / name
            folder.mkdir()
            with_all, *variants = Workshop(folder, options.compiler, level).libraries(tricks)
            cores = os.sched_getaffinity(0)
            for trick, variant in zip(tricks, variants, strict=True):
                os.sched_setaffinity(0, sorted(cores)[-trick.cores :])
                work = Tree(trick) if trick.cores > 1 else Work(trick)
                share = measure(work, with_all, variant, options.rounds)
                shares[trick].append(f"{share:.1%}")
                print(f"{name} {share:7.1%}  {trick.text}", file=sys.stderr)
            os.sched_setaffinity(0, cores)
    rows = [
        [trick.text, trick.source, str(trick.blocks), trick.stage or CHAIN_ON[trick.cores], *found]
        for trick, found in shares.items()
    ]
    page.table(["trick", "in", "blocks of", "of", *names], rows)
    if not options.only:
        page.write("tricks.md")
    return 0


if __name__ == "__main__":
    sys.exit(main())
