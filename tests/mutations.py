"""Named mutations, small faults that tests must detect: `scripts/test --mutations [NAME...]`.

Each is applied to a temporary copy of the tree, in which the tests named with it run; there is one copy for each core.
A mutation survives if they pass, or if they fail without it, too.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import tomllib

ROOT = Path(__file__).resolve().parents[1]
PYTHON = "/usr/bin/python3"
TIMEOUT_SECONDS = 600  # for the tests of one mutation; a test that does not end detects it, too
PYTEST_FAILED = 1  # exit codes
TIMED_OUT = 124


class Mutation(NamedTuple):
    """A change of one place in a file, and arguments for pytest that select tests which detect it."""

    name: str
    path: str
    old: str
    new: str
    tests: str


MUTATIONS = tuple(
    Mutation(**entry) for entry in tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))["mutation"]
)


def _copy(folder: Path) -> Path:
    """Copy the tracked files and the generated ones; `../shared` is a link."""
    copy = folder / "tree"
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).exists():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name, follow_symlinks=False)
    if (ROOT / ".generated").is_dir():
        shutil.copytree(ROOT / ".generated", copy / ".generated", symlinks=True)
    if (ROOT.parent / "shared").exists():
        (folder / "shared").symlink_to(ROOT.parent / "shared")
    # Python compares the content of a source with its compiled file, so that it compiles only modified ones again.
    compiled = [PYTHON, "-m", "compileall", "-q", "--invalidation-mode", "checked-hash", "rosafe", "tests"]
    subprocess.run(compiled, cwd=copy, check=True)
    return copy


def detected_by(mutation: Mutation, copy: Path) -> str:
    """Return the first line with a failed test, or an empty string if the mutation survives."""
    path = copy / mutation.path
    original = path.read_text("utf-8")
    if original.count(mutation.old) != 1:
        raise ValueError(f"{mutation.name}: expected its old text once in {mutation.path}")
    path.write_text(original.replace(mutation.old, mutation.new), "utf-8")
    try:
        return first_failure(mutation.tests, copy)
    finally:
        path.write_text(original, "utf-8")


def first_failure(tests: str, copy: Path) -> str:
    """Run tests; return the first line with a failed one, or an empty string."""
    command = f"exec timeout -k 5 {TIMEOUT_SECONDS} {PYTHON} -m pytest -n0 -x -q -p no:cacheprovider {tests}"
    done = subprocess.run(
        ["sh", "-c", command],
        cwd=copy,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},  # compiled files are found by size and second
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode == TIMED_OUT:
        return f"no end within {TIMEOUT_SECONDS} s"
    if done.returncode not in (0, PYTEST_FAILED):  # no test has run: the mutation, or the tests named, are wrong
        raise ValueError(f"{tests}: pytest returned {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED tests", "ERROR tests"))]
    return failed[0].split(" - ")[0].partition(" ")[2] if failed else ""


def judge(mutation: Mutation, copies: queue.SimpleQueue[Path], unmodified: dict[str, str]) -> tuple[bool, str]:
    """Return whether tests detect a mutation, and its row of the table.

    `copies` has the copies that are not in use. `unmodified` has the first failure of tests without a mutation.
    """
    begin = time.monotonic()
    copy = copies.get()
    try:
        result = detected_by(mutation, copy)
        if result and mutation.tests not in unmodified:
            unmodified[mutation.tests] = first_failure(mutation.tests, copy)
        other = result and unmodified[mutation.tests]
        detected = bool(result) and not other
        if other:
            result = f"**{other} fails without the mutation, too**"
    except ValueError as problem:
        detected, result = False, "**no test has run**"
        print(problem, file=sys.stderr)
    finally:
        copies.put(copy)
    seconds = time.monotonic() - begin
    return detected, f"| {mutation.name} | {mutation.path} | {result or '**survives**'} | {seconds:.0f} |"


def main(arguments: list[str]) -> int:
    """Apply the named mutations, or all; print a table; return 1 if one survives."""
    parser = argparse.ArgumentParser(prog="scripts/test --mutations", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="names or their beginnings; all by default")
    parser.add_argument(
        "-j", "--jobs", type=int, default=os.cpu_count(), help="mutations at the same time (default: cores)"
    )
    options = parser.parse_args(arguments)
    chosen = [m for m in MUTATIONS if not options.names or m.name.startswith(tuple(options.names))]
    if not chosen or options.jobs < 1:
        parser.error(f"expected a beginning of one of {', '.join(m.name for m in MUTATIONS)}, and at least one job")
    detected = 0
    unmodified: dict[str, str] = {}
    copies: queue.SimpleQueue[Path] = queue.SimpleQueue()
    print("| mutation | file | result | s |\n|---|---|---|---|", flush=True)
    with (
        tempfile.TemporaryDirectory(prefix="rosafe-mutations.") as folder,
        concurrent.futures.ThreadPoolExecutor(options.jobs) as pool,
    ):
        for number in range(options.jobs):
            copies.put(_copy(Path(folder, str(number))))
        for passed, row in pool.map(lambda mutation: judge(mutation, copies, unmodified), chosen):
            detected += passed
            print(row, flush=True)
    print(f"\n{detected} of {len(chosen)} mutations are detected")
    return 0 if detected == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
