"""Run all benchmarks and write all tables in benchmarks/results, in about half an hour on an idle machine.

``/usr/bin/python3 benchmarks/all.py`` stops on a busy machine, like each benchmark. The load is that before the first
benchmark. The exit code is 1 if a benchmark has failed.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time

import report

RUNS = (
    ("chain.py",),
    ("tricks.py",),
    ("streams.py",),
    ("everything.py",),
    ("ports.py", "--seconds", "30"),
    ("latency.py", "--messages", "400"),
    ("blocks.py",),
)


def main() -> int:
    """Run all benchmarks."""
    parser = report.arguments("Write all tables in benchmarks/results.")
    parser.add_argument("--list", action="store_true", help="only list the commands")
    options = parser.parse_args()
    commands = [[str(report.HERE / name), *rest, "--results", str(options.results)] for name, *rest in RUNS]
    if options.list:
        for command in commands:
            print(sys.executable, *command)
        return 0
    report.Report(options, "All benchmarks")
    load = os.environ.get(report.LOAD_VARIABLE) or f"{os.getloadavg()[0]:.2f}"
    failed = []
    for command in commands:
        begin = time.monotonic()
        loaded = ["--loaded"] if options.loaded else []
        done = subprocess.run(
            [sys.executable, *command, *loaded], env={**os.environ, report.LOAD_VARIABLE: load}, check=False
        )
        print(f"== {os.path.basename(command[0])}: {time.monotonic() - begin:.0f} s\n", flush=True)
        if done.returncode:
            failed.append(os.path.basename(command[0]))
    print(*(f"failed: {name}" for name in failed), sep="\n", end="\n" if failed else "")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
