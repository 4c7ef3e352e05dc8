"""Sliding windows and histories over released blocks: references to the blocks, no copies until somebody looks.

Released blocks are never written again, so a window is just the newest blocks. What it looked like at one moment is a
`WindowView`, which stays valid whatever comes later.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

MAX_PIECES = 128  # beyond that, the pieces of a window are joined, so that small blocks in long windows stay cheap


def frames_in(seconds: float, rate: float) -> int:
    """Whole frames in so many seconds; a hair less than a whole number is that number (0.29 s at 100 Hz are 29)."""
    return math.floor(seconds * rate + 1e-9)


@dataclass(frozen=True)
class WindowView:
    """One moment of a window: pieces of equal leading shape, one after the other along the last axis.

    The first `skip` frames of the first piece lie outside.
    """

    pieces: tuple[np.ndarray, ...]
    skip: int = 0

    @classmethod
    def of(cls, array: np.ndarray) -> WindowView:
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

    def trimmed(self) -> list[np.ndarray]:
        """The pieces without what lies outside, oldest first."""
        return [self.pieces[0][..., self.skip :], *self.pieces[1:]]

    def copy_to(self, target: np.ndarray) -> None:
        """Write all frames into `target`, whose shape is `shape`."""
        at = 0
        for part in self.trimmed():
            target[..., at : at + part.shape[-1]] = part
            at += part.shape[-1]

    def array(self) -> np.ndarray:
        """All frames in one fresh array."""
        joined = np.empty(self.shape)
        self.copy_to(joined)
        return joined


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
        self._pieces: list[np.ndarray] = [np.broadcast_to(np.zeros(frames), (*rows, frames))]
        self._skip = 0

    def append(self, block: np.ndarray) -> None:
        """Shift left and put `block`, of shape (*rows, n), at the end. The block must not be written again."""
        if block.shape[-1] == 0:
            return
        self._pieces.append(block)
        self._skip += block.shape[-1]
        while len(self._pieces) > 1 and self._skip >= self._pieces[0].shape[-1]:
            self._skip -= self._pieces.pop(0).shape[-1]
        if len(self._pieces) > MAX_PIECES:
            self._pieces, self._skip = [self.view().array()], 0

    def view(self) -> WindowView:
        """The window as it is now: `frames` frames, newest last."""
        return WindowView(tuple(self._pieces), self._skip)


class History:
    """What a processor put out since somebody last asked, at most the newest `seconds`.

    Parameters
    ----------
    rows : tuple of int
        Leading shape of the blocks.
    rate : float
        Frames per second.
    seconds : float
        Its length.
    """

    def __init__(self, rows: tuple[int, ...], rate: float, seconds: float) -> None:
        self.rows = rows
        self.rate = rate
        self.seconds = seconds
        self.capacity = frames_in(seconds, rate)
        self._pieces: list[np.ndarray] = []
        self._frames = 0

    def append(self, block: np.ndarray) -> None:
        """Add `block` of shape (*rows, n); what no longer fits is forgotten. The block must not be written again."""
        if block.shape[-1] == 0:
            return
        self._pieces.append(block)
        self._frames += block.shape[-1]
        while self._pieces and self._frames - self._pieces[0].shape[-1] >= self.capacity:
            self._frames -= self._pieces.pop(0).shape[-1]
        if len(self._pieces) > MAX_PIECES:
            self._pieces = [self._view().array()]
            self._frames = self._pieces[0].shape[-1]

    def _view(self) -> WindowView:
        return WindowView(tuple(self._pieces), max(0, self._frames - self.capacity))

    def take(self) -> WindowView:
        """Everything since the last `take`, oldest first; shape (*rows, 0) where nothing is new."""
        if not self._pieces:
            return WindowView.of(np.empty((*self.rows, 0)))
        view = self._view()
        self._pieces, self._frames = [], 0
        return view
