"""Messages of ports, which are sliding windows: the streams that they add up to; checks of those of the port Audio."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

MAX_RATE = 1_000_000  # Hz
MAX_WINDOW = 2**24  # frames in one message, 380 s at 44.1 kHz
MAX_INDEX = 2**63
EXACT = 1e-6  # frames by which the position of a frame may differ from a whole number by rounding
MAX_JUMP_SECONDS = 3600.0  # a longer jump of the index starts a new stream instead of counting as a loss


def window_error(message: Any) -> str:
    """Return the reason why a message is invalid; '' if it is valid."""
    left, right, rate, index = len(message.left), len(message.right), message.sampleRate, message.lastFrameIndex
    if left != right:
        return f"{left} left and {right} right samples"
    if not 0 < left <= MAX_WINDOW:
        return f"expected 1 to {MAX_WINDOW} samples per ear, got {left}"
    if message.nChunksOnPort * message.nFramesPerChunk != left:
        return f"expected {message.nChunksOnPort} x {message.nFramesPerChunk} samples per ear, got {left}"
    if not 0 < rate <= MAX_RATE:
        return f"expected a sample rate from 1 to {MAX_RATE} Hz, got {rate}"
    if index >= MAX_INDEX:
        return f"lastFrameIndex {index} is out of range"
    return ""


def split_new_frames(new: int, window: int) -> tuple[int, int]:
    """Return how many of the `new` frames since the last message are lost, and how many are in a window of `window`."""
    shown = min(new, window)
    return new - shown, shown


def rows_of(message: Any, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
    """Return some samples of the window for each ear, int32, without a copy if they are arrays."""
    return np.asarray(message.left[start:stop], np.int32), np.asarray(message.right[start:stop], np.int32)


def overlap(window: np.ndarray, before: np.ndarray, count: int) -> bool:
    """Return whether a window (..., frames) is the one before it, advanced by a number of frames."""
    frames = window.shape[-1]
    return count >= 0 and (
        count >= frames
        or (before.shape == window.shape and np.array_equal(window[..., : frames - count], before[..., count:], True))
    )


class Step(NamedTuple):
    """The frames that a message adds to a stream.

    Attributes
    ----------
    first : int
        Number of its first new frame; the first frame of a stream is 0.
    new : int
        Number of its new frames, which are the last ones of its window.
    lost : int
        Frames that are missing before them.
    restarted : bool
        Whether another stream begins.
    """

    first: int
    new: int
    lost: int
    restarted: bool


class WindowStream:
    """A stream of frames, joined from messages whose windows overlap.

    Parameters
    ----------
    hop : float
        Distance of frames in audio frames; 1 for frames that are samples.
    width : int
        Audio frames from the beginning of a frame to its end.
    with_first : bool
        Whether the stream starts with the window of the first message, or with the first frame after it.
    """

    def __init__(self, hop: float = 1, width: int = 1, with_first: bool = True) -> None:
        # audio frames from the beginning of the sound to the end of the newest message; 0 before the first
        self.end = 0
        self.frames = 0  # the same in frames of the stream; negative until the first one is complete
        self._hop, self._width, self._with_first = hop, width, with_first
        self._origin = (0, 0)  # `end` and `frames` of the first message
        self._before: np.ndarray = np.zeros(0)

    def advance(self, end: int, window: np.ndarray) -> Step:
        """Append the message with the window (..., frames) that ends after `end` audio frames.

        If these are not a multiple of the hop, the overlap with the previous window decides how many frames are new.
        """
        shown = window.shape[-1]
        restarted = self.end > 0 and (end < self.end or window.shape[:-1] != self._before.shape[:-1])
        if restarted or not self.end:
            self.frames = self._on_grid(end)
            self._origin = end, self.frames
            lost, count = 0, min(shown, max(0, self.frames)) * self._with_first
        else:
            before, self.frames = self.frames, self._frames_at(end, window)
            lost, count = split_new_frames(max(0, self.frames) - max(0, before), shown)
        self.end, self._before = end, window
        return Step(max(0, self.frames) - count, count, lost, restarted)

    def _on_grid(self, end: int) -> int:
        """Return the number of frames of a processor that has begun with the sound."""
        return math.floor((end - self._width) / self._hop + EXACT) + 1

    def _frames_at(self, end: int, window: np.ndarray) -> int:
        first, frames = self._origin
        passed = (end - first) / self._hop
        least = frames + math.floor(passed + EXACT)
        if passed % 1 < EXACT or passed % 1 > 1 - EXACT:
            return least
        grid = min(max(self._on_grid(end), least), least + 1)  # preferred: windows of silence are all equal
        other = 2 * least + 1 - grid
        fits = overlap(window, self._before, grid - self.frames)
        return grid if fits or not overlap(window, self._before, other - self.frames) else other


def mismatch(stream: WindowStream, sample_rate: int, message: Any) -> str:
    """Return the reason why a message of a port Audio does not continue a stream of this rate (Hz); '' if it does."""
    rate, index = message.sampleRate, message.lastFrameIndex
    if rate != sample_rate:
        return f"its sample rate changes from {sample_rate} to {rate} Hz"
    if index < stream.end:
        return f"its index falls from {stream.end} to {index}"
    if index - stream.end > MAX_JUMP_SECONDS * rate + len(message.left):
        return f"its index jumps from {stream.end} to {index}"
    return ""


def new_samples(stream: WindowStream, message: Any) -> tuple[int, np.ndarray]:
    """Append a message of the port Audio. Return the frames lost before it, and its new samples, int32 (2, n)."""
    window = len(message.left)
    step = stream.advance(int(message.lastFrameIndex), np.asarray(message.left))
    return step.lost, np.stack(rows_of(message, window - step.new, window))
