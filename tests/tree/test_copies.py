"""Copies of the output in the default tree: each sample is copied at most once, for history and port together."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from rosafe.tree.block import Block
from rosafe.tree.processor import Processor
from rosafe.tree.sliding_window import MAX_PIECES, MIN_PIECE_BYTES, SlidingWindow
from rosafe.tree.tree import Tree

from .support import DEFAULT_TREE, Feed, Recorder, end, grow

SECONDS = 1.5  # longer than the histories and ports of 1 s


class Subscriber(Recorder):
    """A listener that gets the window of the port after each block, as for a topic with subscribers."""

    def on_released(self, processor: Processor, block: Block) -> None:
        processor.history.port_window()
        super().on_released(processor, block)


@pytest.mark.parametrize("subscribed", [False, True])
@pytest.mark.parametrize("frames", [10, 220, 882, 2205, 12000])
def test_each_sample_is_copied_at_most_once(frames: int, subscribed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    arrived: Counter[SlidingWindow] = Counter()
    copied: Counter[SlidingWindow] = Counter()
    written: dict[int, tuple[np.ndarray, int]] = {}  # each buffer, and how many of its bytes were counted
    append = SlidingWindow.append

    def counted_append(self: SlidingWindow, block: np.ndarray) -> None:
        append(self, block)
        arrived[self] += block.nbytes
        piece = self._pieces[-1]
        if block.size and piece is not block:
            buffer = piece if piece.base is None else piece.base
            copied[self] += piece.nbytes - written.get(id(buffer), (buffer, 0))[1]
            written[id(buffer)] = buffer, piece.nbytes

    monkeypatch.setattr(SlidingWindow, "append", counted_append)
    feed, listener = Feed(frames=frames), Subscriber() if subscribed else Recorder()
    tree = Tree(listener, workers=1)
    grow(tree, feed)
    blocks = -(-int(SECONDS * feed.sample_rate) // frames)
    feed.put(count=blocks)
    for processor in tree.processors:
        listener.wait_blocks(processor, blocks)
        processor.history.port_window()
    assert len(arrived) == 1 + len(DEFAULT_TREE), "each has one part"
    for window, count in arrived.items():
        assert copied[window] <= count, f"{copied[window]} of {count} bytes with rows {window.rows}"
        if count >= MIN_PIECE_BYTES * blocks and blocks <= MAX_PIECES:
            assert copied[window] == 0, "long blocks are not copied at all"
    assert frames > 882 or sum(copied.values()) > 0, "short blocks are joined"
    end(tree, listener)
