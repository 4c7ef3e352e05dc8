"""What a processor put out lately, for several readers: each gets what has come since it was there last."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rosafe.dsp.signal_format import SignalFormat
from rosafe.tree.block import Block
from rosafe.tree.sliding_window import RecentFrames, WindowView, frames_in


class HistorySlice(NamedTuple):
    """What a reader got."""

    parts: tuple[WindowView, ...]
    next_index: int  # of the audio frame after the newest one that this knows of
    signal: SignalFormat


class History:
    """The newest `seconds` of a processor's output, and how far each reader has read. Safe from any thread.

    Parameters
    ----------
    part_rows : sequence of tuple of int
        Leading shape of each part.
    signal : Signal
        Its format.
    seconds : float
        Its length, which may be changed.
    """

    def __init__(self, part_rows: Sequence[tuple[int, ...]], signal: SignalFormat, seconds: float) -> None:
        self.seconds = seconds
        self.next_index = 0
        self._lock = threading.Lock()
        self._begin(tuple(part_rows), signal)

    def _begin(self, part_rows: tuple[tuple[int, ...], ...], signal: SignalFormat) -> None:
        """Forget what there was: frames of different shapes or rates do not go together."""
        self._signal = signal
        self._parts = [RecentFrames(np.empty((*rows, 0)), 0) for rows in part_rows]
        self._came = 0  # frames in all
        self._read: dict[str, int] = {}  # how many of them had come when a reader was there

    def append(self, block: Block) -> None:
        """Remember a block."""
        if not self.seconds:
            self.next_index = block.next_index
            return
        with self._lock:
            rows = tuple(part.shape[:-1] for part in block.parts)
            if block.signal is not self._signal:
                if block.signal.rate != self._signal.rate:
                    self._begin(rows, block.signal)
                self._signal = block.signal
            if rows != tuple(part.rows for part in self._parts):
                self._begin(rows, block.signal)
            self.next_index = block.next_index
            capacity = frames_in(self.seconds, block.signal.rate)
            for newest, part in zip(self._parts, block.parts, strict=True):
                newest.capacity = capacity
                newest.append(part)
            self._came += block.data.shape[-1]

    def read_new(self, reader: str) -> HistorySlice:
        """What has come since `reader` was here last, or since the start, as far as it is remembered."""
        with self._lock:
            fresh = self._came - self._read.get(reader, 0)
            self._read[reader] = self._came
            return HistorySlice(tuple(part.view(fresh) for part in self._parts), self.next_index, self._signal)
