"""The sound of which sources are separated: that of the input of rosAFE, with the times of its frames."""

from __future__ import annotations

import threading

from rosafe.audio.stream.ring import AudioReader
from rosafe.localization.live import Status
from rosafe.localization.live_streams import BLOCK_SECONDS, SoundBlock
from rosafe.ros import FrameClock
from rosafe.ros1.afe.audio_input import AudioInput

_BEFORE_SECONDS = 1.0  # of sound that has arrived: the floors of the channels are known when it has been processed


class InputSound:
    """A `LiveSound`, subscribed to the topic of the input.

    Parameters
    ----------
    topic : str
    sample_rate : float
        Hz; sound at another rate is not read.
    clock : FrameClock
        Of the rosAFE node, whose frames have the numbers of the sound.
    status : Status
        Counts lost sound.
    """

    def __init__(self, topic: str, sample_rate: float, clock: FrameClock, status: Status) -> None:
        self._rate, self._clock = sample_rate, clock
        self._status = status
        self._input = AudioInput(self._warn)
        self._input.connect(topic)
        self._reader: AudioReader | None = None
        self._arrived = threading.Event()

    def _warn(self, line: str) -> None:
        if "lost" in line:  # the rest is about the input of a tree
            self._status.warn(f"streams of sources: {line}", "sound")

    def close(self) -> None:
        """Unsubscribe."""
        if self._reader is not None:
            self._reader.stop()
        self._input.close()

    def read(self, seconds: float) -> SoundBlock | None:
        """See `LiveSound`."""
        ring = self._input.ring
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
                reader.begin(max(ring.frames.oldest, reader.position - round(_BEFORE_SECONDS * self._rate)))
        if not self._clock.wait(seconds):  # no frame is skipped: streams are those of a file
            return None
        if self._reader.waiting:
            self._arrived.wait(seconds)
        self._arrived.clear()
        block = self._reader.read()
        if block is None:
            return None
        samples, end = block  # frames are numbered from 1
        time = self._clock.time(end - samples.shape[1]).ros.to_sec()
        return SoundBlock(samples, end - samples.shape[1] - 1, time)
