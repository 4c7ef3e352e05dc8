"""The sound of which sources are separated: that of the input of rosAFE, with the times of its frames."""

from __future__ import annotations

from rosafe.audio.stream.ring_sound import RingSound, loss_report
from rosafe.localization.live import Status
from rosafe.ros import FrameClock
from rosafe.ros1.afe.audio_input import AudioInput

_CURRENT = 2.0  # s, at most, between the newest sound and the newest time of the same stream


class InputSound(RingSound):
    """A `LiveSound`, subscribed to the topic of the input.

    Parameters
    ----------
    topic : str
    sample_rate : float
        Hz; sound at another rate is not read.
    clock : FrameClock
        Of the rosAFE node, whose frames have the numbers of the sound.
    status : Status
        Warns about lost sound.
    """

    def __init__(self, topic: str, sample_rate: float, clock: FrameClock, status: Status) -> None:
        self._input = AudioInput(loss_report(status))
        self._input.connect(topic)
        self._clock = clock
        super().__init__(self._input.ring, sample_rate, self._time)

    def _time(self, frame: int) -> float:
        """Return the clock time of a frame (s); LookupError if times of another stream have arrived last."""
        with self._ring.lock:
            newest = self._ring.frames.newest
        if not self._clock.covers(newest, _CURRENT * self._rate):
            raise LookupError
        return float(self._clock.time(frame).ros.to_sec())

    def close(self) -> None:
        """Unsubscribe."""
        super().close()
        self._input.close()
