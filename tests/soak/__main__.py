"""The command `scripts/soak`: rounds of faults for as many minutes as asked for, and what must not grow meanwhile."""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from tests.harness import let_children_have_default_signals
from tests.soak import faults
from tests.soak.world import DEFAULT, LIGHT, Use, World, world

MORE_MEMORY = 64 * 2**20  # bytes that a process may have more at the end than once it was warm
MORE_THREADS = 8  # and threads, and files: clients that are just leaving
WARM = 3  # of so many parts of the time, the first is that in which pools and the allocator come to their size


def main() -> int:
    """Run; 0 where everything held, 1 where something did not."""
    options = _parse()
    let_children_have_default_signals()
    random_seed = options.seed if options.seed is not None else random.randrange(10**6)
    print(f"soak: {options.minutes:g} min, --seed {random_seed}", flush=True)
    with tempfile.TemporaryDirectory(prefix="rosafe-soak-") as folder:
        home = Path(folder)
        try:
            with world(LIGHT if options.light else DEFAULT, home) as there:
                Soak(there, random.Random(random_seed), options.minutes * 60).run()
        except KeyboardInterrupt:
            print("soak: interrupted", file=sys.stderr)
            return 130
        except Exception as problem:  # a check or a process that failed: that is what the soak is to find
            traceback.print_exc()
            print(f"soak: FAILED: {type(problem).__name__}: {problem}", file=sys.stderr)
            return 1
    print("soak: all held", flush=True)
    return 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="soak",
        description="Runs a master, bass-ros, rosAFE-ros and genomixd for long, does to them what happens in the field "
        "(processes killed or held, garbage, crowds of processors, clients all at once, changes), and checks after "
        "each round that every sample on every port is right, nothing was lost without a reason, and nothing grows.",
        epilog="example:\n  scripts/soak --minutes 60",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--minutes", type=_minutes, default=10.0, help="how long (10); at least one round is done")
    parser.add_argument("--seed", type=int, help="of the order of things, to repeat a run")
    parser.add_argument("--light", action="store_true", help="a lower sample rate, and less of everything")
    return parser.parse_args()


def _minutes(text: str) -> float:
    with suppress(ValueError):
        if 0 <= float(text) < 1e6:
            return float(text)
    raise argparse.ArgumentTypeError(f"{text!r} is no number of minutes")


class Soak:
    """Rounds of faults in a world."""

    def __init__(self, there: World, chance: random.Random, seconds: float) -> None:
        self._world = there
        self._chance = chance
        self._seconds = seconds
        self._begin = time.monotonic()
        self._round = 0
        self._uses: list[dict[str, Use]] = []

    def run(self) -> None:
        """Go round until the time is over."""
        while self._round == 0 or time.monotonic() - self._begin < self._seconds:
            self._round += 1
            self._go_round()
            self._uses.append(self._world.use())
            self._say(", ".join(f"{name}: {use}" for name, use in self._uses[-1].items()))
        self._check_growth()

    def _go_round(self) -> None:
        """The whole tree on one stream, all faults in some order; then those that break the stream."""
        with self._world.stream():
            for fault in self._chance.sample(faults.DURING, len(faults.DURING)):
                self._do(fault.__name__, lambda fault=fault: fault(self._world, self._chance))  # type: ignore[misc]
            self._say("every frame, every port, every count")
        self._do("the source dies", lambda: faults.the_source_dies_and_the_node_is_held(self._world))

    def _do(self, name: str, what: Callable[[], None]) -> None:
        self._say(name.replace("_", " "))
        what()
        self._world.alive()

    def _say(self, text: str) -> None:
        gone = int(time.monotonic() - self._begin)
        print(f"{gone // 60:3d}:{gone % 60:02d} of {self._seconds / 60:g} min, round {self._round}: {text}", flush=True)

    def _check_growth(self) -> None:
        """Nothing is more in the end than it was once it was warm."""
        early, late = self._uses[len(self._uses) // WARM], self._uses[-1]
        for name, use in late.items():
            first = early[name]
            assert use.memory <= first.memory + MORE_MEMORY, f"{name} grows: {first}, then {use}"
            assert use.threads <= first.threads + MORE_THREADS, f"{name} gathers threads: {first}, then {use}"
            assert use.files <= first.files + MORE_THREADS, f"{name} gathers files: {first}, then {use}"


if __name__ == "__main__":
    sys.exit(main())
