"""The data that the localizer receives from rosAFE: new frames of its four ports, and the sound of the input."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import rospy

from rosafe.audio.files.windows import MAX_INDEX, WindowStream
from rosafe.audio.stream.ring_sound import RingSound, loss_report
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.interface import LAYOUTS
from rosafe.localization import cues
from rosafe.localization.live import FrameFormat, NewFrames, Status, StreamRestartedError
from rosafe.ros import FrameClock
from rosafe.ros1.afe.audio_input import AudioInput
from rosafe.ros1.component import serialization

READ_BYTES = 2**17  # per read of a subscriber
KEPT_MESSAGES = 8  # of each port, until the other ports have the same block
_CURRENT = 2.0  # s, at most, between the newest sound and the newest time of the same stream


class _Port:
    """The messages of one port. All methods but `close` need the lock of the source."""

    def __init__(self, topic: str, kind: str, format_: FrameFormat, source: PortSource) -> None:
        self.kind = kind
        self.problem = ""
        self.messages: dict[int, Any] = {}  # the newest, by lastFrameIndex
        self.window = 0  # samples for which the newest message has frames
        self.stream = WindowStream(format_.hop, format_.window)  # of the blocks that were used
        self._format = format_
        self._source = source
        self._newest = 0
        self._used: Any = None
        self._subscriber = rospy.Subscriber(
            topic,
            serialization.tolerant_message_class("rosAFE", LAYOUTS[kind].idl),
            self._receive,
            queue_size=KEPT_MESSAGES,
            buff_size=READ_BYTES,
            tcp_nodelay=True,
        )

    def close(self) -> None:
        """Unsubscribe."""
        self._subscriber.unregister()

    def _receive(self, message: Any) -> None:
        with self._source.lock:
            self._keep(message)
            ready = bool(self.problem) or self._source.is_ready()
        if ready:
            self._source.received()

    def _keep(self, message: Any) -> None:
        """Keep a message if it can be used."""
        if problem := message.problem or self._malformed(message):
            self.problem = problem
            return
        index = int(message.lastFrameIndex)
        if not index:  # a processor that has just started
            return
        if index < self._newest:  # another stream
            self.messages.clear()
        self._newest, self.window = index, int(message.framesOnPort) * self._format.hop
        while len(self.messages) >= KEPT_MESSAGES:
            self.messages.pop(next(iter(self.messages)))
        self.messages[index] = message

    def _malformed(self, message: Any) -> str:
        if message.lastFrameIndex >= MAX_INDEX:
            return f"{self.kind}: lastFrameIndex {message.lastFrameIndex} is out of range"
        if not message.lastFrameIndex:
            return ""
        for samples in (message.left, message.right) if self.kind == "ratemap" else (message.left,):
            shape = getattr(samples, "shape", ("of several lengths",))
            if shape != (self._format.channels, message.framesOnPort) or not message.framesOnPort:
                return f"{self.kind}: expected {self._format.channels} channels, got an array of shape {shape}"
        return ""

    def advance(self, index: int) -> None:
        """Use the block up to `index`."""
        self.problem = ""
        self._used = self.messages[index]
        self.messages = {other: kept for other, kept in self.messages.items() if other > index}
        self.stream.advance(index - 1, self._used.left)

    @property
    def first(self) -> int:
        """Number of the first frame of the block that was used last."""
        return self.stream.frames - int(self._used.framesOnPort)

    def frames(self, begin: int, end: int) -> FloatArray:
        """Return the frames with the numbers from `begin` to `end`."""
        columns = slice(begin - self.first, end - self.first)
        if self.kind == "ratemap":
            return np.stack((self._used.left[:, columns], self._used.right[:, columns]))
        return np.asarray(self._used.left[:, columns])


class PortSource:
    """New frames of the representations, from rospy's threads to the one that localizes.

    Parameters
    ----------
    topics : mapping
        The topic of each representation of `cues.KINDS`.
    format_ : FrameFormat
        Of the frames.
    clock : FrameClock
        Of the rosAFE node.
    received : callable
        Called when `take` returns frames, on rospy's threads.

    Attributes
    ----------
    least : int
        Samples of new sound for which `take` waits, unless the ports are shorter.
    """

    def __init__(
        self, topics: Mapping[str, str], format_: FrameFormat, clock: FrameClock, received: Callable[[], None]
    ) -> None:
        self.format = format_
        self.received = received
        self.least = 0
        self.lock = threading.Lock()
        self._clock = clock
        self._index = 0  # block that was used last
        self._done = 0  # number of the frame after those that were taken
        self._end = 0.0  # last sample of frame 0, which is before the first that is taken
        with self.lock:  # messages wait for the last port
            self._ports = [_Port(topics[kind], kind, format_, self) for kind in cues.KINDS]

    def close(self) -> None:
        """Unsubscribe."""
        for port in self._ports:
            port.close()

    @property
    def problem(self) -> str:
        """Why messages cannot be used; empty if they can."""
        return next((port.problem for port in self._ports if port.problem), self._clock.problem)

    def _newest_block(self) -> int:
        """Return the newest block that all ports have; 0 if there is none."""
        first, *others = (port.messages for port in self._ports)
        return max((index for index in first if all(index in messages for messages in others)), default=0)

    def is_ready(self) -> bool:
        """Return whether there are enough new blocks. Needs the lock."""
        newest = self._newest_block()
        new = newest - self._index
        enough = new <= 0 or new >= self.least or new + self.format.block > min(port.window for port in self._ports)
        return newest > 0 and enough

    def _has_time(self, index: int) -> bool:
        return self._clock.covers(index - 1, self.format.sample_rate)

    @property
    def missing(self) -> str:
        """The kind of message that does not arrive: sound, or the times of frames that have arrived."""
        with self.lock:
            newest = self._newest_block()
            return "sound: no new frames from rosAFE" if self._has_time(newest) or not newest else self._clock.topic

    def take(self) -> NewFrames | None:
        """Return the frames since the last call; None if they are not enough, or their times are not known yet.

        The first call after messages have arrived returns none: frames are counted from there.

        Raises
        ------
        StreamRestartedError
            Another stream has started; the next call continues with it.
        """
        with self.lock:
            newest = self._newest_block()
            if not self.is_ready() or newest == self._index or not self._has_time(newest):  # or all are sent again
                return None
            before, self._index = self._index, newest
            restarted = self._index < before
            for port in self._ports:
                port.advance(self._index)
            if not before or restarted:
                self._done = self._ports[0].stream.frames
                self._end = self._index - 1 - self.format.rest - self._done * self.format.hop
            if restarted:
                raise StreamRestartedError(f"the frame index fell from {before} to {self._index}")
            return self._new()

    def _new(self) -> NewFrames | None:
        first = max(self._done, *(port.first for port in self._ports))
        end = min(port.stream.frames for port in self._ports)
        if end <= first:
            return None
        lost, self._done = first - self._done, end
        hop = self.format.hop
        # The position of the frames in the block is known better with each block, if the hop does not divide it.
        newest = min(max(self._end + end * hop, self._index - hop), self._index - 1)
        self._end = newest - end * hop
        moment = self._clock.time(newest).ros.to_sec()
        back = np.arange(end - first - 1, -1, -1) * hop + self.format.window / 2
        features = {port.kind: port.frames(first, end) for port in self._ports}
        return NewFrames(features, moment - back / self.format.sample_rate, lost)


class InputSound(RingSound):
    """A `LiveSound`, subscribed to the topic of the input: the sound of which sources are separated.

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
