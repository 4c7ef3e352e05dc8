"""The Audio input port: a ring addressed by absolute frame number, filled from the sliding windows that come in.

What the processors see when something is missing (docs/audio-stream.md): frames lost within a stream are zeros in
their place, so that every later frame keeps its number; a new stream (bass restarted, its window, rate or index
jumped) begins a new block, and unread frames of the old stream are dropped. Both are counted and logged once each.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

RING_SECONDS = 10.0  # how far the tree may fall behind before frames are lost
POLL_SECONDS = 0.5  # how often a waiting reader looks whether it should still wait


@dataclass
class Counters:
    """What happened to the audio since the node started."""

    messages: int = 0
    refused: int = 0  # malformed messages
    lost: int = 0  # frames that never came, or came and were overwritten before the tree read them
    gaps: int = 0  # events in which frames were lost
    streams: int = 0  # streams begun
    dropped: int = 0  # unread frames of old streams
    last_loss: str = "none"  # where the last loss was


class AudioRing:
    """The newest seconds of a binaural stream, written by one thread and read by another.

    Frames are numbered as bass does: the first frame of a stream is 1, and `lastFrameIndex` is the newest one.

    Parameters
    ----------
    report : callable
        Gets one line for the log per event.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self.counters = Counters()
        self.sample_rate = 0
        self._report = report
        self._turn = threading.Condition()
        self._samples = np.zeros((2, 0), np.int32)
        self._window = 0  # frames per message of this stream
        self._newest = 0  # number of the newest frame
        self._oldest = 1  # number of the oldest frame that the ring holds
        self._readers: list[AudioReader] = []
        self._refusing = False

    # --- the writing side: rospy's thread ---

    def feed(self, message: Any) -> None:
        """Take what is new in a window (`binaudio_portStruct` with arrays)."""
        left, right = message.left, message.right
        with self._turn:
            self.counters.messages += 1
            if len(left) != len(right) or len(left) == 0 or message.sampleRate == 0 or message.lastFrameIndex >= 2**63:
                self._refuse(
                    f"{len(left)} left and {len(right)} right samples at {message.sampleRate} Hz, "
                    f"frame {message.lastFrameIndex}"
                )
                return
            self._refusing = False
            newest, window = int(message.lastFrameIndex), len(left)
            if message.sampleRate != self.sample_rate or window != self._window:
                self._begin(message.sampleRate, window, newest, "first audio" if not self._window else "it changed")
            elif newest < self._newest:
                self._begin(message.sampleRate, window, newest, f"its index fell from {self._newest} to {newest}")
            elif newest - self._newest > self._samples.shape[1]:
                self._lose(self._newest + 1, newest - self._newest - window)
                self._begin(message.sampleRate, window, newest, f"its index jumped from {self._newest} to {newest}")
            fresh = newest - self._newest
            if fresh > window:
                self._lose(self._newest + 1, fresh - window)
                self._write(np.zeros((2, fresh - window), np.int32))
                fresh = window
            if fresh:
                self._write(np.stack((left[window - fresh :], right[window - fresh :])))
            self._turn.notify_all()

    def _refuse(self, why: str) -> None:
        self.counters.refused += 1
        if not self._refusing:
            self._report(f"Audio: malformed messages are ignored: {why}")
        self._refusing = True

    def _begin(self, sample_rate: int, window: int, newest: int, why: str) -> None:
        """A new stream, of which the newest min(window, newest) frames are in the message at hand."""
        self.counters.streams += 1
        old_rate = self.sample_rate
        blocks = [2 * reader.frames_per_block for reader in self._readers]
        capacity = max([int(RING_SECONDS * sample_rate), 2 * window, *blocks])
        unread = self._unread()
        first = old_rate == 0
        self.sample_rate, self._window = sample_rate, window
        self._samples = np.zeros((2, capacity), np.int32)
        self._newest = max(0, newest - window)
        self._oldest = self._newest + 1
        for reader in self._readers:
            reader.position = self._oldest
        self.counters.dropped += unread
        if not first:
            dropped = f"; {unread} unread frames of the old stream are dropped" if unread else ""
            self._report(f"Audio: a new stream at {sample_rate} Hz, frame {newest} ({why}){dropped}")

    def _lose(self, first: int, count: int) -> None:
        if count <= 0:
            return
        self.counters.lost += count
        self.counters.gaps += 1
        self.counters.last_loss = f"{count} frames from frame {first} on"
        self._report(f"Audio: lost {self.counters.last_loss} ({count / self.sample_rate:.3f} s)")

    def _write(self, samples: np.ndarray) -> None:
        capacity, count = self._samples.shape[1], samples.shape[1]
        at = (self._newest + 1) % capacity
        head = min(count, capacity - at)
        self._samples[:, at : at + head] = samples[:, :head]
        self._samples[:, : count - head] = samples[:, head:]
        self._newest += count
        self._oldest = max(self._oldest, self._newest - capacity + 1)

    def forget(self) -> None:
        """The port was connected anew: what comes next is a new stream, and nothing has come yet."""
        with self._turn:
            self._window = 0
            self.sample_rate = 0

    # --- the reading side ---

    def wait_first(self, timeout: float, give_up: Callable[[], bool]) -> bool:
        """Wait for a message, up to `timeout` seconds; whether there is one."""
        deadline = time.monotonic() + timeout
        with self._turn:
            while self._window == 0 and not give_up():
                left = deadline - time.monotonic()
                if left <= 0:
                    break
                self._turn.wait(min(left, 0.05))
            return self._window != 0

    def reader(self, frames_per_block: int) -> AudioReader:
        """A reader that begins with the next frame to come."""
        with self._turn:
            reader = AudioReader(self, frames_per_block, self.sample_rate, self._newest + 1)
            self._readers.append(reader)
            if self._samples.shape[1] < 2 * frames_per_block:
                self._grow(2 * frames_per_block)
            return reader

    def _grow(self, capacity: int) -> None:
        """Make room for more frames; those that other readers still wait for stay."""
        kept = [self._copy(self._oldest, self._newest + 1 - self._oldest)] if self._window else []
        self._samples = np.zeros((2, capacity), np.int32)
        self._newest = self._oldest - 1
        for samples in kept:
            self._write(samples)

    def _unread(self) -> int:
        return max((self._newest + 1 - max(r.position, self._oldest) for r in self._readers), default=0)

    def read(self, reader: AudioReader) -> tuple[np.ndarray, int] | None:
        """The next block of `reader`, and the number of the frame after it; None once it is stopped."""
        count = reader.frames_per_block
        with self._turn:
            while True:
                if reader.stopped:
                    return None
                if reader.position < self._oldest:  # the tree fell behind by more than the ring holds
                    self._lose(reader.position, self._oldest - reader.position)
                    reader.position = self._oldest
                if self.sample_rate == reader.sample_rate and self._newest + 1 - reader.position >= count:
                    break
                self._turn.wait(POLL_SECONDS)
            reader.position += count
            return self._copy(reader.position - count, count), reader.position

    def _copy(self, first: int, count: int) -> np.ndarray:
        """Frames `first` and on, (2, count); they must be in the ring."""
        capacity = self._samples.shape[1]
        at = first % capacity
        head = min(count, capacity - at)
        samples = np.empty((2, count), np.int32)
        samples[:, :head] = self._samples[:, at : at + head]
        samples[:, head:] = self._samples[:, : count - head]
        return samples

    def stop(self, reader: AudioReader) -> None:
        """End the waiting of `reader`, for good."""
        with self._turn:
            reader.stopped = True
            if reader in self._readers:
                self._readers.remove(reader)
            self._turn.notify_all()

    @property
    def behind(self) -> int:
        """Frames that have come and were not read yet."""
        with self._turn:
            return self._unread()


class AudioReader:
    """What the input processor reads: whole blocks of one stream after the other.

    Audio at another rate than at the start is not given to the tree, which was built for that rate.
    """

    def __init__(self, ring: AudioRing, frames_per_block: int, sample_rate: float, position: int) -> None:
        self.frames_per_block = frames_per_block
        self.sample_rate = float(sample_rate)
        self.position = position  # number of the next frame to read; kept by the ring
        self.stopped = False
        self._ring = ring

    def read(self) -> tuple[np.ndarray, int] | None:
        """The next block, int32 (2, n), and the number of the frame after it; None once stopped."""
        return self._ring.read(self)

    def stop(self) -> None:
        """Make `read` return None."""
        self._ring.stop(self)
