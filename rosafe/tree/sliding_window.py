"""Sliding windows over released blocks: references to the blocks, no copies until somebody looks.

Released blocks are never written again, so a window is just the newest blocks. What it looked like at one moment is a
`WindowView`, which stays valid whatever comes later.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray

MAX_PIECES = 128  # beyond that, the pieces of a window are joined, so that small blocks in long windows stay cheap


def frames_in(seconds: float, rate: float) -> int:
    """Whole frames in so many seconds; a hair less than a whole number is that number (0.29 s at 100 Hz are 29)."""
    return math.floor(seconds * rate + 1e-9)


@dataclass(frozen=True)
class WindowView:
    """One moment of a window: pieces of equal leading shape, one after the other along the last axis.

    The first `skip` frames of the first piece lie outside.
    """

    pieces: tuple[FloatArray, ...]
    skip: int = 0

    @classmethod
    def of(cls, array: FloatArray) -> WindowView:
        """A view of one array of shape (..., frames)."""
        return cls((array,))

    @property
    def frames(self) -> int:
        return sum(piece.shape[-1] for piece in self.pieces) - self.skip

    @property
    def shape(self) -> tuple[int, ...]:
        """(..., frames)"""
        return (*self.pieces[0].shape[:-1], self.frames)

    def select(self, row: int) -> WindowView:
        """The part at `row` of the first axis, such as one ear."""
        return WindowView(tuple(piece[row] for piece in self.pieces), self.skip)

    def swap_rows(self) -> WindowView:
        """The first two axes exchanged, such as [channel][lag] to the port's [lag][channel]."""
        return WindowView(tuple(piece.swapaxes(0, 1) for piece in self.pieces), self.skip)

    def trimmed(self) -> list[FloatArray]:
        """The pieces without what lies outside, oldest first."""
        return [self.pieces[0][..., self.skip :], *self.pieces[1:]]

    def copy_to(self, target: FloatArray) -> None:
        """Write all frames into `target`, whose shape is `shape`."""
        at = 0
        for part in self.trimmed():
            target[..., at : at + part.shape[-1]] = part
            at += part.shape[-1]

    def array(self) -> FloatArray:
        """All frames in one fresh array."""
        joined = np.empty(self.shape)
        self.copy_to(joined)
        return joined


class RecentFrames:
    """The newest frames of a signal.

    Parameters
    ----------
    first : ndarray (*rows, n)
        What is there before anything comes.
    capacity : int
        How many frames are kept, at least 0.
    """

    def __init__(self, first: FloatArray, capacity: int) -> None:
        self.capacity = capacity
        self.frames = first.shape[-1]  # that there are, besides some in the first piece that nobody needs
        self._pieces = [first]

    @property
    def rows(self) -> tuple[int, ...]:
        """Leading shape of the blocks."""
        return self._pieces[0].shape[:-1]

    def append(self, block: FloatArray) -> None:
        """Put `block`, of shape (*rows, n), at the end. The block must not be written again."""
        if block.shape[-1] == 0:
            return
        self._pieces.append(block)
        self.frames += block.shape[-1]
        while len(self._pieces) > 1 and self.frames - self._pieces[0].shape[-1] >= self.capacity:
            self.frames -= self._pieces.pop(0).shape[-1]
        if len(self._pieces) > MAX_PIECES:
            self._pieces = [self.view(self.capacity).array()]
            self.frames = self._pieces[0].shape[-1]

    def view(self, frames: int) -> WindowView:
        """The newest `frames`, or as many as there are of these."""
        skip, first = max(0, self.frames - min(frames, self.capacity)), 0
        while first < len(self._pieces) - 1 and skip >= self._pieces[first].shape[-1]:
            skip -= self._pieces[first].shape[-1]
            first += 1
        return WindowView(tuple(self._pieces[first:]), skip)


class SlidingWindow:
    """The newest `frames` frames of a signal; before there are so many, zeros come first (as on an output port).

    Parameters
    ----------
    rows : tuple of int
        Leading shape of the blocks, such as (2, channels).
    frames : int
        Length of the window, at least 0.
    """

    def __init__(self, rows: tuple[int, ...], frames: int) -> None:
        self.rows = rows
        self.frames = frames
        # rows of one row, which is nowhere before somebody writes to it
        self._newest = RecentFrames(np.broadcast_to(np.zeros(frames), (*rows, frames)), frames)

    def append(self, block: FloatArray) -> None:
        """Shift left and put `block`, of shape (*rows, n), at the end. The block must not be written again."""
        self._newest.append(block)

    def view(self) -> WindowView:
        """The window as it is now: `frames` frames, newest last."""
        return self._newest.view(self.frames)
