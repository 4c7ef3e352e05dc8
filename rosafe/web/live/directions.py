"""The view `directions`: posterior and sources of the localizer, and the truth of a scene, in one column each."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import rospy

from rosafe.localization import angles
from rosafe.web.live.audio import Audio

RATE = 10.0  # columns per second, as the localizer publishes
MAX_SOURCES = 8  # of the localizer, and of a scene
SOURCE_NUMBERS = 5  # id, azimuth and its standard deviation (degrees), probabilities that it exists and that it speaks
MAX_DIRECTIONS = 3600  # of a posterior
MAX_HOLD = 5  # columns without a message that are filled with the following one
TRUTH_SECONDS = 0.1  # largest difference of the time of a truth and of an estimate
_TRUTHS = 100  # that are kept: 5 s
_WAITING = 10  # stamps for which only one message has arrived: 1 s
GRID = angles.grid()
SIZE = len(GRID) + MAX_SOURCES * SOURCE_NUMBERS + MAX_SOURCES


def description() -> dict[str, Any]:
    """Return the description of the view for the page."""
    azimuths = GRID.tolist()
    return {"mode": "directions", "rate": RATE, "rows": SIZE, "ears": 1, "azimuths": azimuths, "slots": MAX_SOURCES}


class DirectionTopics:
    """Subscribes to the topics of the localizer and the scene until `close`.

    Parameters
    ----------
    audio : callable
        Returns the audio of bass, whose stamps relate clock and audio, or None.
    append : callable
        Called with number, column (SIZE, n) and end (s of the audio) of new columns, on a thread of rospy.
    bass, localizer : str
        Full names of the nodes that publish sceneTruth, and sources and posterior.
    """

    def __init__(
        self,
        audio: Callable[[], Audio | None],
        append: Callable[[int, np.ndarray, float], None],
        bass: str,
        localizer: str,
    ) -> None:
        from rosAFE.msg import DirectionPosterior, SoundSources

        from bass.msg import SceneTruth

        self._audio, self._append = audio, append
        self._world_frame = str(rospy.get_param(f"{bass}/world_frame", "world")).strip("/") or "world"
        self._lock = threading.Lock()
        self._next = 0  # number of the next column
        self._waiting: dict[int, dict[str, Any]] = {}  # by stamp, messages of one topic until that of the other arrives
        self._truths: deque[Any] = deque(maxlen=_TRUTHS)
        self._subscribers = [
            rospy.Subscriber(topic, message_class, callback, queue_size=10, tcp_nodelay=True)
            for topic, message_class, callback in (
                (f"{localizer}/sources", SoundSources, self._receive_sources),
                (f"{localizer}/posterior", DirectionPosterior, self._receive_posterior),
                (f"{bass}/sceneTruth", SceneTruth, self._receive_truth),
            )
        ]

    def close(self) -> None:
        """Unsubscribe."""
        for subscriber in self._subscribers:
            subscriber.unregister()

    def _receive_truth(self, message: Any) -> None:
        with self._lock:
            if self._truths and message.frameIndex < self._truths[-1].frameIndex:  # another acquisition
                self._truths.clear()
            self._truths.append(message)

    def _receive_sources(self, message: Any) -> None:
        self._receive("sources", message)

    def _receive_posterior(self, message: Any) -> None:
        self._receive("posterior", message)

    def _receive(self, topic: str, message: Any) -> None:
        """Append a column if the message of the other topic with the same stamp has arrived."""
        stamp = message.header.stamp.to_nsec()
        with self._lock:
            pair = self._waiting.setdefault(stamp, {})
            pair[topic] = message
            if len(pair) == 2:
                del self._waiting[stamp]
                self._append_column(**pair)
            elif len(self._waiting) > _WAITING:
                del self._waiting[next(iter(self._waiting))]

    def _append_column(self, sources: Any, posterior: Any) -> None:
        """Append a column at the time of two messages with one stamp, unless this time of the audio is unknown."""
        audio = self._audio()
        if audio is None:
            return
        end = audio.time_at(sources.header.stamp.to_sec())
        if end is None or end < 0:
            return
        number = int(end * RATE)
        if number < self._next <= number + MAX_HOLD:  # a message with the stamp of the previous one
            return
        # After a step back of the time, the column begins another series.
        count = number - self._next + 1 if self._next > 0 and 0 <= number - self._next < MAX_HOLD else 1
        world = sources.header.frame_id == self._world_frame
        column = np.concatenate((resampled(posterior), source_slots(sources), self._truth(end, audio, world)))
        self._next = number + 1
        self._append(self._next - count, np.repeat(column[:, np.newaxis], count, axis=1).astype(np.float32), end)

    def _truth(self, end: float, audio: Audio, world: bool) -> np.ndarray:
        """Return the true azimuths (degrees) of the sources that sound at a time of the audio; NaN in unused slots."""
        slots = np.full(MAX_SOURCES, np.nan)
        if self._truths:
            frame = end * audio.sample_rate
            nearest = min(self._truths, key=lambda one: abs(one.frameIndex - frame))
            if abs(nearest.frameIndex - frame) <= TRUTH_SECONDS * audio.sample_rate:
                azimuths = np.degrees(nearest.azimuths[:MAX_SOURCES]) + (np.degrees(nearest.head_yaw) if world else 0.0)
                slots[: len(azimuths)] = angles.wrap(azimuths)
        return slots


def resampled(message: Any) -> np.ndarray:
    """Return the posterior of a message at the directions of `GRID`; NaN if there is none."""
    azimuths, probability = np.degrees(message.azimuths), np.array(message.probability, float)
    if not 0 < len(azimuths) == len(probability) <= MAX_DIRECTIONS or not np.isfinite([azimuths, probability]).all():
        return np.full(len(GRID), np.nan)
    values = np.interp(GRID, azimuths, probability, period=360.0)
    return values / max(values.sum(), 1e-12)


def source_slots(message: Any) -> np.ndarray:
    """Return the numbers of the most probable sources of a message; NaN in unused slots."""
    slots = np.full((MAX_SOURCES, SOURCE_NUMBERS), np.nan)
    sources = sorted(message.sources, key=lambda one: -one.probability)[:MAX_SOURCES]
    for slot, one in zip(slots, sources, strict=False):
        slot[:] = one.id % 2**24, np.degrees(one.azimuth), np.degrees(one.azimuth_std), one.probability, one.speech
    return slots.ravel()
