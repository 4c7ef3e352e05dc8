"""Subscriptions to the ports and the audio that the views need, and the new frames in each of their windows."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import rospy

from rosafe.audio.files.windows import MAX_INDEX, MAX_WINDOW, new_frames, samples_after, split_new_frames, window_error
from rosafe.interface import LAYOUTS
from rosafe.ros1.component import serialization
from rosafe.ros1.transport.log_throttle import ThrottledLog
from rosafe.system.terminal import printable
from rosafe.web.live.plot_data import ProcessorInfo

READ_BYTES = 2**17  # per read: allocating a larger buffer takes longer than reading several times
AUDIO_RATE_SLACK = 0.5  # frames
FORGET_SECONDS = 3.0  # after the last malformed message until the problem is no longer shown
CHANGE_SECONDS = 3.0  # in which messages of a changed tree may arrive before the new tree is known

_report = ThrottledLog(rospy.logwarn)


class _Subscription:
    """One topic, subscribed until `close`. Malformed messages are ignored, and reported once.

    Parameters
    ----------
    topic : str
    message_class : type
        Its messages have an attribute `problem`: the reason why they cannot be read, or an empty string.
    grace_seconds : float
        Time for which malformed messages are ignored without a report.
    """

    def __init__(self, topic: str, message_class: Any, grace_seconds: float) -> None:
        self.topic = topic
        self._grace_seconds = grace_seconds
        self._closed = False
        self._lock = threading.Lock()
        self._problem = ""
        self._reported = False
        self._first = self._last = -FORGET_SECONDS  # time.monotonic() of malformed messages
        self._subscriber = rospy.Subscriber(
            topic, message_class, self._received, queue_size=1, buff_size=READ_BYTES, tcp_nodelay=True
        )

    @property
    def problem(self) -> str:
        """Why the latest messages were ignored; empty if they were not."""
        return self._problem if self._reported and time.monotonic() < self._last + FORGET_SECONDS else ""

    def close(self) -> None:
        """Unsubscribe."""
        self._closed = True
        self._subscriber.unregister()

    def _received(self, message: Any) -> None:
        with self._lock:
            if self._closed:
                return
            try:
                problem = message.problem or self._accept(message)
            except Exception as fault:  # otherwise, rospy logs a traceback for each message
                problem = f"{type(fault).__name__}: {fault}"
            if problem:
                self._ignore(problem)

    def _ignore(self, problem: str) -> None:
        now = time.monotonic()
        if now >= self._last + FORGET_SECONDS:
            self._first, self._reported = now, False
        self._last, self._problem = now, printable(problem)[:300]
        if not self._reported and now >= self._first + self._grace_seconds:
            self._reported = True
            _report(f"{self.topic}: malformed messages are ignored: {self._problem}", self.topic)

    def _accept(self, message: Any) -> str:
        """Use a message; return a problem if it is malformed, or an empty string."""
        raise NotImplementedError


class PortReader(_Subscription):
    """The topic of one processor, subscribed until `close`.

    Parameters
    ----------
    processor : ProcessorInfo
    shapes : mapping
        The shape of one frame of each field of its messages.
    sample_rate : float
        Of the audio, Hz.
    callback : callable
        Called with this port and a message, on rospy's thread, after `newest` and `lost` have been updated.

    Attributes
    ----------
    newest : int
        Number of frames since the start of the audio.
    fresh : int
        Number of new frames in the last message.
    lost : int
        Frames that were missing in the received windows, since the subscription.
    end : float
        Time of the audio at the end of the newest frame, s.
    """

    def __init__(
        self,
        processor: ProcessorInfo,
        shapes: Mapping[str, tuple[int, ...]],
        sample_rate: float,
        callback: Callable[[PortReader, Any], None],
    ) -> None:
        self.rate, self.sample_rate = processor.rate, sample_rate
        self.newest = self.fresh = self.lost = 0
        self.index = -1
        self.end = 0.0
        self._callback, self._shapes = callback, shapes
        self._probe = next(iter(shapes))  # the field that is compared to find the new frames
        self._before: np.ndarray | None = None
        message_class = serialization.tolerant_message_class("rosAFE", LAYOUTS[processor.kind].idl)
        super().__init__(processor.topic, message_class, CHANGE_SECONDS)

    def _accept(self, message: Any) -> str:
        index = int(message.lastFrameIndex)
        if index in (0, self.index):  # 0: a processor that has just started
            return ""
        problem = self._malformed(message, index)
        if not problem:
            self._advance(index, getattr(message, self._probe))
            self._callback(self, message)
        return problem

    def _malformed(self, message: Any, index: int) -> str:
        if index >= MAX_INDEX:
            return f"lastFrameIndex {index} is out of range"
        frames = -1
        for field, shape in self._shapes.items():
            samples = getattr(message, field)
            if not isinstance(samples, np.ndarray):
                return f"{field}: expected rows of one length, got different ones"
            frames = samples.shape[-1] if frames < 0 else frames
            if samples.shape != (*shape, frames):
                return f"{field}: expected an array of shape {(*shape, frames)}, got {samples.shape}"
        return ""

    def _advance(self, index: int, window: np.ndarray) -> None:
        """Count the new and the lost frames of a message."""
        frames = window.shape[-1]
        probe = window[0] if window.ndim == 3 else window  # one lag is sufficient
        whole = index * self.rate / self.sample_rate
        if self._before is None or index < self.index or self._before.shape[:-1] != probe.shape[:-1]:
            self.newest = int(whole + 1e-6)
            lost, self.fresh = 0, min(frames, self.newest)  # the whole window is new
        else:
            expected = (index - self.index) * self.rate / self.sample_rate
            audio = abs(self.rate - self.sample_rate) < AUDIO_RATE_SLACK
            new = round(expected) if audio else new_frames(expected, probe, self._before)
            lost, self.fresh = split_new_frames(new, frames)
            self.newest += new
            if abs(self.newest - whole) > max(3.0, 0.05 * self.rate):  # another stream has started
                self.newest = int(whole)
        self.lost += lost
        self.index, self.end = index, index / self.sample_rate
        self._before = probe


class Audio(_Subscription):
    """The audio of bass for the level meters, subscribed until `close`.

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
        self._callback = callback
        self._index = 0
        self._captured = (0, 0.0)  # a frame, and the time of its capture (s, clock)
        super().__init__(topic, serialization.tolerant_message_class("bass", "::binaudio::portStruct", MAX_WINDOW), 0.0)

    def captured_at(self, index: int) -> float | None:
        """Return the time of capture (s, clock) of the audio frame `index`, or None if it is not known."""
        frame, at = self._captured
        return at + (index - frame) / self.sample_rate if at and self.sample_rate else None

    def time_at(self, moment: float) -> float | None:
        """Return the time of the audio (s) at a time of the clock (s), or None if it is not known."""
        frame, at = self._captured
        return frame / self.sample_rate + moment - at if at and self.sample_rate else None

    def _accept(self, message: Any) -> str:
        if problem := window_error(message):
            return problem
        index, rate = int(message.lastFrameIndex), int(message.sampleRate)
        if index == self._index:
            return ""
        newest = self._index if 0 < self._index < index else max(0, index - int(message.nFramesPerChunk))
        _, samples = samples_after(message, newest)
        self._index, self.sample_rate = index, rate
        stamp = message.stamp.sec + 1e-9 * message.stamp.nsec
        self._captured = index, stamp
        self.delay = time.time() - stamp if stamp else 0.0
        self.received_at = time.monotonic()
        if samples.size:
            self._callback(samples, index / rate)
        return ""
