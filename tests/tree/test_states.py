"""The state machine without threads: all states that a small tree can reach by any order of steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rosafe.dsp.signal_format import SignalFormat
from rosafe.tree.block import Block
from rosafe.tree.states import FINAL_STATES, State, StateMachine

SIGNAL = SignalFormat.sound(1.0)
Saved = tuple[list[dict[str, Any]], dict[str, tuple[int, ...]]]
STEPS = {"": (), "compute": ("compute", "skip"), "publish": ("publish", "end_work"), "end_work": ("end_work",)}


def block(number: int) -> Block:
    return Block(number, (np.zeros((2, 0)),), 0, SIGNAL)


def record_release(one: Machine, state: State, number: int | None) -> None:
    if state is State.RELEASE and number is not None:
        one.released += (number,)


class Machine(StateMachine):
    """A processor without computation; `then` is the next step of its worker."""

    def __init__(self, name: str, parent: Machine | None) -> None:
        super().__init__(parent)
        self.name = name
        self.attached = self.woken = self.has_ended = False
        self.observers = (record_release,)
        self.then = ""
        self.seen: tuple[int, ...] = ()
        self.released: tuple[int, ...] = ()
        self.published: tuple[int, ...] = ()
        self.begins: int | None = None  # the first block that it should process; None: any

    def __str__(self) -> str:
        return self.name

    def save(self) -> dict[str, Any]:
        return {**self.__dict__, "children": tuple(self.children), "_readers": frozenset(self._readers)}

    def load(self, saved: dict[str, Any]) -> None:
        self.__dict__.update(saved)
        self.children, self._readers = list(saved["children"]), set(saved["_readers"])

    def on_ready(self) -> None:
        assert self.ready
        self.woken = True

    def on_finished(self) -> None:
        assert self.finished
        self.has_ended = True

    def fingerprint(self) -> tuple[Any, ...]:
        """Return all variables that `save` stores; a block is represented by its number."""
        current, last, unpublished, pending, following = (
            self.current_block,
            self.last_block,
            self.unpublished_block,
            self._pending_block,
            self._next_block,
        )
        return (
            *(self.state, self.busy, self.input_pending, self.attached, self.woken, self.has_ended, self.then),
            *(current and current.number, last and last.number, unpublished and unpublished.number),
            *(pending and pending.number, following and following.number),
            *(self.parent, self._block_owner, frozenset(self.children), frozenset(self._readers)),
            *(self.seen, self.released, self.published),
        )


class World:
    """An input, its possible descendants, and optionally a second input that replaces it.

    Parameters
    ----------
    parents : dict of str to str
        The parent of each name; empty for inputs.
    blocks : int
        Number of blocks of an input. The numbers of the second input begin at 10.
    called_once : bool
        Whether all blocks are available at the start, and the input is notified only then.
    fails : bool
        Whether every processor may fail.
    """

    def __init__(self, parents: dict[str, str], blocks: int, called_once: bool = False, fails: bool = False) -> None:
        self.machines: dict[str, Machine] = {}
        for name, parent in parents.items():
            self.machines[name] = Machine(name, self.machines.get(parent))
        self.coming = {name: tuple(range(first, first + blocks)) for name, first in (("root", 0), ("new", 10))}
        self.called_once, self.fails = called_once, fails
        self.numbers: dict[tuple[Any, ...], int] = {}  # by fingerprint of a machine
        self.attach(self.machines["root"])
        if called_once:
            self.call(self.machines["root"])

    def attach(self, machine: Machine) -> None:
        machine.attached = True
        if machine.parent is not None and machine.parent.last_block is not None:
            machine.begins = machine.parent.last_block.number
        machine.attach()

    def steps(self) -> list[tuple[str, str]]:
        """Return all possible next steps, each as a name and a step."""
        return [(name, step) for name, one in self.machines.items() for step in self.possible(one)]

    def possible(self, one: Machine) -> list[str]:
        above = one.parent
        if not one.attached:
            if above is None:
                return ["replace"] if self.machines["root"].state is not State.DONE else []
            return ["come"] if above.attached and not above.removed else []  # type: ignore[attr-defined]
        steps = [*STEPS[one.then]]
        if self.fails and one.then in ("compute", "publish"):
            steps.append("fail")
        if above is not None and not one.removed:
            steps.append("go")
        if above is None and not self.called_once and not one.input_pending and one.state not in FINAL_STATES:
            steps.append("call")
        if one.woken and one.ready:
            steps.append("begin")
        return steps

    def save(self) -> Saved:
        """Return the state for `load`. Machines are not copied, so that their references stay valid."""
        return [machine.save() for machine in self.machines.values()], dict(self.coming)

    def load(self, saved: Saved) -> None:
        machines, coming = saved
        for machine, its in zip(self.machines.values(), machines, strict=True):
            machine.load(its)
        self.coming = dict(coming)

    def do(self, name: str, step: str) -> None:
        getattr(self, step)(self.machines[name])

    def fingerprint(self) -> tuple[int, ...]:
        """Return a key that equal states share: the number of each machine's fingerprint."""
        numbers = self.numbers
        return tuple([numbers.setdefault(one.fingerprint(), len(numbers)) for one in self.machines.values()])

    # requests

    def come(self, one: Machine) -> None:
        self.attach(one)

    def go(self, one: Machine) -> None:
        for child in list(one.children):
            self.go(child)  # type: ignore[arg-type]
        one.remove()

    def replace(self, new: Machine) -> None:
        old = self.machines["root"]
        for child in list(old.children):
            child.move(new)
            child.begins = None  # type: ignore[attr-defined]
        for other in self.machines.values():
            if other.parent is old:
                other.parent = new
        old.remove()
        self.attach(new)

    def call(self, one: Machine) -> None:
        one.notify_input()

    # the steps of a worker, each with the lock held

    def begin(self, one: Machine) -> None:
        one.woken = False
        publishing = one.state is State.RELEASE
        assert one.begin_work()
        if publishing:
            one.then = "publish"
            return
        if one.parent is None and self.coming[one.name]:
            first, *rest = self.coming[one.name]
            self.coming[one.name] = tuple(rest)
            one.accept_input_block(block(first))
        elif one.parent is None:
            one.end_of_stream()
            one.then = "end_work"
            return
        assert one.current_block is not None
        assert one.seen or one.begins in (one.current_block.number, None)
        one.seen += (one.current_block.number,)
        one.then = "compute"

    def compute(self, one: Machine) -> None:
        assert one.current_block is not None
        one.finish_block(block(one.current_block.number))
        one.then = "end_work" if one.unpublished_block is None else "publish"

    def skip(self, one: Machine) -> None:
        """Discard a block that the stage cannot process."""
        one.finish_block(None)
        one.then = "end_work"

    def fail(self, one: Machine) -> None:
        """Fail, possibly after the computation, when the block cannot be published."""
        one.end_of_stream()
        one.then = "end_work"

    def publish(self, one: Machine) -> None:
        if one.unpublished_block is not None:
            if not one.removed:
                one.published += (one.unpublished_block.number,)
            one.unpublished_block = None
        one.then = "end_work"

    def end_work(self, one: Machine) -> None:
        """End the work, possibly before the block is published, which another worker may do."""
        one.then = ""
        one.end_work()

    # invariants

    def check(self) -> None:
        """Check the invariants of every state."""
        for one in self.machines.values():
            for first in (0, 10) if one.parent is not None else ():
                released = self.released(one, range(first, first + 10))
                seen = [n for n in one.seen if n in range(first, first + 10)]
                assert not seen or seen == released[released.index(seen[0]) :][: len(seen)], (
                    f"{one.name} saw {one.seen}"
                )
            assert one.published == one.released[: len(one.published)], (
                f"{one.name} published {one.published} of {one.released}"
            )
            if one.ready:
                assert one.woken, f"{one.name} is ready without a call of on_ready"
            reading = one._block_owner
            if reading is not None and not reading.removed and not one.removed:
                assert one.current_block is reading.last_block, "a block changed under its reader"
            assert one.has_ended == (one.attached and one.finished), (
                f"{one.name} is finished without a call of on_finished"
            )
            assert (one.parent is None) or (one in one.parent.children) == (
                one.attached and not one.removed and not one.parent.removed
            )

    def released(self, child: Machine, numbers: range) -> list[int]:
        """Return which of these numbers its parent, or a previous input, has released."""
        parents = {child.parent}
        if child.parent is self.machines.get("new"):
            parents.add(self.machines["root"])
        return sorted(n for parent in parents for n in parent.released if n in numbers)  # type: ignore[union-attr]

    def check_end(self) -> None:
        """Check a state in which only requests to add or remove processors are possible."""
        replaced = self.machines["root"].removed
        for one in self.machines.values():
            if one.attached and not one.removed:
                assert one.finished and one.state is State.DONE, f"{one.name} waits forever"
                assert not one._readers
                assert one.unpublished_block is None or self.fails
                if one.parent is not None and one.begins is not None and not replaced:
                    all_seen = one.seen[-1:] == one.parent.released[-1:]  # type: ignore[attr-defined]
                    assert all_seen or self.fails


def explore(world: World) -> tuple[int, int]:
    """Visit all states. Return their number, and the number of those in which only requests are possible."""
    known = {world.fingerprint()}
    unexplored = [world.save()]
    ends = 0
    while unexplored:
        saved = unexplored.pop()
        world.load(saved)
        steps = world.steps()
        if all(step in ("come", "go", "replace") for _, step in steps):
            world.check_end()
            ends += 1
        for name, step in steps:
            world.load(saved)
            world.do(name, step)
            mark = world.fingerprint()
            if mark not in known:
                world.check()
                known.add(mark)
                unexplored.append(world.save())
    return len(known), ends


CHILD = {"root": "", "a": "root"}
GRANDCHILD = {**CHILD, "c": "a"}
SIBLINGS = {**CHILD, "b": "root"}
ANOTHER_INPUT = {"root": "", "new": "", "a": "root"}


@pytest.mark.parametrize(
    ("parents", "blocks", "min_states"),
    [
        (CHILD, 3, 4_000),
        (ANOTHER_INPUT, 1, 6_000),
        pytest.param(GRANDCHILD, 2, 14_000, marks=pytest.mark.long),
        pytest.param(SIBLINGS, 2, 50_000, marks=pytest.mark.exploration),
        pytest.param({**SIBLINGS, "c": "a"}, 1, 30_000, marks=pytest.mark.exploration),
        pytest.param(ANOTHER_INPUT, 2, 150_000, marks=(pytest.mark.exploration, pytest.mark.timeout(900))),
    ],
)
def test_every_order_of_steps(parents: dict[str, str], blocks: int, min_states: int) -> None:
    """Each processor gets consecutive blocks of its parent, none waits forever, and each ready one was reported."""
    states, ends = explore(World(parents, blocks))
    assert states > min_states
    assert ends > 50


def test_all_blocks_may_be_available_at_the_start() -> None:
    explore(World(CHILD, 3, called_once=True))


def test_each_processor_may_fail() -> None:
    """A failed processor ends immediately, and its children end after their last block."""
    explore(World(CHILD, 2, fails=True))
    explore(World(GRANDCHILD, 1, called_once=True, fails=True))
