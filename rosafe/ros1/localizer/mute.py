"""Frames that are not used because the robot speaks."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import rospy
from numpy.typing import NDArray

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.ros1.localizer.status import OK, NodeStatus

AFTER_SECONDS = 0.3  # after the robot has spoken, for the reverberation of its voice
JUMP_SECONDS = 1.0  # a step back of the time by more than this is another run: `rosbag play` in a loop
_MAX_INTERVALS = 100


class Mute:
    """Whether the robot speaks, from the topic ~mute (std_msgs/Bool).

    Parameters
    ----------
    audio_delay : float
        Latency of the sound card in s: a frame was heard earlier than its time says by this.
    status : NodeStatus
        Reports whether the localizer is muted.
    """

    def __init__(self, audio_delay: float, status: NodeStatus) -> None:
        from std_msgs.msg import Bool

        self._delay = audio_delay
        self._status = status
        self._lock = threading.Lock()
        self._intervals: list[list[float]] = []  # begin and end (inf: not yet) in clock time, s
        self._now = 0.0  # the latest time
        status.value("muted", "no")
        self._subscriber = rospy.Subscriber("~mute", Bool, self._receive, queue_size=10, tcp_nodelay=True)

    def _receive(self, message: Any) -> None:
        with self._lock:
            now = self._advance()
            on = bool(self._intervals) and self._intervals[-1][1] == math.inf
            if message.data and not on:
                self._intervals = [*self._intervals[1 - _MAX_INTERVALS :], [now, math.inf]]
            elif not message.data and on:
                self._intervals[-1][1] = now + AFTER_SECONDS
        if message.data:
            self._status.value("muted", "yes")
            self._status.set("mute", OK, "muted: ~mute is true, and sound is not used")
        elif on:
            self._status.value("muted", "no")
            self._status.clear("mute")

    def _advance(self) -> float:
        """Return the present time. If it has jumped back, forget the intervals, except one that has not ended."""
        now = rospy.get_time()
        if now < self._now - JUMP_SECONDS:
            self._intervals = [[now, end] for _, end in self._intervals[-1:] if end == math.inf]
            self._now = now
        self._now = max(self._now, now)
        return now

    @property
    def active(self) -> bool:
        """Whether sound is not used at present."""
        if not self._intervals:
            return False
        with self._lock:
            now = self._advance()
            return bool(self._intervals) and self._intervals[-1][1] > now

    def muted(self, times: FloatArray) -> NDArray[np.bool_]:
        """Return whether frames at clock times in s are muted."""
        found = np.zeros(len(times), bool)
        if not self._intervals:
            return found
        with self._lock:
            self._advance()
            intervals = list(self._intervals)
        heard = times - self._delay
        for begin, end in intervals:
            found |= (heard >= begin) & (heard <= end)
        return found

    def close(self) -> None:
        """Unsubscribe."""
        self._subscriber.unregister()
