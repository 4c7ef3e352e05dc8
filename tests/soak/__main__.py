"""The command `scripts/soak`: rounds of faults for a number of minutes, and a check of the memory for leaks."""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from rosafe.system import option_types
from tests.harness import let_children_have_default_signals
from tests.soak import attacks, faults
from tests.soak.world import DEFAULT, LIGHT, ResourceUse, World, wait_out, world

WARM_UP_PARTS = 3  # the first of these parts of the time is the warm-up of pools and the allocator
FAULTS = {fault.__name__: fault for fault in (*faults.DURING, *attacks.ATTACKS)}
ATTACKS = {attack.__name__ for attack in attacks.ATTACKS}


def main() -> int:
    """Run the soak. Return 0 if all checks passed, otherwise 1."""
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
        except Exception as problem:  # a failed check or process, which the soak has found
            traceback.print_exc()
            print(f"soak: FAILED: {type(problem).__name__}: {problem}", file=sys.stderr)
            return 1
    print("soak: all held", flush=True)
    return 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="soak",
        description="Run a master, bass-ros, rosAFE-ros, genomixd, localizer, live page and the ROS 2 node for a long "
        "time with the faults that occur in the field (processes killed or stopped, garbage, many processors, "
        "concurrent clients, changes, subscribers that come and go) and attacks (floods, silence, wrong lengths). "
        "After each round, check that every sample on every port is correct, that no frame was lost without a reason, "
        "that other clients are answered, and that the processes do not grow.",
        epilog="examples:\n  scripts/soak --minutes 60\n  scripts/soak --minutes 10 --only a_mixed_load\n\n"
        f"faults and attacks: {', '.join(FAULTS)}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--minutes",
        type=option_types.number(0, 1e6, "a number of minutes"),
        default=10.0,
        help="duration (10); at least one round is run",
    )
    parser.add_argument("--seed", type=int, help="seed of the order of faults, to repeat a run")
    parser.add_argument("--light", action="store_true", help="use a lower sample rate and smaller numbers")
    parser.add_argument("--only", metavar="NAME", action="append", choices=FAULTS, help="run only this fault or attack")
    return parser.parse_args()


class Soak:
    """Rounds of faults in a world."""

    def __init__(self, there: World, chance: random.Random, seconds: float, only: Sequence[str] | None = None) -> None:
        self._world = there
        self._only = only
        self._chance = chance
        self._seconds = seconds
        self._begin = time.monotonic()
        self._round = 0
        self._uses: list[dict[str, ResourceUse]] = []

    def run(self) -> None:
        """Run rounds until the time is over."""
        while self._round == 0 or time.monotonic() - self._begin < self._seconds:
            self._round += 1
            self._run_round()
            self._uses.append(self._world.use_without_tree() if self._seconds else self._world.use())
            self._say(", ".join(f"{name}: {use}" for name, use in self._uses[-1].items()))
        self._check_growth()

    def _run_round(self) -> None:
        """Run all faults and attacks in random order on one stream, and then the fault that interrupts the stream."""
        names = self._only or list(FAULTS)
        with self._world.stream():
            if set(names) & ATTACKS:
                self._world.check_responsive("before the first fault")
                wait_out(2.0)  # genomixd connects to all services of a component after its first use
            for name in self._chance.sample(names, len(names)):
                self._do(name, lambda name=name: self._inflict(name))  # type: ignore[misc]
            self._say("every frame, every port, every count")
        if not self._only:
            self._do("the source dies", lambda: faults.the_source_dies_and_the_node_is_held(self._world))

    def _inflict(self, name: str) -> None:
        """Run one fault. After an attack, check that other clients are answered and that its resources are freed."""
        if name not in ATTACKS:
            FAULTS[name](self._world, self._chance)
            return
        before = self._world.use()
        self._world.slowest = 0.0, ""
        FAULTS[name](self._world, self._chance)
        self._world.check_responsive(f"after {name}")
        self._world.recovers(before)
        seconds, request = self._world.slowest
        self._say(f"    slowest answer: {seconds:.2f} s ({request})")

    def _do(self, name: str, action: Callable[[], None]) -> None:
        self._say(name.replace("_", " "))
        action()
        self._world.check_alive()

    def _say(self, text: str) -> None:
        elapsed = int(time.monotonic() - self._begin)
        print(
            f"{elapsed // 60:3d}:{elapsed % 60:02d} of {self._seconds / 60:g} min, round {self._round}: {text}",
            flush=True,
        )

    def _check_growth(self) -> None:
        """Check that no process needs more at the end than after the warm-up."""
        early, late = self._uses[len(self._uses) // WARM_UP_PARTS], self._uses[-1]
        for name, use in late.items():
            more = use.exceeds(early[name])
            assert not more, f"{name}: growing {more}: {early[name]}, then {use}"


if __name__ == "__main__":
    sys.exit(main())
