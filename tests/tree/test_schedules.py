"""The real tree under every order of events with a few deviations: no block lost, doubled or reordered, no deadlock."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from rosafe.tree import processor, tree
from rosafe.tree.processor import Processor
from rosafe.tree.tree import Tree
from rosafe.tree.zone import Block

from .explorer import Scheduler, explore
from .support import Plain, use_plain_stages

pytestmark = pytest.mark.long

WALKS = 400

Scenario = Callable[[Scheduler], Callable[[], None]]


class Numbers:
    """A source of blocks that hold their number; then it ends, or waits until it is stopped."""

    sample_rate = 1000.0

    def __init__(self, scheduler: Scheduler, numbers: range, ends: bool = True) -> None:
        self.stopped = False
        self._scheduler = scheduler
        self._numbers = iter(numbers)
        self._ends = ends

    def read(self) -> tuple[np.ndarray, int] | None:
        number = next(self._numbers, None)
        if number is not None and not self.stopped:
            return np.full((2, 1), float(number)), number + 1
        if not self._ends:
            self._scheduler.until(lambda: self.stopped)
        return None

    def stop(self) -> None:
        self.stopped = True


class Log:
    """A listener that writes down what was released by whom. Only one thread runs at a time, so it needs no lock."""

    def __init__(self) -> None:
        self.numbers: dict[Processor, list[int]] = {}
        self.ends: list[Processor] = []

    def added(self, processor: Processor) -> None:
        self.numbers[processor] = []

    def executed(self, processor: Processor, seconds: float) -> None:
        pass

    def released(self, processor: Processor, block: Block) -> None:
        assert processor not in self.ends
        self.numbers[processor].append(int(block.data[0, 0]))

    def ended(self, processor: Processor) -> None:
        self.ends.append(processor)

    def assert_run(self, processor: Processor, first: int | None, last: int | None) -> None:
        """It released blocks one after the other, from `first` to `last` (None: from or to any)."""
        numbers = self.numbers[processor]
        assert processor.error is None, f"{processor!r}: {processor.error!r}"
        if numbers:
            assert numbers == list(range(numbers[0], numbers[-1] + 1)), f"{processor!r} released {numbers}"
        if first is not None:
            assert numbers[:1] == [first], f"{processor!r} released {numbers}"
        if last is not None:
            assert numbers[-1:] == [last], f"{processor!r} released {numbers}"


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Any], None]]:
    use_plain_stages(monkeypatch)

    def replace(threading: Any) -> None:
        for module in (processor, tree):
            monkeypatch.setattr(module, "threading", threading)

    yield replace


def grow(scheduler: Scheduler) -> Callable[[], None]:
    """Processors come while blocks flow: siblings, and a child's child."""
    log = Log()
    tree = Tree(log)
    root = tree.add_input("input", Numbers(scheduler, range(3)), 1, 0.0, 0.0)
    first = tree.add("preProc", "first", "input")
    below = tree.add("gammatone", "below", "first")
    second = tree.add("preProc", "second", "input")

    def check() -> None:
        log.assert_run(root, 0, 2)
        for one in (first, below, second):
            log.assert_run(one, None, 2)

    return check


def shrink(scheduler: Scheduler) -> Callable[[], None]:
    """One of two siblings goes with what is below it; its name is used again at once."""
    log = Log()
    tree = Tree(log)
    root = tree.add_input("input", Numbers(scheduler, range(2)), 1, 0.0, 0.0)
    staying = tree.add("preProc", "staying", "input")
    going = tree.add("preProc", "going", "input")
    below = tree.add("gammatone", "below", "going")
    removed = tree.remove("going")
    released = {one: list(log.numbers[one]) for one in removed}
    after = tree.add("preProc", "going", "input")

    def check() -> None:
        assert removed == [below, going] == log.ends
        log.assert_run(root, 0, 1)
        log.assert_run(staying, None, 1)
        log.assert_run(after, None, 1)
        for one in removed:
            log.assert_run(one, None, None)
            assert log.numbers[one] == released[one]

    return check


def leave(scheduler: Scheduler) -> Callable[[], None]:
    """The only child goes: the input does not wait for it."""
    log = Log()
    tree = Tree(log)
    root = tree.add_input("input", Numbers(scheduler, range(3)), 1, 0.0, 0.0)
    child = tree.add("preProc", "child", "input")
    tree.remove("child")

    def check() -> None:
        assert log.ends == [child]
        log.assert_run(root, 0, 2)
        log.assert_run(child, None, None)

    return check


def replace_input(scheduler: Scheduler) -> Callable[[], None]:
    """A new input takes over the tree: the child misses nothing of it, whatever it did for the old one."""
    log = Log()
    tree = Tree(log)
    old_source, new_source = Numbers(scheduler, range(2), ends=False), Numbers(scheduler, range(10, 13))
    old = tree.add_input("input", old_source, 1, 0.0, 0.0)
    child = tree.add("preProc", "child", "input")
    below = tree.add("gammatone", "below", "child")
    new = tree.add_input("input", new_source, 1, 0.0, 0.0)

    def check() -> None:
        assert old_source.stopped
        assert log.ends == [old]
        log.assert_run(old, None, None)
        log.assert_run(new, 10, 12)
        for one in (child, below):
            assert one.error is None
            numbers = log.numbers[one]
            before = [number for number in numbers if number < 10]
            assert before in ([], [0], [0, 1], [1]), f"{one!r} released {numbers}"
            assert numbers == [*before, 10, 11, 12], f"{one!r} released {numbers}"

    return check


def stop(scheduler: Scheduler) -> Callable[[], None]:
    """Everything ends at any moment, and the tree begins anew."""
    log = Log()
    tree = Tree(log)
    tree.add_input("input", Numbers(scheduler, range(9), ends=False), 1, 0.0, 0.0)
    tree.add("preProc", "child", "input")
    tree.stop()
    root = tree.add_input("input", Numbers(scheduler, range(2)), 1, 0.0, 0.0)
    child = tree.add("preProc", "child", "input")

    def check() -> None:
        assert len(log.ends) == 2
        log.assert_run(root, 0, 1)
        log.assert_run(child, None, 1)

    return check


def fail(scheduler: Scheduler) -> Callable[[], None]:
    """A processor fails in its second block: it goes with what is below it, the others do not notice."""
    log = Log()
    tree = Tree(log)
    root = tree.add_input("input", Numbers(scheduler, range(2)), 1, 0.0, 0.0)
    staying = tree.add("preProc", "staying", "input")
    going = tree.add("preProc", "going", "input", {"fails": True})
    scheduler.until(lambda: going in log.ends)

    def check() -> None:
        assert log.ends == [going]
        assert isinstance(going.error, ZeroDivisionError)
        assert tree.processors == [root, staying]
        log.assert_run(root, 0, 1)
        log.assert_run(staying, None, 1)

    return check


@pytest.mark.parametrize(("scenario", "delays"), [(grow, 1), (shrink, 2), (leave, 2), (replace_input, 2), (stop, 2)])
def test_any_order_of_events(scenario: Scenario, delays: int, use: Callable[[Any], None]) -> None:
    assert explore(scenario, use, delays, WALKS) > WALKS + 50


@pytest.fixture
def failing(use: Callable[[Any], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages of pre-processing that fail in their second block, where they are asked to."""

    class Failing(Plain):
        def process(self, block: np.ndarray) -> np.ndarray:
            if self.parameters.get("fails") and block[0, 0] == 1.0:
                raise ZeroDivisionError
            return block

    use_plain_stages(monkeypatch, preProc=Failing)


@pytest.fixture
def carried(monkeypatch: pytest.MonkeyPatch) -> list[Processor]:
    """All processors are carried from their second block on; who was."""
    monkeypatch.setattr(processor, "OBSERVED", 1)
    monkeypatch.setattr(processor, "SHORT", math.inf)
    went: list[Processor] = []
    cycle, ride = Processor._cycle, Processor._ride
    riding: list[Processor] = []

    def note_ride(self: Processor, parent: Processor) -> None:
        riding.append(self)
        ride(self, parent)
        riding.remove(self)

    def note_cycle(self: Processor, taken: Block) -> None:
        if self in riding:
            went.append(self)
        cycle(self, taken)

    monkeypatch.setattr(Processor, "_ride", note_ride)
    monkeypatch.setattr(Processor, "_cycle", note_cycle)
    return went


@pytest.mark.parametrize(("scenario", "delays"), [(grow, 1), (shrink, 2), (leave, 2), (replace_input, 2), (stop, 2)])
def test_any_order_of_events_where_parents_carry_their_children(
    scenario: Scenario, delays: int, use: Callable[[Any], None], carried: list[Processor]
) -> None:
    explore(scenario, use, delays, WALKS)
    assert carried


def test_a_failure_at_any_moment(use: Callable[[Any], None], failing: None) -> None:
    assert explore(fail, use, 2, WALKS) > WALKS + 50


def test_a_failure_of_a_child_that_is_carried(
    use: Callable[[Any], None], failing: None, carried: list[Processor]
) -> None:
    explore(fail, use, 2, WALKS)
    assert carried


def test_the_exploration_finds_a_token_that_comes_between(
    use: Callable[[Any], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The proof that it can fail: a parent that looks at the tokens and releases in two steps."""

    def wait_then_release(self: Processor, private: Block) -> bool:
        with self.turn:
            while not self.zone.free:
                self.turn.wait()
        with self.turn:
            self.zone.release(private)
            for child in self.children:
                child.turn.notify_all()
        return True

    monkeypatch.setattr(Processor, "_wait_release", wait_then_release)
    monkeypatch.setattr(Processor, "_release_if_free", lambda self: self.turn.notify_all())
    with pytest.raises(AssertionError, match="released while a child holds the last block"):
        explore(grow, use, 2, 0)


def test_the_exploration_finds_a_token_for_the_wrong_zone(
    use: Callable[[Any], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As above: a child that gives its block back to the parent that it has now."""

    def give_back_to_the_present_parent(self: Processor) -> None:
        with self.turn:
            if self.parent is not None:
                self.parent.zone.give_back(self)
                self.parent._release_if_free()

    monkeypatch.setattr(Processor, "_give_back", give_back_to_the_present_parent)
    with pytest.raises(AssertionError, match="released"):
        explore(replace_input, use, 0, WALKS)


def test_the_exploration_finds_a_deadlock(use: Callable[[Any], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """As above: a child that does not say that it is done."""

    def keep_silent(self: Processor) -> None:
        with self.turn:
            if self.parent is not None:
                self.parent.zone.give_back(self)

    monkeypatch.setattr(Processor, "_give_back", keep_silent)
    with pytest.raises(AssertionError, match="deadlock"):
        explore(grow, use, 0, WALKS)


def test_the_exploration_finds_a_child_that_two_threads_work_for(
    use: Callable[[Any], None], carried: list[Processor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As above: whoever carries a child does not look whether its own thread is done with the last block."""
    ride = Processor._ride

    def at_once(self: Processor, parent: Processor) -> None:
        self._working = False
        ride(self, parent)

    monkeypatch.setattr(Processor, "_ride", at_once)
    with pytest.raises(AssertionError, match=r"released|deadlock"):
        explore(grow, use, 1, WALKS)
