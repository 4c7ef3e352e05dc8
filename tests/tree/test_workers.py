"""The pool: in what order, how many at a time, and that nobody who is held up holds up others."""

from __future__ import annotations

import math
import os
import threading
import time
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


@pytest.fixture
def feed() -> Feed:
    return Feed(frames=1)


@pytest.fixture
def workers(request: pytest.FixtureRequest) -> int:
    return int(getattr(request, "param", 1))


def computing() -> int:
    return sum(thread.name.startswith(pool.WORKER) for thread in tree_threads())


# --- how many ---


def test_how_many_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    assert workers_to_use() == len(os.sched_getaffinity(0))
    assert workers_to_use(3) == 3
    for text, count in (("5", 5), (" 2 ", 2), ("", workers_to_use()), (str(MAX_WORKERS), MAX_WORKERS)):
        monkeypatch.setenv(VARIABLE, text)
        assert workers_to_use() == count
        assert workers_to_use(4) == 4, "what a program says counts more than the environment"


@pytest.mark.parametrize(
    "text", ["0", "-1", "1.5", "two", str(MAX_WORKERS + 1), "9" * 5000, "\N{ARABIC-INDIC DIGIT FIVE}"]
)
def test_numbers_that_are_none(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, text)
    with pytest.raises(ValueError, match=f"^{VARIABLE}: .* is not a whole number from 1 to {MAX_WORKERS}$"):
        Tree(Recorder())
    with pytest.raises(ValueError, match=r"^workers: "):
        Tree(Recorder(), 0)


@pytest.mark.parametrize("workers", [1, 2, 3], indirect=True)
def test_no_more_compute_than_there_are_workers(
    tree: Tree, feed: Feed, listener: Recorder, workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of six siblings as many are at work at the same time as may be, and never more."""
    lock = threading.Lock()
    at_once: list[int] = []
    now = 0

    class Counted(Plain):
        def process(
            self, block: np.ndarray, extra: np.ndarray | None = None, out: np.ndarray | None = None
        ) -> np.ndarray:
            nonlocal now
            with lock:
                now += 1
                at_once.append(now)
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
    assert max(at_once) == workers
    assert computing() <= workers


# --- in what order ---


def test_one_worker_takes_a_block_through_the_tree_before_the_next(
    tree: Tree, feed: Feed, listener: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While it is in the cache; and the deepest first."""
    order: list[tuple[str, int]] = []

    class Noted(Plain):
        def process(
            self, block: np.ndarray, extra: np.ndarray | None = None, out: np.ndarray | None = None
        ) -> np.ndarray:
            order.append((self.parameters["name"], int(block[0, 0])))
            return block

    use_plain_stages(monkeypatch, **dict.fromkeys(("preProc", "gammatone", "ihc"), Noted))
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


class Short:
    """A task that takes so many seconds, as it says; it never does."""

    depth = 0
    blocked_since = 0.0
    removed = False

    def __init__(self, usual: float) -> None:
        self.estimated_seconds = usual

    def begin_work(self) -> bool:
        return True

    def work(self) -> None:
        pass

    def end_work(self) -> None:
        pass


@pytest.mark.parametrize(
    ("seconds", "worth"),
    [
        ([1e-5, 1e-5], False),
        ([1e-3, 1e-5], True),
        ([1e-5, 1e-3], True),
        ([math.inf, 1e-5], True),
        ([1e-5, math.inf], True),
        ([1e-5] * 10, False),
        ([1e-5] * 100, True),
    ],
)
def test_short_work_is_not_worth_a_call(seconds: list[float], worth: bool) -> None:
    """Neither what one does oneself is long to wait for, nor all that is left over together."""
    own, *waiting = map(Short, seconds)
    workers = pool.Workers(threading.RLock(), 2)
    for task in waiting:
        workers.push(task)
    assert workers._should_wake_another(own) == worth


def test_a_worker_goes_on_with_what_it_did_the_last_time() -> None:
    """Of the deepest ones; else with the deepest that came last, as the only worker does."""
    workers = pool.Workers(threading.RLock(), 2)
    one, other = pool._Worker(), pool._Worker()
    first, second, deep = (Short(1e-5) for _ in range(3))
    deep.depth = 1

    def taken(worker: Any, *tasks: Short) -> list[Short]:
        for task in tasks:
            workers.push(task)
        return [workers._pop_task(worker) for _ in tasks]  # type: ignore[misc]

    assert taken(one, first) == [first]
    assert taken(other, second) == [second]
    assert taken(one, first, second) == [first, second]
    assert taken(other, second) == [second]
    assert taken(one, second, first) == [first, second]
    assert taken(other, second) == [second]
    assert taken(other, first, second, deep) == [deep, second, first]
    assert not workers._ready


def test_what_a_processor_usually_takes(tree: Tree, feed: Feed, listener: Recorder) -> None:
    """Unknown at first, so that nobody waits for it in vain; then the least of late."""
    one = tree.add_input("input", feed, 1, 1.0, 1.0)
    assert one.estimated_seconds == math.inf
    for number in range(1, 4):
        before = one.estimated_seconds
        feed.put(count=1)
        listener.wait_blocks(one, number)
        assert 0 < one.estimated_seconds <= ESTIMATE_GROWTH * before


# --- who is held up ---


class Stubborn(Recorder):
    """A listener that does not come back from those in `holds` until it is let `go`."""

    def __init__(self) -> None:
        super().__init__()
        self.holds: set[str] = set()
        self.held: set[str] = set()
        self.go = threading.Event()

    def on_released(self, processor: Processor, block: Block) -> None:
        if processor.name in self.holds and not self.go.is_set():
            self.held.add(processor.name)
            assert self.go.wait(PATIENCE)
        super().on_released(processor, block)


@pytest.fixture
def listener() -> Iterator[Stubborn]:
    stubborn = Stubborn()
    yield stubborn
    stubborn.go.set()


@pytest.mark.parametrize("workers", [1, 2], indirect=True)
def test_a_listener_that_does_not_come_back(
    tree: Tree, feed: Feed, listener: Stubborn, workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For three processors, of which one has a child: that goes on, and so do the others, until all wait for those."""
    use_plain_stages(monkeypatch)
    listener.holds = {"a", "b", "c"}
    root = tree.add_input("input", feed, 1, 1.0, 1.0)
    held = [tree.add("preProc", name, "input") for name in "abc"]
    others = [tree.add("preProc", name, "input") for name in "xyz"]
    child = tree.add("gammatone", "child", "a")
    feed.put(count=5)
    for one in (*others, child):
        listener.wait_blocks(one, 1)
    wait_for(lambda: listener.held == {"a", "b", "c"})
    for one in (root, *others):  # the second block is kept by those that are held up before they take it
        listener.wait_blocks(one, 2)
    assert [len(listener.blocks[one]) for one in held] == [0, 0, 0]
    assert tree.find("x").parameters() == others[0].parameters()
    tree.modify("x", "pp_bRemoveDC", "1")
    late = tree.add("gammatone", "late", "x")
    listener.wait_blocks(late, 1)
    listener.go.set()
    for one in tree.processors:
        listener.wait_blocks(one, 5 if one is not late else 4)
        assert [block.number for block in listener.blocks[one]][-4:] == [1, 2, 3, 4]
    wait_for(lambda: computing() <= workers + 1, what="those that came in the place of others to end")


def test_a_block_that_takes_long_stops_no_request(
    tree: Tree, feed: Feed, listener: Stubborn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As many are at one as there are workers. Who is removed in the middle of it holds up nobody any more."""
    working, go_on = threading.Event(), threading.Event()

    class Long(Plain):
        def process(
            self, block: np.ndarray, extra: np.ndarray | None = None, out: np.ndarray | None = None
        ) -> np.ndarray:
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
    assert [(view.frames, index) for (view,), index, _ in [root.take("x")]] in ([(0, 0)], [(1, 1)])
    assert tree.remove("long") == [long]
    assert time.monotonic() - begun < PATIENCE / 4
    listener.wait_blocks(other, 3)
    assert not long.join(0.0)
    go_on.set()
    assert long.join(PATIENCE)
    assert listener.blocks[long] == []
    wait_for(lambda: computing() == 1)


def test_a_source_that_does_not_answer(tree: Tree, listener: Stubborn, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file on a disk that sleeps: what was read before goes through the tree, and it can be stopped."""
    asked, answer = threading.Event(), threading.Event()

    class Asleep(Feed):
        def read(self) -> tuple[np.ndarray, int] | None:
            got = super().read()
            if got is None and not self.ended:
                asked.set()
                assert answer.wait(PATIENCE)
            return got

    use_plain_stages(monkeypatch)
    source = Asleep(frames=1)
    source.put(count=1)
    root = tree.add_input("input", source, 1, 1.0, 1.0)
    child = tree.add("preProc", "child", "input")
    assert asked.wait(PATIENCE)
    listener.wait_blocks(child, 1)
    tree.stop()
    assert listener.ends == [child, root]
    assert not root.join(0.0)
    answer.set()
    assert root.join(PATIENCE)


def test_a_listener_that_is_slow_is_told_last(
    tree: Tree, feed: Feed, listener: Stubborn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What hangs on the processor does not wait for it."""
    told: list[str] = []

    def released(self: Stubborn, processor: Processor, block: Block) -> None:
        told.append(processor.name)
        if processor.name == "slow":
            processor._publish_seconds = 1.0
        Recorder.on_released(self, processor, block)

    use_plain_stages(monkeypatch)
    monkeypatch.setattr(Stubborn, "on_released", released)
    tree.add_input("input", feed, 1, 1.0, 1.0)
    slow = tree.add("preProc", "slow", "input")
    below = tree.add("gammatone", "below", "slow")
    slow._publish_seconds = 1.0
    feed.put(count=1)
    listener.wait_blocks(slow, 1)
    listener.wait_blocks(below, 1)
    assert told == ["input", "below", "slow"]


# --- threads ---


def test_threads_come_with_the_first_processor_and_go_with_the_last(tree: Tree, listener: Stubborn) -> None:
    assert tree_threads() == set()
    for _ in range(20):
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


def test_a_stop_and_a_new_beginning_at_the_same_time(listener: Stubborn, monkeypatch: pytest.MonkeyPatch) -> None:
    """The threads of the old tree may not have ended yet when they are wanted again."""
    use_plain_stages(monkeypatch)
    tree = Tree(listener, 2)
    for _ in range(200):
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


def test_a_listener_asks_the_tree(tree: Tree, feed: Feed, listener: Stubborn, monkeypatch: pytest.MonkeyPatch) -> None:
    """A listener may not wait for the tree; but it may ask it."""
    answers: list[Any] = []

    def executed(self: Stubborn, processor: Processor, seconds: float) -> None:
        answers.append(tree.dependencies(processor.name))

    monkeypatch.setattr(Stubborn, "on_executed", executed)
    tree.add_input("input", feed, 1, 1.0, 1.0)
    child = tree.add("preProc", "child", "input")
    feed.put(count=1)
    listener.wait_blocks(child, 1)
    assert answers == [["input"], ["input", "child"]]
