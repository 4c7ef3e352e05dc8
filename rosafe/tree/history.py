"""The recent output of a processor, for its output port and for readers that get the output since their last call."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from rosafe.dsp.signal_format import SignalFormat
from rosafe.tree.block import Block
from rosafe.tree.sliding_window import SlidingWindow, WindowView, frames_in

# Short blocks are added to the windows together, when they are read at the latest.
MAX_PENDING = 8  # blocks
MAX_PENDING_BYTES = 2**18  # of the first part of a block: longer ones are added immediately


class HistorySlice(NamedTuple):
    """A part of the history, one view for each part of the output."""

    parts: tuple[WindowView, ...]
    next_index: int  # of the audio frame after the newest one that it depends on
    signal: SignalFormat


class History:
    """The newest output of a processor, and the position of each reader. Safe from any thread.

    Parameters
    ----------
    output_shapes : sequence of tuple of int
        Leading shape of each part.
    signal : SignalFormat
        The format of the output.
    seconds : float
        Maximum output for a reader, which may be changed.
    port_seconds : float
        Length of the window at the output port, which may be changed.
    """

    def __init__(
        self,
        output_shapes: Sequence[tuple[int, ...]],
        signal: SignalFormat,
        seconds: float,
        port_seconds: float = 0.0,
    ) -> None:
        self.seconds = seconds
        self.port_seconds = port_seconds
        self._next_index = 0
        self._pending: deque[Block] = deque()  # released, and not yet in the windows
        self._lock = threading.Lock()  # guards all attributes
        self._signal = signal
        self._frames = (0.0, 0)  # seconds and frames of the windows
        self._port_window: tuple[float, tuple[WindowView, ...]] = (-1.0, ())  # seconds, and views of them
        self._clear(output_shapes)

    def _clear(self, output_shapes: Sequence[tuple[int, ...]]) -> None:
        self._shapes = list(output_shapes)
        self._windows = [SlidingWindow(shape, self._frames[1]) for shape in output_shapes]
        self._port_window = (-1.0, ())
        self._appended = 0  # frames in total
        self._read: dict[str, int] = {}  # how many of them each reader has read

    def append(self, block: Block) -> None:
        """Append a block. One with another shape or frame rate than before clears the history first."""
        pending = self._pending
        pending.append(block)
        if len(pending) >= MAX_PENDING or block.parts[0].nbytes > MAX_PENDING_BYTES:
            with self._lock:
                self._add_pending()

    def _add_pending(self) -> None:
        """Add the pending blocks to the windows."""
        pending = self._pending
        while pending:
            block = pending.popleft()
            self._next_index = block.next_index
            seconds = max(self.seconds, self.port_seconds)
            if not seconds:
                continue
            shapes = [part.shape[:-1] for part in block.parts]
            if block.signal is not self._signal or shapes != self._shapes or seconds != self._frames[0]:
                self._resize(block.signal, shapes, seconds)
            frames = block.parts[0].shape[-1]
            if frames:  # many short blocks complete no frame
                for window, part in zip(self._windows, block.parts, strict=True):
                    window.append(part)
                self._appended += frames
                self._port_window = (-1.0, ())

    @property
    def next_index(self) -> int:
        """Index of the audio frame after the newest one that the output depends on."""
        with self._lock:
            self._add_pending()
            return self._next_index

    def _resize(self, signal: SignalFormat, shapes: list[tuple[int, ...]], seconds: float) -> None:
        """Adapt the windows to the format of a block and to their length in seconds."""
        self._frames = (seconds, frames_in(seconds, signal.rate))
        if signal.rate != self._signal.rate or shapes != self._shapes:
            self._clear(shapes)
        self._signal, self._port_window = signal, (-1.0, ())
        for window in self._windows:
            window.frames = self._frames[1]

    def read_new(self, reader: str) -> HistorySlice:
        """Return the output since the last call by `reader`, or since the beginning, at most the history."""
        with self._lock:
            self._add_pending()
            new = min(self._appended - self._read.get(reader, 0), frames_in(self.seconds, self._signal.rate))
            self._read[reader] = self._appended
            return HistorySlice(tuple(window.view(new) for window in self._windows), self._next_index, self._signal)

    def port_window(self) -> HistorySlice:
        """Return the newest `port_seconds` of output, with zeros before the first block.

        The views are the same objects as in the last call if no frame was appended since then.
        """
        with self._lock:
            self._add_pending()
            if self._port_window[0] != self.port_seconds:
                frames = frames_in(self.port_seconds, self._signal.rate)
                views = tuple(window.padded_view(frames) for window in self._windows)
                self._port_window = (self.port_seconds, views)
            return HistorySlice(self._port_window[1], self._next_index, self._signal)
