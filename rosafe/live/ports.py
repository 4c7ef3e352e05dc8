"""The ports that somebody looks at: one subscription each, and which frames of its windows are new."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rospy

from rosafe.component import wire
from rosafe.interface import LAYOUTS
from rosafe.sound.windows import joined, new_frames

BUFFER = 2**17  # bytes that are read at a time: more of them cost more to make than turns do
AUDIO_RATE_SLACK = 0.5  # frames


class Port:
    """The topic of one processor, subscribed from the making of this until `close`.

    Parameters
    ----------
    topic, kind : str
    rate, sample_rate : float
        Of its frames and of the audio, Hz.
    take : callable
        Gets this port and its message, on rospy's thread, after `newest` and `lost` were brought up to date.

    Attributes
    ----------
    newest : int
        Number of frames since the audio began, up to the newest one.
    fresh : int
        How many of them the last message brought.
    lost : int
        Frames that were in no window that came, since the port was subscribed.
    end : float
        Seconds of the audio that the newest frame reaches up to.
    """

    def __init__(
        self, topic: str, kind: str, rate: float, sample_rate: float, take: Callable[[Port, Any], None]
    ) -> None:
        self.topic, self.rate, self.sample_rate = topic, rate, sample_rate
        self.newest = self.fresh = self.lost = 0
        self.index = -1
        self.end = 0.0
        self._take = take
        self._last: np.ndarray | None = None
        self._field = LAYOUTS[kind].places[0].field
        self._closed = False
        self._lock = threading.Lock()
        self._subscriber = rospy.Subscriber(
            topic,
            wire.message_class("rosAFE", LAYOUTS[kind].idl),
            self._received,
            queue_size=1,
            buff_size=BUFFER,
            tcp_nodelay=True,
        )

    def close(self) -> None:
        """Subscribe no longer."""
        self._closed = True
        self._subscriber.unregister()

    def _received(self, message: Any) -> None:
        with self._lock:
            if self._closed or not self._advance(message):
                return
            self._take(self, message)

    def _advance(self, message: Any) -> bool:
        """Whether the message brings anything; where it does, what it brings is counted."""
        index, window = int(message.lastFrameIndex), getattr(message, self._field)
        if not isinstance(window, np.ndarray) or index in (0, self.index):  # 0: a processor that has just started
            return False
        frames = window.shape[-1]
        probe = window[0] if window.ndim == 3 else window  # one lag tells as much as all
        whole = index * self.rate / self.sample_rate
        if self._last is None or index < self.index or self._last.shape[:-1] != probe.shape[:-1]:
            self.newest = int(whole + 1e-6)
            lost, self.fresh = 0, min(frames, self.newest)  # what the window shows already
        else:
            expected = (index - self.index) * self.rate / self.sample_rate
            audio = abs(self.rate - self.sample_rate) < AUDIO_RATE_SLACK
            new = round(expected) if audio else new_frames(expected, probe, self._last)
            lost, self.fresh = joined(new, frames)
            self.newest += new
            if abs(self.newest - whole) > max(3.0, 0.05 * self.rate):  # of another stream: begin anew
                self.newest = int(whole)
        self.lost += lost
        self.index, self.end = index, index / self.sample_rate
        self._last = probe
        return True


class Audio:
    """The sound itself, as bass gives it out, for the level meters: one subscription until `close`.

    Attributes
    ----------
    sample_rate : int
    heard_at : float
        When the last message came, of time.monotonic; 0 before the first.
    """

    def __init__(self, topic: str, take: Callable[[np.ndarray, int, float], None]) -> None:
        self.topic = topic
        self.sample_rate = 0
        self.heard_at = 0.0
        self.delay = 0.0  # s, from the end of the newest chunk to here
        self._take = take
        self._index = 0
        self._mark = (0, 0.0)  # a frame, and when it was captured (s, clock)
        self._closed = False
        self._subscriber = rospy.Subscriber(
            topic,
            wire.lenient_class("bass", "::binaudio::portStruct", 2**24),
            self._received,
            queue_size=1,
            buff_size=BUFFER,
            tcp_nodelay=True,
        )

    def close(self) -> None:
        """Subscribe no longer."""
        self._closed = True
        self._subscriber.unregister()

    def captured_at(self, index: int) -> float | None:
        """When the audio frame `index` was captured (s, of the clock); None where nobody knows."""
        frame, at = self._mark
        return at + (index - frame) / self.sample_rate if at and self.sample_rate else None

    def _received(self, message: Any) -> None:
        if self._closed or message.problem:
            return
        index, rate = int(message.lastFrameIndex), int(message.sampleRate)
        if not rate or index == self._index:
            return
        window = len(message.left)
        fresh = index - self._index if 0 < self._index < index else int(message.nFramesPerChunk)
        lost, count = joined(fresh, min(window, index))
        self._index, self.sample_rate = index, rate
        stamp = message.stamp.sec + 1e-9 * message.stamp.nsec
        self._mark = index, stamp
        self.delay = time.time() - stamp if stamp else 0.0
        self.heard_at = time.monotonic()
        if count:
            samples = np.stack((message.left[window - count :], message.right[window - count :]))
            self._take(samples, lost, index / rate)
