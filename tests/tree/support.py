"""Sources, listeners and stages for tests of the tree, with outputs that identify their inputs."""

from __future__ import annotations

import collections
import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from rosafe.dsp.stage import Stage
from rosafe.representations import KINDS, STAGES
from rosafe.tree.block import Block
from rosafe.tree.processor import Processor
from rosafe.tree.tree import Tree
from tests.harness import PATIENCE

RATE = 16000.0


class Feed:
    """A source of the blocks that the test puts in. By default, frame n has the value n in both ears."""

    def __init__(self, rate: float = RATE, frames: int = 160) -> None:
        self.sample_rate = rate
        self.frames = frames
        self.ended = self.stopped = False
        self._at = 0
        self._blocks: collections.deque[np.ndarray] = collections.deque()
        self._wake: Callable[[], None] = lambda: None

    def put(self, *blocks: np.ndarray, count: int = 0) -> None:
        """Add `blocks`, or `count` blocks of numbered frames."""
        for _ in range(count):
            numbers = np.arange(self._at, self._at + self.frames, dtype=float)
            self._blocks.append(np.stack((numbers, numbers)))
            self._at += self.frames
        self._blocks.extend(blocks)
        self._wake()

    def end(self) -> None:
        """Mark the end of the source."""
        self.ended = True
        self._wake()

    def open(self, wake: Callable[[], None], required_frames: Callable[[], float]) -> None:
        self._wake = wake

    def read(self) -> tuple[np.ndarray, int] | None:
        if self.stopped or not self._blocks:
            return None
        block = self._blocks.popleft()
        return block, int(block[0, -1]) + 1 if block.size else 0

    @property
    def waiting(self) -> bool:
        return not (self._blocks or self.ended)

    def stop(self) -> None:
        self.ended = self.stopped = True


class Recorder:
    """A listener that records all calls, and for which the test can wait."""

    def __init__(self) -> None:
        self.processors: list[Processor] = []
        self.blocks: dict[Processor, list[Block]] = {}
        self.ends: list[Processor] = []
        self.late: list[Processor] = []  # that released a block after their end
        self._called = threading.Condition()

    def on_added(self, processor: Processor) -> None:
        with self._called:
            self.processors.append(processor)
            self.blocks[processor] = []

    def on_executed(self, processor: Processor, seconds: float) -> None:
        pass

    def on_released(self, processor: Processor, block: Block) -> None:
        with self._called:
            if processor in self.ends:
                self.late.append(processor)
            self.blocks[processor].append(block)
            self._called.notify_all()

    def on_removed(self, processor: Processor) -> None:
        with self._called:
            self.ends.append(processor)
            self._called.notify_all()

    def forget(self) -> None:
        """Drop all records except the processors that have not ended."""
        with self._called:
            self.processors = [processor for processor in self.processors if processor not in self.ends]
            self.blocks = {processor: [] for processor in self.processors}
            self.ends.clear()

    def wait(self, condition: Callable[[], Any]) -> None:
        """Wait until `condition()` holds after a call."""
        with self._called:
            assert self._called.wait_for(condition, PATIENCE), f"not within {PATIENCE:g} s"

    def wait_blocks(self, processor: Processor, count: int) -> None:
        """Wait until `processor` has released `count` blocks in total."""
        self.wait(lambda: len(self.blocks[processor]) >= count)

    def data(self, processor: Processor) -> np.ndarray:
        """Return all released blocks, joined."""
        return np.concatenate([block.data for block in self.blocks[processor]], axis=-1)


class Plain(Stage):
    """A stage of any kind, with any parameters, that returns its input."""

    def process(self, block: np.ndarray, extra: np.ndarray | None = None, out: np.ndarray | None = None) -> np.ndarray:
        return self.compute(block)

    def compute(self, block: np.ndarray) -> np.ndarray:
        return block

    def _checked_values(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        return {**self.values, **changes}


def tree_threads() -> set[threading.Thread]:
    """Return the threads of all trees."""
    return {thread for thread in threading.enumerate() if thread.name.startswith("rosafe ")}


def use_plain_stages(patch: pytest.MonkeyPatch, **stages: type[Plain]) -> None:
    """Let the tree create `Plain` stages, or the given ones, for all kinds."""
    for kind, representation in KINDS.items():
        base = stages.get(kind, Plain)
        patch.setitem(STAGES, kind, type(base.__name__, (base,), {"REPRESENTATION": representation}))


DEFAULT_TREE = (
    ("preProc", "input"),
    ("gammatone", "preProc"),
    ("ihc", "gammatone"),
    ("ild", "ihc"),
    ("ratemap", "ihc"),
    ("crossCorrelation", "ihc"),
)
CHANNELS = {"fb_highFreqHz": 4000.0, "fb_nChannels": 5}


def grow(tree: Tree, feed: Feed) -> None:
    """Build the tree of the guide: one processor of each kind, named after it. Samples are not scaled."""
    tree.add_input("input", feed, feed.frames, 1.0, 1.0, {"in_doNormalize": False})
    for kind, parent in DEFAULT_TREE:
        tree.add(kind, kind, parent, CHANNELS if kind == "gammatone" else {})


def end(tree: Tree, listener: Recorder) -> None:
    """Stop the tree and check that all threads have ended."""
    tree.stop()
    for processor in listener.processors:
        assert processor.join(PATIENCE), f"{processor!r} is still running"
    tree.join()
    assert not tree_threads(), tree_threads()
    assert listener.late == []
