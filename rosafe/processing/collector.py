"""Collects the released blocks of an output into one array."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from rosafe.dsp import kernels

_EMPTY = np.empty(0)


class OutputCollector:
    """Collects the blocks of one output in one array, to which each block is written immediately.

    Parameters
    ----------
    whole : ndarray, (..., frames)
        The array for all frames, if no parameter change alters the shape. After such a change, blocks are kept until
        the end.
    middle : int
        The axis that is aligned at its middle if a change alters its length; -1 for none.
    """

    MIN_WRITE_FRAMES = 32  # small blocks are written together: writing single columns takes many times as long

    def __init__(self, whole: np.ndarray, middle: int) -> None:
        self._middle = middle
        self._whole = whole
        self._rows = self._whole.shape[:-1]
        self._filled = 0  # frames
        self._started = False  # whether `_filled` frames have the rows of `_whole`; a block without frames has rows too
        self._pending: list[np.ndarray] = []
        self._pending_frames = 0
        self._fits = True
        self._output_slice: np.ndarray | None = None

    def allocate(self, frames: int) -> np.ndarray | None:
        """Return the part of the array for the next block, if a stage can write a block of `frames` frames there."""
        end = self._filled + frames
        free = self._fits and not self._pending and end <= self._whole.shape[-1] and self._whole.dtype == np.float64
        self._output_slice = self._whole[..., self._filled : end] if free else None
        return self._output_slice

    def add(self, block: np.ndarray) -> None:
        """Add the next block, (..., frames)."""
        if block is self._output_slice:
            self._filled, self._started, self._output_slice = self._filled + block.shape[-1], True, None
            return
        if block.shape[:-1] != self._rows:
            self._fits = False
        self._pending.append(block)
        self._pending_frames += block.shape[-1]
        if self._pending_frames >= self.MIN_WRITE_FRAMES and self._fits:
            self._write()

    def _write(self) -> None:
        end = self._filled + self._pending_frames
        if end <= self._whole.shape[-1]:
            kernels.concatenate(self._pending, self._whole[..., self._filled : end])
            self._pending, self._filled, self._pending_frames, self._started = [], end, 0, True

    def joined(self) -> np.ndarray:
        """Return the array of all blocks, and drop it here, so that other references to this object do not hold it."""
        if self._pending and self._fits:
            self._write()
        whole, pending, self._whole, self._pending, self._output_slice = self._whole, self._pending, _EMPTY, [], None
        if not pending and self._filled == whole.shape[-1]:
            return whole
        first = [whole[..., : self._filled]] if self._started else []
        return _join(self._middle, [*first, *pending]).astype(whole.dtype, copy=False)


def _join(middle: int, blocks: list[np.ndarray]) -> np.ndarray:
    """Join blocks along the last axis. If their leading shapes differ, the result has the largest, padded with 0.

    Blocks are aligned at the middle of the axis `middle`, and at the first element of other axes.
    """
    if all(block.shape[:-1] == blocks[0].shape[:-1] for block in blocks):
        return np.concatenate(blocks, axis=-1)
    shape = tuple(max(lengths) for lengths in zip(*(block.shape[:-1] for block in blocks), strict=True))
    joined = np.zeros((*shape, sum(block.shape[-1] for block in blocks)))
    end = 0
    for block in blocks:
        region = [slice(0, length) for length in block.shape]
        region[-1] = slice(end, end := end + block.shape[-1])
        if middle >= 0:
            first = (shape[middle] - block.shape[middle]) // 2
            region[middle] = slice(first, first + block.shape[middle])
        joined[tuple(region)] = block
    return joined


def allocate_branches(shapes: list[tuple[int, ...]], axes: tuple[str, ...], dtype: np.dtype[Any]) -> list[np.ndarray]:
    """Return an array for each branch, all of them parts of one array along the channels."""
    if len(shapes) == 1:
        return [np.empty(shapes[0], dtype)]
    channel = axes.index("channel")
    ends = list(itertools.accumulate(shape[channel] for shape in shapes))
    whole = np.empty((*shapes[0][:channel], ends[-1], *shapes[0][channel + 1 :]), dtype)
    return np.split(whole, ends[:-1], axis=channel)


def join_branches(branches: list[OutputCollector]) -> np.ndarray:
    """Return the one array that the branches from `allocate_branches` have filled."""
    joined = [branch.joined() for branch in branches]
    if len(joined) == 1:
        return joined[0]
    whole = joined[0].base
    assert whole is not None and all(one.base is whole for one in joined)
    return whole
