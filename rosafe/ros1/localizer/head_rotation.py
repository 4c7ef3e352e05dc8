"""The rotation of the head at the time of each frame, from tf."""

from __future__ import annotations

import math
import time
from typing import NamedTuple, Protocol

import numpy as np
import rospy
from numpy.typing import NDArray

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.ros1.localizer.status import OK, WARN, NodeStatus
from rosafe.ros1.localizer.transforms import TransformBuffer

MAX_WAIT = 0.2  # s that a frame waits for its transform
MAX_TILT = 15.0  # degrees of pitch or roll
JUMP_SECONDS = 1.0  # a step back of the time by more than this is another run: `rosbag play` in a loop


class Rotation(NamedTuple):
    """The rotation for the first `len(yaw)` frames of those that were looked up; the others have to wait.

    Attributes
    ----------
    yaw : ndarray, (n,)
        Direction of the head in degrees in world coordinates.
    known : ndarray of bool, (n,)
        False for frames without a rotation, which are dropped.
    """

    yaw: FloatArray
    known: NDArray[np.bool_]


class HeadRotation(Protocol):
    """A source of the rotation of the head."""

    def lookup(self, times: FloatArray) -> Rotation:
        """Return the rotation at clock times in s; called again for those that wait."""

    def close(self) -> None:
        """End."""


class FixedHead:
    """A head whose rotation is not used: azimuths are relative to it."""

    def lookup(self, times: FloatArray) -> Rotation:
        """Return a rotation of 0."""
        return Rotation(np.zeros(len(times)), np.ones(len(times), bool))

    def close(self) -> None:
        """Do nothing."""


class TransformedHead:
    """A head whose rotation relative to a world frame is published on /tf and /tf_static.

    Parameters
    ----------
    world_frame, head_frame : str
        Names of the coordinate frames; the head's has x ahead, y left and z up.
    audio_delay : float
        Latency of the sound card in s: a frame was heard earlier than its time says by this.
    status : NodeStatus
        Reports whether transforms are missing, and of a tilted head.

    Attributes
    ----------
    transforms : TransformBuffer
        Those that have arrived.
    """

    def __init__(self, world_frame: str, head_frame: str, audio_delay: float, status: NodeStatus) -> None:
        self.transforms = TransformBuffer(world_frame, head_frame)
        self._names = f"from {head_frame} to {world_frame}"
        self._delay = audio_delay
        self._status = status
        self._first: dict[float, float] = {}  # time of a frame -> when it was looked up first (time.monotonic)
        self._subscribers: list[rospy.Subscriber] = []
        self._latest = -math.inf  # time of a frame that was looked up
        self._known = False
        self._tilted = False
        status.set("rotation", WARN, f"waiting for the transform {self._names} on /tf", log=False)

    def subscribe(self) -> None:
        """Subscribe to the transforms."""
        from tf2_msgs.msg import TFMessage

        add = self.transforms.add
        self._subscribers = [
            rospy.Subscriber("/tf", TFMessage, add, callback_args=False, queue_size=100, tcp_nodelay=True),
            rospy.Subscriber("/tf_static", TFMessage, add, callback_args=True, queue_size=100),
        ]

    def lookup(self, times: FloatArray) -> Rotation:
        """See `HeadRotation`."""
        if len(times) and times[0] < self._latest - JUMP_SECONDS:
            self.transforms.clear()
            self._first.clear()
            self._latest = -math.inf
        now = time.monotonic()
        moments = times.tolist()
        first = self._first = {moment: self._first.get(moment, now) for moment in moments}
        yaws: list[float] = []
        for moment in moments:
            found = self.transforms.rotation(moment - self._delay)
            if found is None and now - first[moment] < MAX_WAIT:
                break
            self._latest = max(self._latest, moment)
            yaws.append(math.nan if found is None else self._yaw(*found))
        yaw = np.array(yaws)
        known = np.isfinite(yaw)
        if len(yaw):
            self._report(known)
        return Rotation(np.where(known, yaw, 0.0), known)

    def _yaw(self, x: float, y: float, z: float, w: float) -> float:
        """Return the rotation about the vertical axis of a quaternion in degrees, and report pitch and roll."""
        pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        tilt = math.degrees(max(abs(pitch), abs(roll)))
        if (tilt > MAX_TILT) != self._tilted:
            self._tilted = not self._tilted
            if self._tilted:
                text = f"the head is tilted by {tilt:.0f} degrees; directions are for a head that is upright"
                self._status.set("tilt", WARN, text)
            else:
                self._status.set("tilt", OK, "the head is upright", log=False)
        return math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))

    def _report(self, known: NDArray[np.bool_]) -> None:
        dropped = int(np.count_nonzero(~known))
        if dropped:
            self._status.count("frames without a transform", dropped)
        if known[-1] != self._known:
            self._known = bool(known[-1])
            if self._known:
                self._status.set("rotation", OK, f"the rotation of the head is known {self._names}", log=False)
            else:
                self._status.set("rotation", WARN, f"no transform {self._names} on /tf; the frames are dropped")

    def close(self) -> None:
        """Unsubscribe."""
        for subscriber in self._subscribers:
            subscriber.unregister()
