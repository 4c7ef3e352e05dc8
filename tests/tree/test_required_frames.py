"""The frames of sound that the tree requires before the next awaited output: a source may combine blocks until then."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from rosafe.tree.tree import Tree
from tests.harness import PATIENCE

from .support import DEFAULT_TREE, RATE, Feed, Recorder, end, grow

HOP, WINDOW = round(0.01 * RATE), round(0.02 * RATE)


class Asking(Feed):
    """A source that knows how many frames the tree requires."""

    required_frames: Callable[[], float]

    def open(self, wake: Callable[[], None], required_frames: Callable[[], float]) -> None:
        super().open(wake, required_frames)
        self.required_frames = required_frames


@pytest.fixture
def feed() -> Asking:
    return Asking(frames=100)


@pytest.fixture
def grown(listener: Recorder, feed: Asking) -> Iterator[Tree]:
    """The default tree. No output is awaited."""
    tree = Tree(listener, 1)
    grow(tree, feed)
    for processor in tree.processors:
        processor.awaited = False
    yield tree
    end(tree, listener)


def required(tree: Tree, feed: Asking) -> float:
    """Return the number of frames that are required when all blocks are processed."""
    assert tree.wait_idle(PATIENCE)
    return feed.required_frames()


def test_the_next_frame_of_the_awaited_outputs(grown: Tree, feed: Asking, listener: Recorder) -> None:
    """Each frame is output with the block that contains the last required frame, and with no earlier one."""
    feed.put(count=1)
    assert required(grown, feed) == math.inf
    grown.find("ild").awaited = True
    arrived = 100
    for size in (WINDOW - 101, 1, 1, HOP - 2, 1, 3 * HOP, 77, HOP - 77):
        expected = WINDOW if arrived < WINDOW else arrived + HOP - (arrived - WINDOW) % HOP
        assert required(grown, feed) == expected
        feed.put(np.zeros((2, size)))
        arrived += size
    assert required(grown, feed) == arrived + HOP
    frames = [block.data.shape[-1] for block in listener.blocks[grown.find("ild")]]
    assert frames == [0, 0, 1, 0, 0, 1, 3, 0, 1]
    grown.modify("ratemap", "rm_hSizeSec", "0.001")
    grown.find("ratemap").awaited = True
    assert required(grown, feed) == arrived + 1, "the change waits for the next block"


@pytest.mark.parametrize("name", ["input", "ihc"])
def test_each_block_completes_samples(grown: Tree, feed: Asking, name: str) -> None:
    grown.find("ild").awaited = grown.find(name).awaited = True
    feed.put(count=3)
    assert required(grown, feed) == 301


def test_observers_see_each_block(grown: Tree, feed: Asking) -> None:
    feed.put(count=1)
    assert required(grown, feed) == math.inf
    stop = grown.observe(lambda processor, state, number: None)
    assert required(grown, feed) == 0
    stop()
    assert required(grown, feed) == math.inf


def test_all_outputs_are_awaited_by_default(listener: Recorder, feed: Asking) -> None:
    tree = Tree(listener, 1)
    grow(tree, feed)
    assert required(tree, feed) == 1
    assert {processor.name for processor in tree.processors if processor.awaited} == {
        "input",
        *(kind for kind, _ in DEFAULT_TREE),
    }
    end(tree, listener)
