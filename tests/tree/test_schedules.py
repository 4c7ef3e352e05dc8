"""The real tree under every order of events with a few deviations: no block lost, doubled or reordered, no deadlock."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from rosafe.tree import history, parameter_updates, processor, tree, workers
from rosafe.tree.block import Block
from rosafe.tree.processor import Processor
from rosafe.tree.states import State, StateMachine
from rosafe.tree.tree import Tree
from rosafe.tree.workers import Workers

from .explorer import Scheduler, explore
from .support import Plain, use_plain_stages

pytestmark = pytest.mark.long

WALKS = 300

Check = Callable[[], None]
Scenario = Callable[[Scheduler, int], Check]


class Numbers:
    """A source of blocks that hold their number. It ends with them, or never."""

    sample_rate = 1000.0

    def __init__(self, numbers: range, ends: bool = True) -> None:
        self.ended = self.stopped = False
        self.numbers = deque(numbers)
        self.wake: Callable[[], None] = lambda: None
        self._ends = ends

    def open(self, wake: Callable[[], None]) -> None:
        self.wake = wake

    def read(self) -> tuple[np.ndarray, int] | None:
        if self.numbers and not self.stopped:
            number = self.numbers.popleft()
            return np.full((2, 1), float(number)), number + 1
        self.ended = self.ended or self._ends
        return None

    def stop(self) -> None:
        self.stopped = self.ended = True


class Log:
    """A listener that writes down what was released by whom. Only one thread runs at a time, so it needs no lock."""

    def __init__(self) -> None:
        self.numbers: dict[Processor, list[int]] = {}
        self.ends: list[Processor] = []

    def on_added(self, processor: Processor) -> None:
        self.numbers[processor] = []

    def on_executed(self, processor: Processor, seconds: float) -> None:
        pass

    def on_released(self, processor: Processor, block: Block) -> None:
        assert processor not in self.ends
        self.numbers[processor].append(int(block.data[0, 0]))

    def on_removed(self, processor: Processor) -> None:
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


def use(patch: pytest.MonkeyPatch, threading: Any) -> None:
    """Let the tree's code take locks and threads from there."""
    for module in (parameter_updates, history, processor, tree, workers):
        patch.setattr(module, "threading", threading)


def run_to_the_end(tree: Tree) -> None:
    """Wait until all processors have come to their end, then until no thread is left."""
    for one in tree.processors:
        one.join()
    end(tree)


def end(tree: Tree) -> None:
    tree.stop()
    tree.join()


# --- scenarios ---


def grow(scheduler: Scheduler, count: int) -> Check:
    """Processors come while blocks flow: siblings, and a child's child."""
    log = Log()
    tree = Tree(log, count)
    root = tree.add_input("input", Numbers(range(3)), 1, 0.0, 0.0)
    first = tree.add("preProc", "first", "input")
    below = tree.add("gammatone", "below", "first")
    second = tree.add("preProc", "second", "input")
    run_to_the_end(tree)

    def check() -> None:
        log.assert_run(root, 0, 2)
        for one in (first, below, second):
            log.assert_run(one, None, 2)

    return check


def hear(scheduler: Scheduler, count: int) -> Check:
    """Blocks come one by one from a thread of their own, which wakes the tree each time."""
    log = Log()
    tree = Tree(log, count)
    source = Numbers(range(0), ends=False)
    root = tree.add_input("input", source, 1, 0.0, 0.0)
    child = tree.add("preProc", "child", "input")

    def play() -> None:
        for number in range(3):
            source.numbers.append(number)
            source.wake()
        source.ended = True
        source.wake()

    player = scheduler.threading.Thread(play, "player")
    player.start()
    player.join()
    run_to_the_end(tree)

    def check() -> None:
        log.assert_run(root, 0, 2)
        log.assert_run(child, 0, 2)

    return check


def pass_on(scheduler: Scheduler, count: int) -> Check:
    """Nobody hears of the input and of one below it; what hangs on them misses nothing."""
    log = Log()
    tree = Tree(log, count)
    source = Numbers(range(0), ends=False)
    root = tree.add_input("input", source, 1, 0.0, 0.0)
    middle = tree.add("preProc", "middle", "input")
    below = tree.add("gammatone", "below", "middle")
    root.has_consumers = middle.has_consumers = False
    source.numbers.extend(range(3))
    source.wake()
    source.ended = True
    source.wake()
    run_to_the_end(tree)

    def check() -> None:
        assert log.numbers[root] == log.numbers[middle] == []
        log.assert_run(below, 0, 2)

    return check


def shrink(scheduler: Scheduler, count: int) -> Check:
    """One of two siblings goes with what is below it; its name is used again at once."""
    log = Log()
    tree = Tree(log, count)
    root = tree.add_input("input", Numbers(range(2)), 1, 0.0, 0.0)
    staying = tree.add("preProc", "staying", "input")
    going = tree.add("preProc", "going", "input")
    below = tree.add("gammatone", "below", "going")
    removed = tree.remove("going")
    released = {one: list(log.numbers[one]) for one in removed}
    after = tree.add("preProc", "going", "input")
    run_to_the_end(tree)

    def check() -> None:
        assert removed == [below, going] == log.ends[:2]
        log.assert_run(root, 0, 1)
        log.assert_run(staying, None, 1)
        log.assert_run(after, None, 1)
        for one in removed:
            log.assert_run(one, None, None)
            assert log.numbers[one] == released[one]

    return check


def leave(scheduler: Scheduler, count: int) -> Check:
    """The only child goes: the input does not wait for it."""
    log = Log()
    tree = Tree(log, count)
    root = tree.add_input("input", Numbers(range(3)), 1, 0.0, 0.0)
    child = tree.add("preProc", "child", "input")
    tree.remove("child")
    run_to_the_end(tree)

    def check() -> None:
        assert log.ends == [child, root]
        log.assert_run(root, 0, 2)
        log.assert_run(child, None, None)

    return check


def replace_input(scheduler: Scheduler, count: int) -> Check:
    """A new input takes over the tree: the child misses nothing of it, whatever it did for the old one."""
    log = Log()
    tree = Tree(log, count)
    old_source, new_source = Numbers(range(2), ends=False), Numbers(range(10, 13))
    old = tree.add_input("input", old_source, 1, 0.0, 0.0)
    child = tree.add("preProc", "child", "input")
    below = tree.add("gammatone", "below", "child")
    new = tree.add_input("input", new_source, 1, 0.0, 0.0)
    run_to_the_end(tree)

    def check() -> None:
        assert old_source.stopped
        assert log.ends[0] is old
        log.assert_run(old, None, None)
        log.assert_run(new, 10, 12)
        for one in (child, below):
            assert one.error is None
            numbers = log.numbers[one]
            before = [number for number in numbers if number < 10]
            assert before in ([], [0], [0, 1], [1]), f"{one!r} released {numbers}"
            assert numbers == [*before, 10, 11, 12], f"{one!r} released {numbers}"

    return check


def stop(scheduler: Scheduler, count: int) -> Check:
    """Everything ends at any moment, and the tree begins anew."""
    log = Log()
    tree = Tree(log, count)
    tree.add_input("input", Numbers(range(9), ends=False), 1, 0.0, 0.0)
    tree.add("preProc", "child", "input")
    tree.stop()
    root = tree.add_input("input", Numbers(range(2)), 1, 0.0, 0.0)
    child = tree.add("preProc", "child", "input")
    run_to_the_end(tree)

    def check() -> None:
        assert len(log.ends) == 4
        log.assert_run(root, 0, 1)
        log.assert_run(child, None, 1)

    return check


def fail(scheduler: Scheduler, count: int) -> Check:
    """A processor fails in its second block: it goes with what is below it, the others do not notice."""
    log = Log()
    tree = Tree(log, count)
    root = tree.add_input("input", Numbers(range(2)), 1, 0.0, 0.0)
    staying = tree.add("preProc", "staying", "input")
    going = tree.add("preProc", "going", "input", {"fails": True})
    scheduler.until(lambda: going in log.ends)
    left = tree.processors
    run_to_the_end(tree)

    def check() -> None:
        assert log.ends[0] is going
        assert isinstance(going.error, ZeroDivisionError)
        assert left == [root, staying]
        log.assert_run(root, 0, 1)
        log.assert_run(staying, None, 1)

    return check


class Failing(Plain):
    """Fails in its second block, where it is asked to."""

    def process(self, block: np.ndarray, extra: np.ndarray | None = None, out: np.ndarray | None = None) -> np.ndarray:
        if self.parameters.get("fails") and block[0, 0] == 1.0:
            raise ZeroDivisionError
        return block


# --- they hold ---


@pytest.fixture(autouse=True)
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    use_plain_stages(monkeypatch, preProc=Failing)
    monkeypatch.setattr(workers, "WAKE_THRESHOLD_SECONDS", 0.0)


def go(patch: pytest.MonkeyPatch, scenario: Scenario, count: int, delays: int, walks: int) -> int:
    def run(scheduler: Scheduler) -> Check:
        return scenario(scheduler, count)

    return explore(run, partial(use, patch), delays, walks)


@pytest.mark.parametrize("telling", [0.0, math.inf])
@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize(
    ("scenario", "delays"),
    [(grow, 1), (hear, 1), (pass_on, 1), (shrink, 2), (leave, 2), (replace_input, 1), (stop, 2), (fail, 2)],
)
def test_any_order_of_events(
    scenario: Scenario, delays: int, count: int, telling: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other workers are called whenever there is something to do; the world is told at once, or later."""
    monkeypatch.setattr(processor, "WAKE_THRESHOLD_SECONDS", telling)
    assert go(monkeypatch, scenario, count, delays, WALKS) > WALKS + 15


@pytest.mark.parametrize("scenario", [grow, hear, shrink, replace_input])
def test_any_order_of_events_where_calls_are_rare(scenario: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "WAKE_THRESHOLD_SECONDS", math.inf)
    assert go(monkeypatch, scenario, 2, 1, WALKS) > WALKS + 15


# --- and it is found where they do not ---


def test_the_exploration_finds_a_parent_that_does_not_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """It releases while a child holds the last block, or has not taken it."""
    done = StateMachine.finish_block

    def release_anyway(self: StateMachine, private: Block | None) -> None:
        self._readers.clear()
        done(self, private)

    monkeypatch.setattr(StateMachine, "finish_block", release_anyway)
    with pytest.raises(AssertionError, match="released"):
        go(monkeypatch, grow, 2, 1, WALKS)


def test_the_exploration_finds_a_look_at_tokens_that_is_out_of_date(monkeypatch: pytest.MonkeyPatch) -> None:
    """A child that looks whether there is a token, and takes it later: there may be another one meanwhile."""

    def take_later(self: Processor) -> bool:
        if not self.ready:
            return False
        self.busy = True
        self.current_block = self._next_block
        self._lock.release()
        self._lock.acquire()
        self.input_pending, self._next_block, self._block_owner = False, None, self.parent
        if self.current_block is not None:
            self._set_state(State.EXEC, self.current_block.number)
        return True

    monkeypatch.setattr(Processor, "begin_work", take_later)
    with pytest.raises(AssertionError, match=r"released|deadlock"):
        go(monkeypatch, replace_input, 2, 2, WALKS)


def test_the_exploration_finds_a_token_for_the_wrong_zone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A child that gives its block back to the parent that it has now."""

    def give_back_to_the_present_parent(self: StateMachine) -> None:
        if self.parent is not None:
            self.parent._reader_done(self)

    monkeypatch.setattr(StateMachine, "release_input", give_back_to_the_present_parent)
    with pytest.raises(AssertionError, match="released"):
        go(monkeypatch, replace_input, 2, 0, WALKS)


def test_the_exploration_finds_a_deadlock(monkeypatch: pytest.MonkeyPatch) -> None:
    """A child that does not say that it is done."""
    monkeypatch.setattr(StateMachine, "_reader_done", lambda self, child: self._readers.discard(child))
    with pytest.raises(AssertionError, match="deadlock"):
        go(monkeypatch, grow, 2, 0, WALKS)


def test_the_exploration_finds_a_task_that_two_work_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """An input that was called twice, and is taken up twice."""
    begin = StateMachine.begin_work

    def begin_though_at_work(self: StateMachine) -> bool:
        self.busy = False
        return begin(self)

    monkeypatch.setattr(StateMachine, "begin_work", begin_though_at_work)
    with pytest.raises(AssertionError):
        go(monkeypatch, hear, 2, 1, WALKS)


def test_the_exploration_finds_a_call_that_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """An input that forgets, after it has looked for sound in vain, that it was called meanwhile."""
    rest = Processor.end_work

    def forget(self: Processor) -> None:
        self.input_pending = self.input_pending and self.state is not State.WAIT_EXEC
        rest(self)

    monkeypatch.setattr(Processor, "end_work", forget)
    with pytest.raises(AssertionError, match="deadlock"):
        go(monkeypatch, hear, 2, 1, WALKS)


def test_the_exploration_finds_a_worker_that_is_not_called(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Workers, "wake", lambda self: None)
    with pytest.raises(AssertionError, match="deadlock"):
        go(monkeypatch, hear, 2, 1, WALKS)
