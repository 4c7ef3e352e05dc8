"""The pool of workers: order of tasks, number of workers, and workers that are blocked."""

from __future__ import annotations

import math
import os
import threading
import time
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from rosafe.tree import workers as pool
from rosafe.tree.block import Block
from rosafe.tree.processor import ESTIMATE_GROWTH, Processor
from rosafe.tree.states import State
from rosafe.tree.tree import Tree
from rosafe.tree.workers import MAX_WORKERS, VARIABLE, workers_to_use
from tests.harness import PATIENCE, wait_for

from .support import Feed, Plain, Recorder, tree_threads, use_plain_stages

FRAMES, WORKERS = 1, 1


def computing() -> int:
    return sum(thread.name.startswith(pool.WORKER) for thread in tree_threads())


# --- number ---


def test_the_number_of_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    assert workers_to_use() == len(os.sched_getaffinity(0))
    assert workers_to_use(3) == 3
    for text, count in (("5", 5), (" 2 ", 2), ("", workers_to_use()), (str(MAX_WORKERS), MAX_WORKERS)):
        monkeypatch.setenv(VARIABLE, text)
        assert workers_to_use() == count
        assert workers_to_use(4) == 4, "the argument has priority over the environment"


@pytest.mark.parametrize(
    "text", ["0", "-1", "1.5", "two", str(MAX_WORKERS + 1), "9" * 5000, "\N{ARABIC-INDIC DIGIT FIVE}"]
)
def test_invalid_numbers(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, text)
    with pytest.raises(ValueError, match=f"^{VARIABLE}: expected a whole number from 1 to {MAX_WORKERS}, got '"):
        Tree(Recorder())
    with pytest.raises(ValueError, match=r"^workers: "):
        Tree(Recorder(), 0)


@pytest.mark.parametrize("workers", [1, 2, 3], indirect=True)
def test_the_number_of_concurrent_computations_is_that_of_the_workers(
    tree: Tree, feed: Feed, listener: Recorder, workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Six siblings: as many compute at the same time as there are workers, and never more."""
    lock = threading.Lock()
    concurrent: list[int] = []
    now = 0

    class Counted(Plain):
        def compute(self, block: np.ndarray) -> np.ndarray:
            nonlocal now
            with lock:
                now += 1
                concurrent.append(now)
            meeting.wait(PATIENCE)
            with lock:
                now -= 1
            return block

    meeting = threading.Barrier(workers)
    use_plain_stages(monkeypatch, preProc=Counted)
    tree.add_input("input", feed, 1, 1.0, 1.0)
    siblings = [tree.add("preProc", name, "input") for name in "abcdef"]
    feed.put(count=3)
    for one in siblings:
        listener.wait_blocks(one, 3)
    assert max(concurrent) == workers
    assert computing() <= workers


# --- order ---


def test_one_worker_completes_a_block_before_the_next(
    tree: Tree, feed: Feed, listener: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The block is still in the cache. The deepest task is run first."""
    order: list[tuple[str, int]] = []

    class Recorded(Plain):
        def compute(self, block: np.ndarray) -> np.ndarray:
            order.append((self.parameters["name"], int(block[0, 0])))
            return block

    use_plain_stages(monkeypatch, **dict.fromkeys(("preProc", "gammatone", "ihc"), Recorded))
    tree.add_input("input", feed, 1, 1.0, 1.0)
    for kind, name, parent in (
        ("preProc", "a", "input"),
        ("gammatone", "aa", "a"),
        ("ihc", "aaa", "aa"),
        ("preProc", "b", "input"),
        ("gammatone", "bb", "b"),
    ):
        tree.add(kind, name, parent, {"name": name})
    feed.put(count=20)
    for processor in tree.processors:
        listener.wait_blocks(processor, 20)
    assert len(order) == 100
    for number in range(20):
        names = [name for name, block in order[5 * number : 5 * number + 5] if block == number]
        assert sorted(names) == ["a", "aa", "aaa", "b", "bb"]
        assert names.index("a") == names.index("aa") - 1 == names.index("aaa") - 2
        assert names.index("b") == names.index("bb") - 1
    assert computing() == 1


class EstimatedTask:
    """A task with an estimated duration, which does nothing."""

    depth = 0
    blocked_since = 0.0
    removed = False
    trusted = True

    def __init__(self, seconds: float) -> None:
        self.estimated_seconds = seconds

    def begin_work(self) -> bool:
        return True

    def work(self) -> None:
        pass

    def end_work(self) -> None:
        pass

    def check_source(self) -> None:
        pass


@pytest.mark.parametrize(
    ("real_time", "seconds", "expected"),
    [
        (False, [1e-5, 1e-5], False),
        (False, [1e-3, 1e-5], True),
        (False, [1e-5, math.inf], True),
        (False, [2e-4, 2e-4], False),
        (False, [1e-5] * 100, True),
        (True, [1e-3] * 12, False),  # a block of 12000 frames takes about 10 ms
        (True, [2e-2, 1e-5], True),
        (True, [1e-3] * 30, True),
    ],
)
def test_another_worker_is_woken_only_for_long_tasks(real_time: bool, seconds: list[float], expected: bool) -> None:
    """No other one is woken if the own task and all waiting ones are short, unless the tree does not keep up."""
    own, *waiting = map(EstimatedTask, seconds)
    workers = pool.Workers(threading.RLock(), 2, real_time)
    for task in waiting:
        workers.push(task)
    assert workers._should_wake_another(own) == expected
    workers._busy_since -= 2 * pool.BUSY_SECONDS
    assert workers._should_wake_another(own) == (sum(seconds) > pool.BUSY_THRESHOLD_SECONDS)


class RecordedTask(EstimatedTask):
    """Records the threads that run it."""

    def __init__(self, seconds: float, trusted: bool = True) -> None:
        super().__init__(seconds)
        self.trusted = trusted
        self.threads: list[str] = []

    def work(self) -> None:
        self.threads.append(threading.current_thread().name)


@pytest.mark.parametrize(
    ("tasks", "own"),
    [
        ([RecordedTask(1e-4), RecordedTask(1e-4)], 2),
        ([RecordedTask(1e-4), RecordedTask(2e-3), RecordedTask(1e-4)], 1),
        ([RecordedTask(1e-4, trusted=False)], 0),
        ([RecordedTask(math.inf)], 0),
    ],
)
def test_the_calling_thread_runs_only_short_tasks_of_this_package(tasks: list[RecordedTask], own: int) -> None:
    lock = threading.RLock()
    workers = pool.Workers(lock, 1, real_time=True)
    client = EstimatedTask(0.0)
    with lock:
        workers.add_client(client)
    assert workers.wait_idle(PATIENCE)
    for task in tasks:
        task.threads.clear()
    with lock:
        for task in reversed(tasks):  # the newest is the first
            workers.push(task)
        workers.run_short_tasks()
        assert [len(task.threads) for task in tasks] == [1] * own + [0] * (len(tasks) - own)
    wait_for(lambda: all(task.threads for task in tasks))
    names = [task.threads for task in tasks]
    assert names == [["MainThread"]] * own + [["rosafe worker 1"]] * (len(tasks) - own)
    with lock:
        workers.remove_client(client)
    workers.join()


@pytest.mark.parametrize("begins", [True, False])
def test_idle_workers_keep_no_task(begins: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is a processor that may have been removed, with tens of MB."""
    lock = threading.RLock()
    workers = pool.Workers(lock, 1)
    monkeypatch.setattr(RecordedTask, "begin_work", lambda task: task.threads.append("begin") or begins)
    task = RecordedTask(1e-4)
    client, pushed, threads = EstimatedTask(0.0), weakref.ref(task), task.threads
    with lock:
        workers.add_client(client)
        workers.push(task)
        workers.wake()
    del task
    wait_for(lambda: pushed() is None)
    assert threads == ["begin"] + ["rosafe worker 1"] * begins
    with lock:
        workers.remove_client(client)
    workers.join()


def test_the_calling_thread_runs_nothing_while_a_worker_computes_or_offline() -> None:
    for real_time in (True, False):
        lock = threading.RLock()
        workers = pool.Workers(lock, 2, real_time)
        task = RecordedTask(1e-4)
        with lock:
            workers._free_slots -= real_time
            workers.push(task)
            workers.run_short_tasks()
            assert task.threads == []
            workers._free_slots += real_time


@pytest.mark.parametrize(
    ("computing", "seconds", "woken"),
    [
        ([], [2e-3], 1),
        ([], [2e-3, 2e-3], 1),  # the worker wakes another one if necessary
        ([5e-3], [2e-3, 2e-3], 0),
        ([5e-3], [2e-2], 1),
        ([2.1e-2], [2e-3], 1),
    ],
)
def test_arriving_sound_wakes_a_second_worker_only_for_long_tasks(
    computing: list[float], seconds: list[float], woken: int
) -> None:
    lock = threading.RLock()
    workers = pool.Workers(lock, 2, real_time=True)
    workers._busy_since = math.inf  # the tree keeps up
    workers._workers = [pool._Worker(lock) for _ in range(2)]
    workers._idle = workers._workers[len(computing) :]
    workers._free_slots -= len(computing)
    for worker, duration in zip(workers._workers, computing, strict=False):
        worker.has_slot, worker.task = True, EstimatedTask(duration)
    with lock:
        for duration in seconds:
            workers.push(EstimatedTask(duration))
        workers.run_short_tasks()
    assert workers._woken == woken


def test_the_pool_is_busy_only_until_all_workers_are_idle() -> None:
    """The next tasks are run by the worker that worked last."""

    class Waiting(EstimatedTask):
        thread: threading.Thread

        def __init__(self) -> None:
            super().__init__(1.0)
            self.released = threading.Event()

        def work(self) -> None:
            self.thread = threading.current_thread()
            self.released.wait(PATIENCE)

    lock = threading.RLock()
    workers = pool.Workers(lock, 2)

    def run(*tasks: EstimatedTask) -> None:
        with lock:
            for task in tasks:
                workers.push(task)
            workers.wake()

    def wait_idle(count: int) -> None:
        def idle() -> bool:
            with lock:
                return len(workers._idle) == count

        wait_for(idle)

    client = EstimatedTask(0.0)
    with lock:
        workers.add_client(client)
    first, second = Waiting(), Waiting()
    run(first, second)
    for number, task in enumerate((first, second), 1):
        task.released.set()
        wait_idle(number)
    for _ in range(2):
        workers._busy_since = 0.0
        task = Waiting()
        task.released.set()
        run(task)
        wait_for(lambda: workers._busy_since)
        wait_idle(2)
        assert task.thread is second.thread is not first.thread
    with lock:
        workers.remove_client(client)
    workers.join()


def test_a_worker_prefers_the_tasks_that_it_ran_before() -> None:
    """Among the deepest tasks. Without such a task it takes the newest of the deepest, as a single worker does."""
    workers = pool.Workers(threading.RLock(), 2)
    one, other = pool._Worker(workers.lock), pool._Worker(workers.lock)
    first, second, deep = (EstimatedTask(1e-5) for _ in range(3))
    deep.depth = 1

    def pop(worker: Any, *tasks: EstimatedTask) -> list[EstimatedTask]:
        for task in tasks:
            workers.push(task)
        return [workers._pop_task(worker) for _ in tasks]  # type: ignore[misc]

    assert pop(one, first) == [first]
    assert pop(other, second) == [second]
    assert pop(one, first, second) == [first, second]
    assert pop(other, second) == [second]
    assert pop(one, second, first) == [first, second]
    assert pop(other, second) == [second]
    assert pop(other, first, second, deep) == [deep, second, first]
    assert not workers._ready


def test_the_estimated_duration_of_a_processor(tree: Tree, feed: Feed, listener: Recorder) -> None:
    """Infinite at first, so that no task waits for it; then the recent minimum."""
    one = tree.add_input("input", feed, 1, 1.0, 1.0)
    assert one.estimated_seconds == math.inf
    for number in range(1, 4):
        before = one.estimated_seconds
        feed.put(count=1)
        listener.wait_blocks(one, number)
        assert 0 < one.estimated_seconds <= ESTIMATE_GROWTH * before


def test_the_estimated_duration_contains_no_waiting(
    tree: Tree, feed: Feed, listener: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A task that waited for the interpreter's lock would be left to the workers, which wait even more."""
    waited = 0.2  # s

    class Waiting(Plain):
        def compute(self, block: np.ndarray) -> np.ndarray:
            threading.Event().wait(waited)
            return block

    use_plain_stages(monkeypatch, preProc=Waiting)
    tree.add_input("input", feed, 1, 1.0, 1.0)
    one = tree.add("preProc", "preProc", "input")
    feed.put(count=1)
    listener.wait_blocks(one, 1)
    assert one.estimated_seconds < waited / 2


# --- blocked workers ---


class Blocking(Recorder):
    """A listener that blocks for the processors in `blocked_names` until `go` is set."""

    def __init__(self) -> None:
        super().__init__()
        self.blocked_names: set[str] = set()
        self.blocked: set[str] = set()
        self.go = threading.Event()

    def on_released(self, processor: Processor, block: Block) -> None:
        if processor.name in self.blocked_names and not self.go.is_set():
            self.blocked.add(processor.name)
            assert self.go.wait(PATIENCE)
        super().on_released(processor, block)


@pytest.fixture
def listener() -> Iterator[Blocking]:
    blocking = Blocking()
    yield blocking
    blocking.go.set()


@pytest.mark.parametrize("workers", [1, 2], indirect=True)
def test_a_listener_that_blocks(
    tree: Tree, feed: Feed, listener: Blocking, workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It blocks for three siblings. A child of one of them and the other siblings continue until they need those."""
    use_plain_stages(monkeypatch)
    listener.blocked_names = {"a", "b", "c"}
    root = tree.add_input("input", feed, 1, 1.0, 1.0)
    blocked = [tree.add("preProc", name, "input") for name in "abc"]
    others = [tree.add("preProc", name, "input") for name in "xyz"]
    child = tree.add("gammatone", "child", "a")
    feed.put(count=5)
    for one in (*others, child):
        listener.wait_blocks(one, 1)
    wait_for(lambda: listener.blocked == {"a", "b", "c"})
    for one in (root, *others):  # the blocked processors have not read the second block
        listener.wait_blocks(one, 2)
    assert [len(listener.blocks[one]) for one in blocked] == [0, 0, 0]
    assert tree.find("x").stage.parameters == others[0].stage.parameters
    tree.modify("x", "pp_bRemoveDC", "1")
    late = tree.add("gammatone", "late", "x")
    listener.wait_blocks(late, 1)
    listener.go.set()
    for one in tree.processors:
        listener.wait_blocks(one, 5 if one is not late else 4)
        assert [block.number for block in listener.blocks[one]][-4:] == [1, 2, 3, 4]
    wait_for(lambda: computing() <= workers + 1, what="the end of the replacing workers")


def test_a_long_computation_does_not_block_requests(
    tree: Tree, feed: Feed, listener: Blocking, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All workers compute long blocks. After its removal, such a processor no longer blocks others."""
    working, go_on = threading.Event(), threading.Event()

    class Long(Plain):
        def compute(self, block: np.ndarray) -> np.ndarray:
            if self.parameters.get("long"):
                working.set()
                assert go_on.wait(PATIENCE)
            return block

    use_plain_stages(monkeypatch, preProc=Long)
    root = tree.add_input("input", feed, 1, 1.0, 1.0)
    long = tree.add("preProc", "long", "input", {"long": True})
    feed.put(count=3)
    assert working.wait(PATIENCE)
    begun = time.monotonic()
    other = tree.add("preProc", "other", "input")
    tree.modify("long", "pp_bRemoveDC", "1")
    assert tree.dependencies("other") == ["input", "other"]
    assert [(view.frames, index) for (view,), index, _ in [root.history.read_new("reader")]] in ([(0, 0)], [(1, 1)])
    assert tree.remove("long") == [long]
    assert time.monotonic() - begun < PATIENCE / 2
    listener.wait_blocks(other, 3)
    assert not long.join(0.0)
    go_on.set()
    assert long.join(PATIENCE)
    assert listener.blocks[long] == []
    wait_for(lambda: computing() == 1)


def test_a_source_that_waits_is_not_read_again(tree: Tree, listener: Blocking) -> None:
    """It is read once at the start and once for each block; with `waiting` False, also after the last block."""
    reads: list[int] = []

    class Counted(Feed):
        def read(self) -> tuple[np.ndarray, int] | None:
            reads.append(1)
            return super().read()

    source = Counted()
    root = tree.add_input("input", source, 1, 1.0, 1.0)
    wait_for(lambda: len(reads) == 1 and root.state is State.WAIT_EXEC)
    for number in range(1, 6):
        source.put(count=1)
        listener.wait_blocks(root, number)
        wait_for(lambda: not root.busy and not root.ready)
        assert len(reads) == 1 + number


def test_a_source_that_blocks(tree: Tree, listener: Blocking, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as a file on a sleeping disk. Blocks that were read before are processed, and the tree can be stopped."""
    read_called, answer = threading.Event(), threading.Event()

    class Asleep(Feed):
        waiting = False

        def read(self) -> tuple[np.ndarray, int] | None:
            got = super().read()
            if got is None and not self.ended:
                read_called.set()
                assert answer.wait(PATIENCE)
            return got

    use_plain_stages(monkeypatch)
    source = Asleep(frames=1)
    source.put(count=1)
    root = tree.add_input("input", source, 1, 1.0, 1.0)
    child = tree.add("preProc", "child", "input")
    assert read_called.wait(PATIENCE)
    listener.wait_blocks(child, 1)
    tree.stop()
    assert listener.ends == [child, root]
    assert not root.join(0.0)
    answer.set()
    assert root.join(PATIENCE)


def test_a_slow_listener_is_called_last(
    tree: Tree, feed: Feed, listener: Blocking, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The children of the processor do not wait for it."""
    called: list[str] = []

    def released(self: Blocking, processor: Processor, block: Block) -> None:
        called.append(processor.name)
        if processor.name == "slow":
            processor._publish_seconds = 1.0
        Recorder.on_released(self, processor, block)

    use_plain_stages(monkeypatch)
    monkeypatch.setattr(Blocking, "on_released", released)
    tree.add_input("input", feed, 1, 1.0, 1.0)
    slow = tree.add("preProc", "slow", "input")
    below = tree.add("gammatone", "below", "slow")
    slow._publish_seconds = 1.0
    feed.put(count=1)
    listener.wait_blocks(slow, 1)
    listener.wait_blocks(below, 1)
    assert called == ["input", "below", "slow"]


# --- threads ---


def test_threads_exist_from_the_first_to_the_last_processor(tree: Tree, listener: Blocking) -> None:
    assert tree_threads() == set()
    for _ in range(5):
        feed = Feed(frames=1)
        tree.add_input("input", feed, 1, 1.0, 1.0)
        child = tree.add("preProc", "child", "input")
        feed.put(count=1)
        listener.wait_blocks(child, 1)
        assert {thread.name for thread in tree_threads()} == {"rosafe watch", "rosafe worker 1"}
        tree.stop()
        tree.join()
        assert tree_threads() == set()
    assert child.state is State.REMOVED


def test_a_stop_followed_immediately_by_a_new_tree(listener: Blocking, monkeypatch: pytest.MonkeyPatch) -> None:
    """The threads of the old tree may not have ended yet when they are needed again."""
    use_plain_stages(monkeypatch)
    tree = Tree(listener, 2)
    for _ in range(40):  # test_schedules.py runs the possible orders
        feed = Feed(frames=1)
        tree.add_input("input", feed, 1, 1.0, 1.0)
        leaves = [tree.add("preProc", name, "input") for name in "ab"]
        feed.put(count=1)
        for leaf in leaves:
            listener.wait_blocks(leaf, 1)
        tree.stop()
        listener.forget()
    tree.join()
    assert tree_threads() == set()


def test_a_listener_queries_the_tree(
    tree: Tree, feed: Feed, listener: Blocking, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A listener must not wait for the tree, but it may query it."""
    answers: list[Any] = []

    def executed(self: Blocking, processor: Processor, seconds: float) -> None:
        answers.append(tree.dependencies(processor.name))

    monkeypatch.setattr(Blocking, "on_executed", executed)
    tree.add_input("input", feed, 1, 1.0, 1.0)
    child = tree.add("preProc", "child", "input")
    feed.put(count=1)
    listener.wait_blocks(child, 1)
    assert answers == [["input"], ["input", "child"]]
