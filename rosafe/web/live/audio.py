"""The audio of bass for the level meters, and the relation of its frames to the clock."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from rosafe.ros1.client.port_reader import Frames, PortSubscription


class Audio(PortSubscription):
    """The port Audio of bass, subscribed until `close`.

    Parameters
    ----------
    topic : str
    callback : callable
        Called with new samples, int32 (2, n), and the time of the audio (s) at their end.

    Attributes
    ----------
    sample_rate : int
    received_at : float
        Time of the last message (`time.monotonic`); 0 before the first one.
    delay : float
        Seconds from the end of the newest chunk until it was received.
    """

    def __init__(self, topic: str, callback: Callable[[np.ndarray, float], None]) -> None:
        self.sample_rate = 0
        self.received_at = 0.0
        self.delay = 0.0
        self._on_samples = callback
        self._captured = (0, 0.0)  # a frame, and the time of its capture (s, clock)
        super().__init__(topic, self._use_samples)

    def captured_at(self, index: int) -> float | None:
        """Return the time of capture (s, clock) of the audio frame `index`, or None if it is not known."""
        frame, at = self._captured
        return at + (index - frame) / self.sample_rate if at and self.sample_rate else None

    def time_at(self, moment: float) -> float | None:
        """Return the time of the audio (s) at a time of the clock (s), or None if it is not known."""
        frame, at = self._captured
        return frame / self.sample_rate + moment - at if at and self.sample_rate else None

    def _use_samples(self, frames: Frames) -> None:
        self.sample_rate = int(frames.rate)
        captured = frames.stamp + (frames.data.shape[1] - 1) / frames.rate if frames.stamp else 0.0
        self._captured = frames.index, captured
        self.delay = time.time() - captured if captured else 0.0
        self.received_at = time.monotonic()
        self._on_samples(frames.data, frames.index / frames.rate)
