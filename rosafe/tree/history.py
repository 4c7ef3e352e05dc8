"""The recent output of a processor, for its output port and for readers that get the output since their last call.

It is kept in sliding windows that refer to released blocks; frames are copied only when a window is read. Released
blocks are read-only. A `WindowView`, the content of a window at one moment, therefore stays valid when more blocks
arrive.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.signal_format import SignalFormat
from rosafe.tree.block import Block

MAX_PIECES = 256  # blocks are joined if the window would otherwise consist of more pieces, or
MIN_PIECE_BYTES = 4096  # if they are smaller than this
BUFFER_PARTS = 8  # short blocks are joined in buffers of this part of the window,
SMALL_BUFFER_BYTES = 65536  # or of the whole window up to this size: a short window consists of few pieces then
# Short blocks are added to the windows together, when they are read at the latest.
MAX_PENDING = 8  # blocks
MAX_PENDING_BYTES = 2**18  # of the first part of a block: longer ones are added immediately


def frames_in(seconds: float, rate: float) -> int:
    """Return the number of whole frames in `seconds`, tolerating rounding errors: 0.29 s at 100 Hz are 29 frames."""
    return math.floor(seconds * rate + 1e-9)


class WindowView:
    """The content of a window at one moment: pieces of equal leading shape, in order along the last axis.

    Attributes
    ----------
    pieces : sequence of ndarray
        The first `skip` frames of the first one are not part of the window.
    frames : int
        The number of frames.
    shape : tuple of int
        (..., frames)
    derived : dict
        Results that were computed from the content, by name, so that they are computed once: see `select`.
    """

    __slots__ = ("derived", "frames", "pieces", "shape", "skip")

    def __init__(self, pieces: Sequence[FloatArray], skip: int = 0) -> None:
        self.pieces = pieces
        self.skip = skip
        self.frames = sum([piece.shape[-1] for piece in pieces]) - skip
        self.shape = (*pieces[0].shape[:-1], self.frames)
        self.derived: dict[int | str, Any] = {}

    def select(self, row: int) -> WindowView:
        """Return the part at index `row` of the first axis, such as one ear."""
        if row not in self.derived:
            self.derived[row] = WindowView(tuple(piece[row] for piece in self.pieces), self.skip)
        return self.derived[row]

    def swap_rows(self) -> WindowView:
        """Return the view with its first two axes exchanged, such as [channel][lag] to the port's [lag][channel]."""
        return WindowView(tuple(piece.swapaxes(0, 1) for piece in self.pieces), self.skip)

    def trimmed(self) -> Sequence[FloatArray]:
        """Return the pieces without the skipped frames, oldest first."""
        if not self.skip:
            return self.pieces
        return [self.pieces[0][..., self.skip :], *self.pieces[1:]]

    def copy_to(self, target: FloatArray) -> None:
        """Write all frames to `target`, whose shape is `shape`."""
        at = 0
        for part in self.trimmed():
            target[..., at : at + part.shape[-1]] = part
            at += part.shape[-1]

    def array(self) -> FloatArray:
        """Return all frames in a new array."""
        joined = np.empty(self.shape)
        self.copy_to(joined)
        return joined


class SlidingWindow:
    """The newest `frames` frames of a signal.

    Each sample is copied at most once: a short block, to the end of a buffer. No view is overwritten later.

    Parameters
    ----------
    rows : tuple of int
        Leading shape of the blocks, such as (2, channels).
    frames : int
        Length of the window, at least 0. If it is increased later, the window is filled by the next blocks.
    """

    def __init__(self, rows: tuple[int, ...], frames: int) -> None:
        self.rows = rows
        self.frames = frames
        self._pieces: list[FloatArray] = [self._zeros(0)]
        self._held = 0  # frames in all pieces; the window may begin within the first one
        self._buffer: FloatArray = np.empty(0)  # for short blocks
        self._start = self._stop = 0  # of its last piece, which ends at `_stop`; it is empty after a long block

    def append(self, block: FloatArray) -> None:
        """Append `block` of shape (*rows, n). It must not be modified afterwards."""
        count, pieces = block.shape[-1], self._pieces
        if count == 0:
            return
        if block.nbytes >= MIN_PIECE_BYTES and count * MAX_PIECES >= self.frames:
            pieces.append(block)
            self._start = self._stop
        else:
            self._append_copy(block, count)
        self._held += count
        while len(pieces) > 1 and self._held - pieces[0].shape[-1] >= self.frames:
            self._held -= pieces.pop(0).shape[-1]

    def _append_copy(self, block: FloatArray, count: int) -> None:
        """Append a block by a copy, to the last piece if that is in the buffer."""
        start, at = self._start, self._stop
        if at + count > self._buffer.shape[-1]:
            small = SMALL_BUFFER_BYTES * count // block.nbytes
            capacity = max(count, self.frames // BUFFER_PARTS, min(self.frames, small))
            self._buffer = np.empty((*self.rows, capacity), block.dtype)
            start = at = 0
        self._buffer[..., at : at + count] = block
        if at > start:
            self._pieces.pop()
        self._start, self._stop = start, at + count
        self._pieces.append(self._buffer[..., start : at + count])

    def view(self, frames: int | None = None) -> WindowView:
        """Return the newest `frames` frames, newest last; by default, and at most, those that have arrived."""
        length = self.frames if frames is None else min(frames, self.frames)
        skip, first = max(0, self._held - length), 0
        while first < len(self._pieces) - 1 and skip >= self._pieces[first].shape[-1]:
            skip -= self._pieces[first].shape[-1]
            first += 1
        return WindowView(tuple(self._pieces[first:]), skip)

    def padded_view(self, frames: int) -> WindowView:
        """Return exactly `frames` frames, newest last: zeros before the first block, as on an output port."""
        view = self.view(frames)
        missing = frames - view.frames
        return view if missing <= 0 else WindowView((self._zeros(missing), *view.trimmed()))

    def _zeros(self, frames: int) -> FloatArray:
        return np.broadcast_to(np.zeros(frames), (*self.rows, frames))  # one row in memory


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
