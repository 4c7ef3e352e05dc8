"""The ports that somebody looks at: one subscription each, and which frames of its windows are new."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import rospy

from rosafe.component import serialization
from rosafe.interface import LAYOUTS
from rosafe.live.plot_data import ProcessorInfo
from rosafe.sound.windows import MAX_INDEX, MAX_WINDOW, new_frames, split_new_frames, window_error
from rosafe.terminal import printable
from rosafe.transport.log_throttle import ThrottledLog

BUFFER = 2**17  # bytes that are read at a time: more of them cost more to make than turns do
AUDIO_RATE_SLACK = 0.5  # frames
FORGET_SECONDS = 3.0  # after the last malformed message a topic is well again
CHANGE_SECONDS = 3.0  # in which messages of a changed tree may come before the tree itself

_report = ThrottledLog(rospy.logwarn)


class _Subscription:
    """One topic, subscribed until `close`. Malformed messages are ignored, and reported once.

    Parameters
    ----------
    topic : str
    message_class : type
        Of messages whose `problem` says why they cannot be read.
    patience : float
        Seconds for which malformed messages are ignored without a report.
    """

    def __init__(self, topic: str, message_class: Any, patience: float) -> None:
        self.topic = topic
        self._patience = patience
        self._closed = False
        self._lock = threading.Lock()
        self._problem = ""
        self._reported = False
        self._first = self._last = -FORGET_SECONDS  # malformed message, of time.monotonic
        self._subscriber = rospy.Subscriber(
            topic, message_class, self._received, queue_size=1, buff_size=BUFFER, tcp_nodelay=True
        )

    @property
    def problem(self) -> str:
        """Why messages of late were ignored; empty if none were."""
        return self._problem if self._reported and time.monotonic() < self._last + FORGET_SECONDS else ""

    def close(self) -> None:
        """Subscribe no longer."""
        self._closed = True
        self._subscriber.unregister()

    def _received(self, message: Any) -> None:
        with self._lock:
            if self._closed:
                return
            try:
                problem = message.problem or self._accept(message)
            except Exception as fault:  # else rospy would log a traceback for each message
                problem = f"{type(fault).__name__}: {fault}"
            if problem:
                self._ignore(problem)

    def _ignore(self, problem: str) -> None:
        now = time.monotonic()
        if now >= self._last + FORGET_SECONDS:
            self._first, self._reported = now, False
        self._last, self._problem = now, printable(problem)[:300]
        if not self._reported and now >= self._first + self._patience:
            self._reported = True
            _report(f"{self.topic}: malformed messages are ignored: {self._problem}", self.topic)

    def _accept(self, message: Any) -> str:
        """Use a message; why it cannot be used, if so."""
        raise NotImplementedError


class PortReader(_Subscription):
    """The topic of one processor, subscribed from the making of this until `close`.

    Parameters
    ----------
    processor : Processor
    rows : mapping
        The shape of one frame of each field of its messages.
    sample_rate : float
        Of the audio, Hz.
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
        self,
        processor: ProcessorInfo,
        rows: Mapping[str, tuple[int, ...]],
        sample_rate: float,
        take: Callable[[PortReader, Any], None],
    ) -> None:
        self.rate, self.sample_rate = processor.rate, sample_rate
        self.newest = self.fresh = self.lost = 0
        self.index = -1
        self.end = 0.0
        self._take, self._rows = take, rows
        self._probe = next(iter(rows))  # the field that tells how far the window has moved on
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
            self._take(self, message)
        return problem

    def _malformed(self, message: Any, index: int) -> str:
        if index >= MAX_INDEX:
            return f"lastFrameIndex {index} is out of range"
        frames = -1
        for field, rows in self._rows.items():
            samples = getattr(message, field)
            if not isinstance(samples, np.ndarray):
                return f"{field}: expected rows of one length, got different ones"
            frames = samples.shape[-1] if frames < 0 else frames
            if samples.shape != (*rows, frames):
                return f"{field}: expected an array of shape {(*rows, frames)}, got {samples.shape}"
        return ""

    def _advance(self, index: int, window: np.ndarray) -> None:
        """Count what a message brings."""
        frames = window.shape[-1]
        probe = window[0] if window.ndim == 3 else window  # one lag tells as much as all
        whole = index * self.rate / self.sample_rate
        if self._before is None or index < self.index or self._before.shape[:-1] != probe.shape[:-1]:
            self.newest = int(whole + 1e-6)
            lost, self.fresh = 0, min(frames, self.newest)  # what the window shows already
        else:
            expected = (index - self.index) * self.rate / self.sample_rate
            audio = abs(self.rate - self.sample_rate) < AUDIO_RATE_SLACK
            new = round(expected) if audio else new_frames(expected, probe, self._before)
            lost, self.fresh = split_new_frames(new, frames)
            self.newest += new
            if abs(self.newest - whole) > max(3.0, 0.05 * self.rate):  # of another stream: begin anew
                self.newest = int(whole)
        self.lost += lost
        self.index, self.end = index, index / self.sample_rate
        self._before = probe


class Audio(_Subscription):
    """The sound itself, as bass gives it out, for the level meters: one subscription until `close`.

    Attributes
    ----------
    sample_rate : int
    heard_at : float
        When the last message came, of time.monotonic; 0 before the first.
    """

    def __init__(self, topic: str, take: Callable[[np.ndarray, int, float], None]) -> None:
        self.sample_rate = 0
        self.heard_at = 0.0
        self.delay = 0.0  # s, from the end of the newest chunk to here
        self._take = take
        self._index = 0
        self._mark = (0, 0.0)  # a frame, and when it was captured (s, clock)
        super().__init__(topic, serialization.tolerant_message_class("bass", "::binaudio::portStruct", MAX_WINDOW), 0.0)

    def captured_at(self, index: int) -> float | None:
        """When the audio frame `index` was captured (s, of the clock); None where nobody knows."""
        frame, at = self._mark
        return at + (index - frame) / self.sample_rate if at and self.sample_rate else None

    def _accept(self, message: Any) -> str:
        if problem := window_error(message):
            return problem
        index, rate = int(message.lastFrameIndex), int(message.sampleRate)
        if index == self._index:
            return ""
        window = len(message.left)
        fresh = index - self._index if 0 < self._index < index else int(message.nFramesPerChunk)
        lost, count = split_new_frames(fresh, min(window, index))
        self._index, self.sample_rate = index, rate
        stamp = message.stamp.sec + 1e-9 * message.stamp.nsec
        self._mark = index, stamp
        self.delay = time.time() - stamp if stamp else 0.0
        self.heard_at = time.monotonic()
        if count:
            samples = np.stack((message.left[window - count :], message.right[window - count :]))
            self._take(samples, lost, index / rate)
        return ""
