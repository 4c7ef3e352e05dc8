"""What all benchmarks have in common: the load that they begin with, tables, and the files that they write."""

from __future__ import annotations

import argparse
import os
import platform
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
BUSY = 0.5  # processes on average that want a core; a machine that has more to do is not quiet
BEFORE = "ROSAFE_BENCHMARK_LOAD"  # environment variable: the load before benchmarks/all.py began, whose own work counts


def arguments(description: str) -> argparse.ArgumentParser:
    """A parser with what every benchmark takes."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--loaded", action="store_true", help=f"measure although the load is above {BUSY}")
    parser.add_argument(
        "--results", type=Path, default=RESULTS, metavar="FOLDER", help="where to write (default %(default)s)"
    )
    return parser


class Report:
    """Prints lines and keeps them for a file. The first one tells the load; on a busy machine it ends the program.

    Parameters
    ----------
    options : Namespace
        Of a parser that `arguments` has made.
    title : str
        Of the file.
    """

    def __init__(self, options: argparse.Namespace, title: str) -> None:
        name = Path(sys.argv[0]).name
        try:
            load = float(os.environ.get(BEFORE, ""))
        except ValueError:
            load = os.getloadavg()[0]
        if load > BUSY and not options.loaded:
            print(
                f"{name}: the load is {load:.2f}, above {BUSY}: wait until it is quiet, or give --loaded",
                file=sys.stderr,
            )
            sys.exit(1)
        self._folder: Path = options.results
        self._lines = [f"# {title}", "", f"By benchmarks/{name}.", ""]
        loud = f", above {BUSY}: measured with --loaded, so take the numbers with care" if load > BUSY else ""
        self.say(f"* load before: {load:.2f}{loud}")
        self.say(f"* machine: {processor()}, {len(os.sched_getaffinity(0))} cores, Python {platform.python_version()}")
        self.say()

    def say(self, line: str = "") -> None:
        """A line for both."""
        print(line, flush=True)
        self._lines.append(line)

    def table(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """In Markdown; numbers to the right."""
        self.say("| " + " | ".join(head) + " |")
        self.say("|" + "|".join(["---"] + ["--:"] * (len(head) - 1)) + "|")
        for row in rows:
            self.say("| " + " | ".join(row) + " |")
        self.say()

    def write(self, file: str) -> None:
        """All of it into this file of the results."""
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / file).write_text("\n".join(self._lines).rstrip() + "\n", "utf-8")


def processor() -> str:
    """What it runs on."""
    try:
        for line in Path("/proc/cpuinfo").read_text("utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
