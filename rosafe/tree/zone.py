"""The token protocol between a processor and its children: a shared zone that holds one released block.

Pure state, no threads: `Processor` calls it under the tree's lock. A parent may release only while nobody holds a
token of the last block; every child then gets a token of its own, takes the block with it, and gives it back when done.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Block:
    """What one processor released: never written again.

    Attributes
    ----------
    number : int
        Counts the input's blocks from 0.
    data : ndarray
        Samples or frames along the last axis.
    next_index : int
        Index of the audio frame after the last one that this block knows of.
    rate : float
        Frames of `data` per second.
    envelope : ndarray or None
        The filterbank's envelope, same shape as `data`, where a child has asked for it.
    """

    number: int
    data: np.ndarray
    next_index: int
    rate: float
    envelope: np.ndarray | None = None


class SharedZone:
    """One block, read by all children without copying, and a token per child."""

    def __init__(self) -> None:
        self.block: Block | None = None
        self._closed = False  # nothing will be released any more
        self._children: set[Hashable] = set()
        self._fresh: set[Hashable] = set()  # tokens handed out and not taken yet
        self._held: set[Hashable] = set()  # children that have not given the block back

    def attach(self, child: Hashable) -> None:
        """A new child; it begins with the block released last, if there is one."""
        self._children.add(child)
        if self.block is not None:
            self._fresh.add(child)
            self._held.add(child)

    def detach(self, child: Hashable) -> None:
        """Forget a child and the token it may hold."""
        for group in (self._children, self._fresh, self._held):
            group.discard(child)

    @property
    def free(self) -> bool:
        """Whether all children have given the last block back."""
        return not self._held

    def release(self, block: Block) -> None:
        """Publish `block` and hand every child a token. Only while `free`."""
        if self._held:
            raise RuntimeError("released while a child holds the last block")
        self.block = block
        self._fresh = set(self._children)
        self._held = set(self._children)

    def close(self) -> None:
        """Nothing more will be released; the last block may still be taken."""
        self._closed = True

    def has_token(self, child: Hashable) -> bool:
        """Whether a block waits for `child`."""
        return child in self._fresh

    def take(self, child: Hashable) -> Block:
        """The block that waits for `child`; it stays locked until `give_back`."""
        self._fresh.remove(child)
        assert self.block is not None
        return self.block

    def give_back(self, child: Hashable) -> None:
        """`child` has read the block (or is gone)."""
        self._held.discard(child)

    def exhausted(self, child: Hashable) -> bool:
        """Whether nothing will ever come for `child` again."""
        return self._closed and child not in self._fresh
