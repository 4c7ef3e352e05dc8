"""Reports of benchmarks: the initial load of the machine, tables, and result files."""

from __future__ import annotations

import argparse
import os
import platform
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
MAX_LOAD = 0.5  # load average; above it, the machine is busy
LOAD_VARIABLE = "ROSAFE_BENCHMARK_LOAD"  # set by benchmarks/all.py to the load before its first benchmark


def arguments(description: str) -> argparse.ArgumentParser:
    """Return a parser with the options of every benchmark."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--loaded", action="store_true", help=f"measure even if the load is above {MAX_LOAD}")
    parser.add_argument(
        "--results",
        type=Path,
        default=RESULTS,
        metavar="FOLDER",
        help="folder of the result files (default %(default)s)",
    )
    return parser


class Report:
    """A report that is printed and written to a file. It begins with the load; on a busy machine it ends the program.

    Parameters
    ----------
    options : Namespace
        Options of a parser created by `arguments`.
    title : str
        Title of the file.
    """

    def __init__(self, options: argparse.Namespace, title: str) -> None:
        name = Path(sys.argv[0]).name
        try:
            load = float(os.environ.get(LOAD_VARIABLE, ""))
        except ValueError:
            load = os.getloadavg()[0]
        if load > MAX_LOAD and not options.loaded:
            print(
                f"{name}: the load is {load:.2f}, above {MAX_LOAD}: wait until the machine is idle, or use --loaded",
                file=sys.stderr,
            )
            sys.exit(1)
        self._folder: Path = options.results
        self._lines = [f"# {title}", "", f"By benchmarks/{name}.", ""]
        warning = f", above {MAX_LOAD}: measured with --loaded, the numbers are unreliable" if load > MAX_LOAD else ""
        self.say(f"* load before: {load:.2f}{warning}")
        self.say(f"* machine: {processor()}, {len(os.sched_getaffinity(0))} cores, Python {platform.python_version()}")
        self.say()

    def say(self, line: str = "") -> None:
        """Add a line."""
        print(line, flush=True)
        self._lines.append(line)

    def table(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """Add a table in Markdown; numbers are right-aligned."""
        self.say("| " + " | ".join(head) + " |")
        self.say("|" + "|".join(["---"] + ["--:"] * (len(head) - 1)) + "|")
        for row in rows:
            self.say("| " + " | ".join(row) + " |")
        self.say()

    def write(self, file: str) -> None:
        """Write the report to a file in the folder of results."""
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / file).write_text("\n".join(self._lines).rstrip() + "\n", "utf-8")


def processor() -> str:
    """Return the name of the processor."""
    try:
        for line in Path("/proc/cpuinfo").read_text("utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
