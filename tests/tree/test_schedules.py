"""The tree under many schedules of its threads: no block is lost, repeated or reordered, and there is no deadlock."""

from __future__ import annotations

import itertools
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
from rosafe.tree.tree import Tree

from .explorer import Scheduler, explore
from .support import Plain, use_plain_stages

pytestmark = pytest.mark.long

WALKS = 300

Check = Callable[[], None]
Scenario = Callable[..., Check]


class Numbers:
    """A source of blocks that contain their number. It ends after them, or never."""

    sample_rate = 1000.0

    def __init__(self, numbers: range, ends: bool = True) -> None:
        self.ended = self.stopped = False
        self.numbers = deque(numbers)
        self.frames = 0  # that were read
        self.wake: Callable[[], None] = lambda: None
        self.required_frames: Callable[[], float] = lambda: 0
        self._ends = ends

    def open(self, wake: Callable[[], None], required_frames: Callable[[], float]) -> None:
        self.wake, self.required_frames = wake, required_frames

    def read(self) -> tuple[np.ndarray, int] | None:
        if self.numbers and not self.stopped:
            number = self.numbers.popleft()
            self.frames = number + 1
            return np.full((2, 1), float(number)), number + 1
        self.ended = self.ended or self._ends
        return None

    @property
    def waiting(self) -> bool:
        return not (self.numbers or self._ends or self.ended)

    def stop(self) -> None:
        self.stopped = self.ended = True


class Log:
    """A listener that records the blocks of each processor. Only one thread runs at a time: it needs no lock."""

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
        """Check that it released consecutive blocks from `first` to `last` (None: from or to any)."""
        numbers = self.numbers[processor]
        assert processor.error is None, f"{processor!r}: {processor.error!r}"
        if numbers:
            assert numbers == list(range(numbers[0], numbers[-1] + 1)), f"{processor!r} released {numbers}"
        if first is not None:
            assert numbers[:1] == [first], f"{processor!r} released {numbers}"
        if last is not None:
            assert numbers[-1:] == [last], f"{processor!r} released {numbers}"

    def assert_runs(self, *runs: tuple[Processor, int | None, int | None]) -> None:
        """Check several processors."""
        for run in runs:
            self.assert_run(*run)


def use(patch: pytest.MonkeyPatch, threading: Any) -> None:
    """Let the code of the tree use the locks and threads of `threading`."""
    for module in (parameter_updates, history, processor, tree, workers):
        patch.setattr(module, "threading", threading)
    patch.setattr(workers, "SHORT_TASK_SECONDS", math.inf)  # so that the source's thread also runs the first tasks


def run_to_the_end(tree: Tree) -> None:
    """Wait until all processors are finished, then until all threads have ended."""
    for one in tree.processors:
        one.join()
    end(tree)


def end(tree: Tree) -> None:
    tree.stop()
    tree.join()


# --- scenarios ---


def grow(scheduler: Scheduler, log: Log, tree: Tree) -> Check:
    """Processors are added while blocks are processed: siblings, and a grandchild."""
    root = tree.add_input("input", Numbers(range(3)), 1, 0.0, 0.0)
    first = tree.add("preProc", "first", "input")
    below = tree.add("gammatone", "below", "first")
    second = tree.add("preProc", "second", "input")
    run_to_the_end(tree)

    return partial(log.assert_runs, (root, 0, 2), *((one, None, 2) for one in (first, below, second)))


def receive(scheduler: Scheduler, log: Log, tree: Tree) -> Check:
    """As `wake`, in real time: the thread that adds blocks runs tasks itself if all workers are idle."""
    return wake(scheduler, log, tree)


def receive_until_stop(scheduler: Scheduler, log: Log, tree: Tree) -> Check:
    """The tree is stopped while the thread that adds blocks runs its tasks."""
    source = Numbers(range(0), ends=False)
    root = tree.add_input("input", source, 1, 0.0, 0.0)
    child = tree.add("preProc", "child", "input")

    def play() -> None:
        for number in range(2):
            source.numbers.append(number)
            source.wake()

    player = scheduler.threading.Thread(play, "player")
    player.start()
    end(tree)
    player.join()

    def check() -> None:
        log.assert_run(root, None, None)
        log.assert_run(child, None, None)
        assert sorted(log.ends, key=lambda one: one.name) == [child, root]

    return check


def wake(scheduler: Scheduler, log: Log, tree: Tree) -> Check:
    """A thread adds blocks one by one, and wakes the tree each time."""
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

    return partial(log.assert_runs, (root, 0, 2), (child, 0, 2))


def require(scheduler: Scheduler, log: Log, tree: Tree) -> Check:
    """A source asks which frame is required while blocks are on their way. Two of them complete an awaited output."""
    source = Numbers(range(0), ends=False)
    tree.add_input("input", source, 1, 0.0, 0.0).awaited = False
    tree.add("preProc", "between", "input").awaited = False
    tree.add("gammatone", "pairs", "between")
    answers: list[tuple[float, int]] = []

    def play() -> None:
        for number in range(3):
            source.numbers.append(number)
            source.wake()
            ask()

    def ask() -> None:
        required = source.required_frames()
        answers.append((required, source.frames))

    threads = [scheduler.threading.Thread(run, name) for run, name in ((play, "player"), (ask, "another one"))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    end(tree)

    def check() -> None:
        late = [(required, read) for required, read in answers if required > 2 * (read // 2 + 1)]
        assert not late, f"(required, read): {late}"

    return check


def without_consumers(scheduler: Scheduler, log: Log, tree: Tree) -> Check:
    """The input and its child have no consumers. The grandchild gets all blocks."""
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


def shrink(scheduler: Scheduler, log: Log, tree: Tree) -> Check:
    """One of two siblings is removed with its child, and its name is used again immediately."""
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


def remove_child(scheduler: Scheduler, log: Log, tree: Tree) -> Check:
    """The only child is removed: the input does not wait for it."""
    root = tree.add_input("input", Numbers(range(3)), 1, 0.0, 0.0)
    child = tree.add("preProc", "child", "input")
    tree.remove("child")
    run_to_the_end(tree)

    def check() -> None:
        assert log.ends == [child, root]
        log.assert_run(root, 0, 2)
        log.assert_run(child, None, None)

    return check


def replace_input(scheduler: Scheduler, log: Log, tree: Tree) -> Check:
    """A new input takes over the tree. Its child gets all its blocks, whatever it did for the old one."""
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


def stop(scheduler: Scheduler, log: Log, tree: Tree) -> Check:
    """The tree is stopped at any moment and built again."""
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


def fail(scheduler: Scheduler, log: Log, tree: Tree) -> Check:
    """A processor fails in its second block. Its sibling and its parent are not affected."""
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
    """A stage that fails in its second block if `fails` is set."""

    def compute(self, block: np.ndarray) -> np.ndarray:
        if self.parameters.get("fails") and block[0, 0] == 1.0:
            raise ZeroDivisionError
        return block


class Pairs(Plain):
    """A stage whose output is complete after every second block of one frame."""

    blocks = 0

    def compute(self, block: np.ndarray) -> np.ndarray:
        self.blocks += 1
        return block

    def required_input(self, frames: int) -> int:
        return 2 * frames - self.blocks % 2


@pytest.fixture(autouse=True)
def plain_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    use_plain_stages(monkeypatch, preProc=Failing, gammatone=Pairs)
    monkeypatch.setattr(parameter_updates, "FramedStage", Pairs)
    monkeypatch.setattr(workers, "WAKE_THRESHOLD_SECONDS", 0.0)


def go(patch: pytest.MonkeyPatch, scenario: Scenario, count: int, delays: int, walks: int) -> int:
    def run(scheduler: Scheduler) -> Check:
        log = Log()
        return scenario(scheduler, log, Tree(log, count, real_time=scenario in (receive, receive_until_stop, require)))

    return explore(run, partial(use, patch), delays, walks)


SCENARIOS = (
    (grow, 1),
    (wake, 1),
    (receive, 2),
    (receive_until_stop, 2),
    (require, 2),
    (without_consumers, 1),
    (shrink, 2),
    (remove_child, 2),
    (replace_input, 1),
    (stop, 2),
    (fail, 2),
)
SETTINGS = ((3, 0.0), (2, math.inf), (1, 0.0))  # workers, and when they publish blocks; one for each scenario


@pytest.mark.parametrize(
    ("scenario", "delays", "count", "threshold"),
    [(*scenario, *settings) for scenario, settings in zip(SCENARIOS, itertools.cycle(SETTINGS), strict=False)],
)
def test_any_order_of_events(
    scenario: Scenario, delays: int, count: int, threshold: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other workers are woken for every task; blocks are published immediately or later."""
    monkeypatch.setattr(processor, "SLOW_LISTENER_SECONDS", threshold)
    assert go(monkeypatch, scenario, count, delays, WALKS) > WALKS + 15


@pytest.mark.parametrize("scenario", [grow, wake, shrink, replace_input])
def test_any_order_of_events_with_few_wake_ups(scenario: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("WAKE_THRESHOLD_SECONDS", "BUSY_THRESHOLD_SECONDS"):
        monkeypatch.setattr(workers, name, math.inf)
    assert go(monkeypatch, scenario, 2, 1, WALKS) > WALKS + 15
