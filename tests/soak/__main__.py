"""The command `scripts/soak`: rounds of faults for as many minutes as asked for, and what must not grow meanwhile."""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from tests.harness import let_children_have_default_signals
from tests.soak import attacks, faults
from tests.soak.world import DEFAULT, LIGHT, Use, World, wait_out, world

WARM = 3  # of so many parts of the time, the first is that in which pools and the allocator come to their size


FAULTS = {fault.__name__: fault for fault in (*faults.DURING, *attacks.ATTACKS)}
ATTACKS = {attack.__name__ for attack in attacks.ATTACKS}


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
                Soak(there, random.Random(random_seed), options.minutes * 60, options.only).run()
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
        "(processes killed or held, garbage, crowds of processors, clients all at once, changes) and what those do who "
        "mean ill (floods, silence, lies about lengths, names that are commands), and checks after each round that "
        "every sample on every port is right, nothing was lost without a reason, everybody else is answered, and "
        "nothing grows.",
        epilog="examples:\n  scripts/soak --minutes 60\n  scripts/soak --minutes 10 --only a_mixed_load\n\n"
        f"faults and attacks: {', '.join(FAULTS)}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--minutes", type=_minutes, default=10.0, help="how long (10); at least one round is done")
    parser.add_argument("--seed", type=int, help="of the order of things, to repeat a run")
    parser.add_argument("--light", action="store_true", help="a lower sample rate, and less of everything")
    parser.add_argument(
        "--only", metavar="NAME", action="append", choices=FAULTS, help="of all that is done, only this"
    )
    return parser.parse_args()


def _minutes(text: str) -> float:
    with suppress(ValueError):
        if 0 <= float(text) < 1e6:
            return float(text)
    raise argparse.ArgumentTypeError(f"{text!r} is no number of minutes")


class Soak:
    """Rounds of faults in a world."""

    def __init__(self, there: World, chance: random.Random, seconds: float, only: Sequence[str] | None = None) -> None:
        self._world = there
        self._only = only
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
        """The whole tree on one stream, all faults and attacks in some order; then those that break the stream."""
        names = self._only or list(FAULTS)
        with self._world.stream():
            if set(names) & ATTACKS:
                self._world.unharmed("before anything happens")
                wait_out(2.0)  # genomixd connects to all that a component has, once it is used
            for name in self._chance.sample(names, len(names)):
                self._do(name, lambda name=name: self._inflict(name))  # type: ignore[misc]
            self._say("every frame, every port, every count")
        if not self._only:
            self._do("the source dies", lambda: faults.the_source_dies_and_the_node_is_held(self._world))

    def _inflict(self, name: str) -> None:
        """One fault; after an attack everybody else is answered, and nothing of it is left."""
        if name not in ATTACKS:
            FAULTS[name](self._world, self._chance)
            return
        before = self._world.use()
        self._world.slowest = 0.0, ""
        FAULTS[name](self._world, self._chance)
        self._world.unharmed(f"after {name}")
        self._world.recovers(before)
        took, what = self._world.slowest
        self._say(f"    slowest answer: {took:.2f} s ({what})")

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
            more = use.exceeds(early[name])
            assert not more, f"{name} gathers {more}: {early[name]}, then {use}"


if __name__ == "__main__":
    sys.exit(main())
