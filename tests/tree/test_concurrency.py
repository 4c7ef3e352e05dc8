"""The tree with real threads: processors that compute concurrently, and complete blocks in order."""

from __future__ import annotations

import contextlib
import gc
import random
import sys
import threading
import weakref
from dataclasses import dataclass

import numpy as np
import pytest

from rosafe.interface import ComponentError
from rosafe.tree.health import ProcessorHealth
from rosafe.tree.processor import Processor
from rosafe.tree.states import State
from rosafe.tree.tree import Tree
from tests.harness import PATIENCE, wait_for

from .support import Feed, Plain, Recorder, end, use_plain_stages

FRAMES = 1
WORKERS = 4  # enough for all concurrent processors, on any machine


def test_children_read_the_parents_memory(
    tree: Tree, listener: Recorder, feed: Feed, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_plain_stages(monkeypatch)
    tree.add_input("input", feed, 1, 1.0, 1.0)
    one, other = (tree.add("preProc", name, "input") for name in ("one", "other"))
    block = np.ones((2, 5))
    feed.put(block)
    for child in (one, other):
        listener.wait_blocks(child, 1)
        assert listener.blocks[child][0].data is block


def test_a_block_without_consumers_is_freed_when_the_children_are_finished(
    tree: Tree, listener: Recorder, feed: Feed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its memory is reused for the next block while it is in the cache. With consumers, the last block is kept."""
    created: list[weakref.ref[np.ndarray]] = []

    class Parent(Plain):
        def compute(self, block: np.ndarray) -> np.ndarray:
            output = block.copy()
            created.append(weakref.ref(output))
            return output

    class Child(Plain):
        def compute(self, block: np.ndarray) -> np.ndarray:
            return np.empty((2, 0))

    use_plain_stages(monkeypatch, preProc=Parent, gammatone=Child)
    tree.add_input("input", feed, 1, 1.0, 1.0)
    parent = tree.add("preProc", "parent", "input")
    children = [tree.add("gammatone", name, "parent") for name in ("one", "other")]
    for count, consumed in ((2, False), (4, True)):
        parent.has_consumers = consumed
        feed.put(count=2)
        for child in children:
            listener.wait_blocks(child, count)
        if not consumed:
            wait_for(lambda: all(block() is None for block in created), what="all blocks freed")
    last = created[-1]()
    assert last is not None
    np.testing.assert_array_equal(last, [[3.0], [3.0]])
    latest = tree.add("gammatone", "latest", "parent")
    listener.wait_blocks(latest, 1)


def test_consumers_that_come_between_release_and_publication_get_the_next_block(
    tree: Tree, listener: Recorder, feed: Feed, monkeypatch: pytest.MonkeyPatch
) -> None:
    def add_consumers(processor: Processor, seconds: float) -> None:
        processor.has_consumers = True

    use_plain_stages(monkeypatch)
    monkeypatch.setattr(listener, "on_executed", add_consumers)  # called between the two
    tree.add_input("input", feed, 1, 1.0, 1.0)
    pre = tree.add("preProc", "pre", "input")
    pre.has_consumers = False
    feed.put(count=2)
    listener.wait_blocks(pre, 1)
    assert [block.number for block in listener.blocks[pre]] == [1]
    assert pre.error is None


def test_removed_processors_are_freed_without_garbage_collection(feed: Feed, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each may have tens of MB, and Python looks for reference cycles only after very many allocations."""
    use_plain_stages(monkeypatch)
    listener = Recorder()
    tree = Tree(listener, 1)
    tree.add_input("input", feed, 1, 1.0, 1.0)
    for name, kind, parent in (("pre", "preProc", "input"), ("bank", "gammatone", "pre"), ("cells", "ihc", "bank")):
        tree.add(kind, name, parent)
    feed.put(count=3)
    listener.wait_blocks(tree.find("cells"), 3)
    objects = [weakref.ref(one) for p in listener.processors for one in (p, p.history)]
    gc.disable()
    try:
        end(tree, listener)
        listener.forget()
        feed.open(lambda: None, lambda: 0)
        assert [one() for one in objects if one() is not None] == []
    finally:
        gc.enable()


def test_failed_processors_are_freed_without_garbage_collection(feed: Feed, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their errors are kept; frames of their tracebacks refer to them, their blocks and their parents."""

    @dataclass(frozen=True)
    class FrozenError(Exception):
        """It accepts no assignment, not even of its traceback."""

        reason: str

    class Faulty(Plain):
        def compute(self, block: np.ndarray) -> np.ndarray:
            try:
                raise FrozenError("the cause")
            except FrozenError as problem:
                raise problem from problem

    use_plain_stages(monkeypatch, ihc=Faulty)
    listener = Recorder()
    lines: list[str] = []
    tree = Tree(listener, 1)
    health = ProcessorHealth(tree, lines.append, lines.append)
    monkeypatch.setattr(listener, "on_removed", health.ended)
    gc.disable()
    try:
        tree.add_input("input", feed, 1, 1.0, 1.0)
        for name, kind, parent in (("pre", "preProc", "input"), ("bank", "gammatone", "pre"), ("cells", "ihc", "bank")):
            tree.add(kind, name, parent)
        failed = weakref.ref(tree.find("cells"))
        parents = [weakref.ref(tree.find(name)) for name in ("pre", "bank")]
        feed.put(count=1)
        wait_for(lambda: "cells" not in [one.name for one in tree.processors])
        tree.remove("pre")
        listener.processors.clear()
        listener.blocks.clear()
        wait_for(lambda: [one() for one in (failed, *parents)] == [None] * 3)
    finally:
        gc.enable()
        tree.stop()
        tree.join()
    assert len(lines) == 1 and "in compute" in lines[0] and "FrozenError: the cause" in lines[0]


def test_the_four_states(tree: Tree, listener: Recorder, feed: Feed, monkeypatch: pytest.MonkeyPatch) -> None:
    working, go_on = threading.Event(), threading.Event()

    class Slow(Plain):
        def compute(self, block: np.ndarray) -> np.ndarray:
            working.set()
            assert go_on.wait(PATIENCE)
            return block

    use_plain_stages(monkeypatch, gammatone=Slow)
    root = tree.add_input("input", feed, 1, 1.0, 1.0)
    parent = tree.add("preProc", "parent", "input")
    child = tree.add("gammatone", "child", "parent")
    assert [p.state for p in (root, parent, child)] == [State.WAIT_EXEC] * 3
    feed.put(count=1)
    assert working.wait(PATIENCE)
    assert child.state is State.EXEC
    wait_for(lambda: parent.state is State.WAIT_EXEC)
    feed.put(count=1)
    wait_for(lambda: parent.state is State.WAIT_RELEASE)  # its child still has the last block
    assert child.state is State.EXEC
    states: set[State] = set()
    monkeypatch.setattr(Recorder, "on_released", lambda self, processor, block: states.add(processor.state))
    go_on.set()
    wait_for(lambda: [p.state for p in (root, parent, child)] == [State.WAIT_EXEC] * 3)
    assert states == {State.RELEASE}
    tree.stop()
    assert [p.state for p in (root, parent, child)] == [State.REMOVED] * 3


def test_blocks_are_complete_and_in_order_while_processors_are_added_and_removed(
    tree: Tree, listener: Recorder, feed: Feed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Computations of random length, frequent thread switches, and two clients that add and remove processors."""
    dice = random.Random(1)

    class Erratic(Plain):
        def compute(self, block: np.ndarray) -> np.ndarray:
            for _ in range(dice.choice((0, 0, 10, 300))):
                pass
            return block

    use_plain_stages(monkeypatch, **dict.fromkeys(("input", "preProc", "gammatone", "ihc", "ild"), Erratic))
    levels = ("preProc", "gammatone", "ihc", "ild")
    tree.add_input("input", feed, 1, 1.0, 1.0)
    tree.add("preProc", "constant", "input")
    errors: list[BaseException] = []

    def user(seed: int) -> None:
        random_numbers = random.Random(seed)
        try:
            for step in range(150):
                names = [p.name for p in tree.processors if p.name.startswith(f"{seed}-")]
                if names and random_numbers.random() < 0.4:
                    with contextlib.suppress(ComponentError):  # the other client has removed its parent
                        tree.remove(random_numbers.choice(names))
                    continue
                parent = random_numbers.choice([p for p in tree.processors if p.kind != "ild"])
                kind = levels[0] if parent.kind == "input" else levels[levels.index(parent.kind) + 1]
                try:
                    tree.add(kind, f"{seed}-{step}", parent.name)
                except ComponentError as problem:  # the other client was faster
                    assert problem.ex.endswith("e_noUpperDependencie")
        except BaseException as problem:  # checked below
            errors.append(problem)

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        feed.put(count=2000)
        users = [threading.Thread(target=user, args=(seed,)) for seed in (1, 2)]
        for one in users:
            one.start()
        for one in users:
            one.join()
        feed.end()
        alive = tree.processors
        for processor in alive:
            assert processor.join(PATIENCE), f"{processor!r} hangs"
    finally:
        sys.setswitchinterval(interval)
    assert errors == []
    assert len(listener.processors) > 100
    for processor in listener.processors:
        assert processor.error is None
        if listener.blocks[processor]:
            numbers = listener.data(processor)[0]
            np.testing.assert_array_equal(numbers, np.arange(numbers[0], numbers[-1] + 1))
            if processor in alive:
                assert numbers[-1] == 1999
        else:
            assert processor not in alive or processor.parent not in alive
