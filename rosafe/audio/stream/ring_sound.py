"""The sound of which sources are separated while it arrives: that of a ring, with the times of its frames."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from rosafe.audio.stream.ring import AudioReader, AudioRing
from rosafe.localization.live import Status
from rosafe.localization.live_streams import BLOCK_SECONDS, SoundBlock

BEFORE_SECONDS = 1.0  # of sound that has arrived: the floors of the channels are known when it has been processed


def loss_report(status: Status) -> Callable[[str], None]:
    """Return the `report` of a ring that warns about lost sound only: the rest is about the input of a tree."""
    return lambda line: status.warn(f"streams of sources: {line}", "sound") if "lost" in line else None


class RingSound:
    """A `LiveSound` from a ring.

    Parameters
    ----------
    ring : AudioRing
    sample_rate : float
        Hz; sound at another rate is not read.
    time_of : callable
        Returns the clock time (s) of a frame, of which the first is 1; LookupError if it is not known yet.
    """

    def __init__(self, ring: AudioRing, sample_rate: float, time_of: Callable[[int], float]) -> None:
        self._ring, self._rate, self._time_of = ring, sample_rate, time_of
        self._reader: AudioReader | None = None
        self._kept: tuple[np.ndarray, int] | None = None  # a block whose time is not known yet
        self._arrived = threading.Event()

    def close(self) -> None:
        """See `LiveSound`."""
        if self._reader is not None:
            self._reader.stop()

    def read(self, seconds: float) -> SoundBlock | None:
        """See `LiveSound`."""
        ring = self._ring
        if self._reader is None:
            reader = ring.open_reader(round(self._rate * BLOCK_SECONDS), seconds, lambda: False)
            if reader is None or reader.sample_rate != self._rate:
                if reader is not None:
                    reader.stop()
                self._arrived.wait(seconds)
                return None
            self._reader = reader
            reader.open(self._arrived.set)
            with ring.lock:
                reader.begin(max(ring.frames.oldest, reader.position - round(BEFORE_SECONDS * self._rate)))
        if self._kept is not None or self._reader.waiting:
            self._arrived.wait(seconds)
        self._arrived.clear()
        block, self._kept = self._kept or self._reader.read(), None
        if block is None:
            return None
        samples, end = block  # frames are numbered from 1
        try:
            time = self._time_of(end - samples.shape[1])
        except LookupError:
            self._kept = block  # no frame is skipped: streams are those of a file
            return None
        return SoundBlock(samples, end - samples.shape[1] - 1, time)
