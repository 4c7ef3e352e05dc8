"""Messages of a port Audio, which are sliding windows: validation, and the stream of frames that they add up to."""

from __future__ import annotations

from typing import Any

import numpy as np

MAX_RATE = 1_000_000  # Hz
MAX_WINDOW = 2**24  # frames in one message, 380 s at 44.1 kHz
MAX_INDEX = 2**63
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


def samples_after(message: Any, newest: int) -> tuple[int, np.ndarray]:
    """Return how many frames between frame `newest` and the window are lost, and the new samples, int32 (2, n)."""
    window = len(message.left)
    lost, count = split_new_frames(int(message.lastFrameIndex) - newest, window)
    return lost, np.stack(rows_of(message, window - count, window))


def rows_of(message: Any, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
    """Return some samples of the window for each ear, int32, without a copy if they are arrays."""
    return np.asarray(message.left[start:stop], np.int32), np.asarray(message.right[start:stop], np.int32)


def new_frames(expected: float, window: np.ndarray, before: np.ndarray) -> int:
    """Return by how many frames the window of a framed port has advanced: a whole number near `expected`.

    Messages do not carry the exact position of a frame, so the overlap of the two windows decides.

    Parameters
    ----------
    expected : float
        The advance in frames, computed from the frame index and the frame rate of the port.
    window, before : ndarray, (..., frames)
        The windows of the newest message and of the previous one.
    """
    frames = window.shape[-1]
    if expected <= frames and before.shape == window.shape:
        for count in sorted({int(expected), int(expected) + 1}, key=lambda count: abs(count - expected)):
            if count >= frames or np.array_equal(window[..., : frames - count], before[..., count:], equal_nan=True):
                return count
    return round(expected)


class WindowStream:
    """A stream of frames, joined from messages (`binaudio_portStruct` with arrays) whose windows overlap.

    Parameters
    ----------
    with_first : bool
        Whether the stream starts with the window of the first message, or with the first frame after it.
    """

    def __init__(self, with_first: bool) -> None:
        self.sample_rate = 0  # Hz; 0 before the first message
        self.newest = 0  # index of the newest frame
        self._with_first = with_first

    def mismatch(self, message: Any) -> str:
        """Return the reason why `message` does not continue this stream; '' if it does."""
        rate, index = message.sampleRate, message.lastFrameIndex
        if self.sample_rate not in (0, rate):
            return f"its sample rate changes from {self.sample_rate} to {rate} Hz"
        if index < self.newest:
            return f"its index falls from {self.newest} to {index}"
        if self.sample_rate and index - self.newest > MAX_JUMP_SECONDS * rate + len(message.left):
            return f"its index jumps from {self.newest} to {index}"
        return ""

    def advance(self, message: Any) -> tuple[int, np.ndarray]:
        """Append `message`. Return how many frames before it were lost, and its new samples, int32 (2, n)."""
        index = int(message.lastFrameIndex)
        if self.sample_rate == 0:
            self.sample_rate = int(message.sampleRate)
            self.newest = max(0, index - len(message.left)) if self._with_first else index
        result = samples_after(message, self.newest)
        self.newest = index
        return result
