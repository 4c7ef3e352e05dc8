"""A ring buffer of binaural audio that is addressed by absolute frame number."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


class FrameRing:
    """The newest frames of a stream, int32.

    Attributes
    ----------
    newest, oldest : int
        Numbers of the newest and the oldest frame in the ring. It is empty if `newest` is `oldest` - 1.
    """

    def __init__(self) -> None:
        self.clear(0, 0)

    def clear(self, capacity: int, newest: int) -> None:
        """Drop all frames. The next one has the number `newest` + 1."""
        self._samples = np.zeros((2, capacity), np.int32)
        self.newest, self.oldest = newest, newest + 1

    @property
    def capacity(self) -> int:
        """Maximum number of frames."""
        return self._samples.shape[1]

    def reserve(self, capacity: int) -> None:
        """Increase the capacity to at least `capacity` frames, and keep the present ones."""
        if self.capacity < capacity:
            frames = self.copy(self.oldest, self.newest + 1 - self.oldest)
            self.clear(capacity, self.oldest - 1)
            self.append(frames)

    def append(self, samples: np.ndarray | Sequence[np.ndarray]) -> None:
        """Append the samples of both ears, (2, n) or two of (n,), at most the capacity."""
        count, capacity = len(samples[0]), self.capacity
        at = (self.newest + 1) % capacity
        head = min(count, capacity - at)
        for row, new in zip(self._samples, samples, strict=True):
            row[at : at + head] = new[:head]
            if head < count:
                row[: count - head] = new[head:]
        self.newest += count
        self.oldest = max(self.oldest, self.newest - capacity + 1)

    def holds(self, first: int, samples: Sequence[np.ndarray]) -> bool:
        """Return whether the frames from number `first` on, which must be in the ring, are `samples`, int32."""
        count, at = len(samples[0]), first % max(1, self.capacity)
        if at + count > self.capacity:
            return np.array_equal(self.copy(first, count), samples)
        # Bytes are compared many times faster than short arrays.
        first_ear, second_ear = self._samples[:, at : at + count]
        return first_ear.tobytes() == samples[0].tobytes() and second_ear.tobytes() == samples[1].tobytes()

    def copy(self, first: int, count: int) -> np.ndarray:
        """Return `count` frames from number `first` on, (2, count). They must be in the ring."""
        samples = np.empty((2, count), np.int32)
        if count:
            at = first % self.capacity
            head = min(count, self.capacity - at)
            samples[:, :head] = self._samples[:, at : at + head]
            samples[:, head:] = self._samples[:, : count - head]
        return samples
