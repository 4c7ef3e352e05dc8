"""The Audio port of the node: its subscription, the ring of received frames, and its diagnostics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rospy
from diagnostic_msgs.msg import DiagnosticStatus

from rosafe.audio.files.windows import MAX_WINDOW
from rosafe.audio.stream.ring import AudioReader, AudioRing
from rosafe.interface import ROSAFE
from rosafe.ros1.component import serialization
from rosafe.system.log_throttle import ThrottledLog
from rosafe.tree.tree import Tree

RECEIVE_BYTES = 4096  # that rospy reads at a time; the rest of a message is received without its buffer
FIRST_AUDIO_SECONDS = 1.0  # that InputProc waits for the first message


class AudioInput:
    """The Audio port.

    Parameters
    ----------
    warn : callable
        Called with lines for the log about lost or malformed audio.

    Attributes
    ----------
    ring : AudioRing
        The received frames.
    topic : str
        The connected topic; empty if the port is not connected.
    """

    def __init__(self, warn: Callable[[str], None]) -> None:
        self.ring = AudioRing(ThrottledLog(warn))
        self.topic = ""
        self._subscriber: rospy.Subscriber | None = None

    def connect(self, topic: str) -> None:
        """Subscribe to `topic` instead of the previous one."""
        if self._subscriber is not None:
            self._subscriber.unregister()
        feed = self.ring.connect()

        def receive(message: Any) -> None:
            if message.problem:
                self.ring.refuse(message.problem)
            else:
                feed(message)

        self.topic = topic
        self._subscriber = rospy.Subscriber(
            topic,
            serialization.tolerant_message_class("rosAFE", "::binaudio::portStruct", MAX_WINDOW),
            receive,
            buff_size=RECEIVE_BYTES,
            queue_size=None,  # no message is dropped: a window can be shorter than a pause of this thread
            tcp_nodelay=True,
        )

    def close(self) -> None:
        """Unsubscribe."""
        if self._subscriber is not None:
            self._subscriber.unregister()

    def open_reader(self, frames_per_block: int, interrupted: Callable[[], bool]) -> AudioReader | None:
        """Return a reader that starts with the next frame; None without audio, or if `interrupted()`."""
        if not self.topic:
            raise ROSAFE.error("e_noData", "the Audio port is not connected: call connect_port first")
        return self.ring.open_reader(frames_per_block, FIRST_AUDIO_SECONDS, interrupted)

    def report(self, status: Any, tree: Tree) -> Any:
        """Fill in a status of /diagnostics."""
        counters, rate = self.ring.counters, self.ring.sample_rate
        if tree.input is not None and rate not in (0, tree.sample_rate):
            status.summary(
                DiagnosticStatus.ERROR, f"Audio is at {rate} Hz, the tree at {tree.sample_rate:g} Hz: call Stop"
            )
        elif lag := self.ring.lag:
            status.summary(DiagnosticStatus.WARN, lag)
        elif counters.lost or counters.dropped or counters.refused or counters.breaks:
            status.summary(
                DiagnosticStatus.WARN,
                f"{counters.lost} frames lost in {counters.gaps} gaps, {counters.dropped} dropped, "
                f"{counters.refused} messages refused, {counters.breaks} breaks",
            )
        else:
            status.summary(DiagnosticStatus.OK, "no frames lost" if counters.messages else "no audio yet")
        status.add("topic", self.topic or "not connected")
        status.add("sample rate (Hz)", str(rate))
        status.add("frames waiting", str(self.ring.behind))
        for name, value in vars(counters).items():
            status.add(name.replace("_", " "), str(value))
        return status
