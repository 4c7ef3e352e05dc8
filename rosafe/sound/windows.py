"""Messages of a port Audio, sliding windows: which can be used, and the stream that they show, every frame once."""

from __future__ import annotations

from typing import Any

import numpy as np

MAX_RATE = 1_000_000  # Hz; beyond that a message is garbage, not audio
MAX_WINDOW = 2**24  # frames in one message, as with bass
MAX_INDEX = 2**63
MAX_JUMP_SECONDS = 3600.0  # an index that jumps further is no loss but another stream


def window_error(message: Any) -> str:
    """What is wrong with a message; empty where it can be used."""
    left, right, rate, index = len(message.left), len(message.right), message.sampleRate, message.lastFrameIndex
    if left != right:
        return f"{left} left and {right} right samples"
    if not 0 < left <= MAX_WINDOW:
        return f"{left} samples per ear, allowed are 1 to {MAX_WINDOW}"
    if message.nChunksOnPort * message.nFramesPerChunk != left:
        return f"{left} samples per ear, where there should be {message.nChunksOnPort} x {message.nFramesPerChunk}"
    if not 0 < rate <= MAX_RATE:
        return f"a sample rate of {rate} Hz, allowed are 1 to {MAX_RATE} Hz"
    if index >= MAX_INDEX:
        return f"lastFrameIndex {index} is beyond all ages"
    return ""


def split_new_frames(new: int, window: int) -> tuple[int, int]:
    """Of `new` frames since the last message, how many are lost, and how many a window of so many frames shows."""
    shown = min(new, window)
    return new - shown, shown


def new_frames(expected: float, window: np.ndarray, before: np.ndarray) -> int:
    """How many frames a framed port's window has moved on, which is a whole number near `expected`.

    The grid of the frames is not on the wire; where the windows fit onto each other is.

    Parameters
    ----------
    expected : float
        Of the audio frames that went by, and the port's frame rate.
    window, before : ndarray, (..., frames)
        What the newest message shows, and the one before.
    """
    frames = window.shape[-1]
    if expected <= frames and before.shape == window.shape:
        for count in sorted({int(expected), int(expected) + 1}, key=lambda count: abs(count - expected)):
            if count >= frames or np.array_equal(window[..., : frames - count], before[..., count:], equal_nan=True):
                return count
    return round(expected)


class WindowStream:
    """One stream of frames, out of messages (`binaudio_portStruct` with arrays) that overlap.

    Parameters
    ----------
    with_first : bool
        Whether the stream begins with what the first message shows, or with the first frame after it.
    """

    def __init__(self, with_first: bool) -> None:
        self.sample_rate = 0  # Hz; 0 before the first message
        self.newest = 0  # number of the newest frame
        self._with_first = with_first

    def join_state(self, message: Any) -> str:
        """Why `message` cannot be of this stream; empty where it can."""
        rate, index = message.sampleRate, message.lastFrameIndex
        if self.sample_rate in (0, rate):
            if index < self.newest:
                return f"its index falls from {self.newest} to {index}"
            if self.sample_rate and index - self.newest > MAX_JUMP_SECONDS * rate + len(message.left):
                return f"its index jumps from {self.newest} to {index}"
            return ""
        return f"its sample rate changes from {self.sample_rate} to {rate} Hz"

    def fresh(self, message: Any) -> tuple[int, np.ndarray]:
        """What `message`, one of this stream, brings: how many frames were lost before it, and int32 (2, n)."""
        index, window = int(message.lastFrameIndex), len(message.left)
        if self.sample_rate == 0:
            self.sample_rate = int(message.sampleRate)
            self.newest = max(0, index - window) if self._with_first else index
        lost, count = split_new_frames(index - self.newest, window)
        self.newest = index
        return lost, np.stack((message.left[window - count :], message.right[window - count :]))
