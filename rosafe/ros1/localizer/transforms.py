"""The transforms of tf between two coordinate frames, with limits."""

from __future__ import annotations

import importlib
import math
import threading
from typing import Any

import rospy

from rosafe.system.log_throttle import ThrottledLog
from rosafe.system.terminal import printable

CACHE_SECONDS = 10.0  # of transforms
MAX_FRAMES = 1000  # coordinate frames
MAX_NAME = 256  # characters of the name of a coordinate frame
_NORM_TOLERANCE = 1e-2  # of a quaternion, as in tf2

_report = ThrottledLog(rospy.logwarn, 60.0)


class TransformBuffer:
    """The transforms between two coordinate frames, interpolated in time by tf2.

    Dynamic transforms are kept only if they are above one of the two: a robot publishes hundreds of others.

    Parameters
    ----------
    world, head : str
        Names of the coordinate frames.
    """

    def __init__(self, world: str, head: str) -> None:
        tf2_py = importlib.import_module("tf2_py")  # Debian's python3-tf2; without a world frame it is not needed

        self._world, self._head = world, head
        self._errors = tf2_py.TransformException
        self._buffer = tf2_py.BufferCore(rospy.Duration.from_sec(CACHE_SECONDS))
        self._lock = threading.Lock()
        self._parents: dict[str, str] = {}
        self._names = self._relevant = {world, head}
        self._latest: dict[str, rospy.Time] = {}  # the newest stamp of each relevant frame
        self._subscribers: list[rospy.Subscriber] = []

    def subscribe(self) -> None:
        """Subscribe to /tf and /tf_static."""
        from tf2_msgs.msg import TFMessage

        self._subscribers = [
            rospy.Subscriber("/tf", TFMessage, self.add, callback_args=False, queue_size=100, tcp_nodelay=True),
            rospy.Subscriber("/tf_static", TFMessage, self.add, callback_args=True, queue_size=100),
        ]

    def close(self) -> None:
        """Unsubscribe."""
        for subscriber in self._subscribers:
            subscriber.unregister()

    def clear(self) -> None:
        """Forget all transforms except the static ones."""
        with self._lock:
            self._buffer.clear()
            self._latest.clear()

    def rotation(self, moment: float) -> tuple[float, float, float, float] | None:
        """Return the quaternion x, y, z, w of the head in the world at a clock time in s; None if it is not known."""
        try:
            found = self._buffer.lookup_transform_core(self._world, self._head, rospy.Time.from_sec(max(moment, 1e-9)))
        except self._errors:
            return None
        turn = found.transform.rotation
        return turn.x, turn.y, turn.z, turn.w

    def add(self, message: Any, static: bool) -> None:
        """Add the transforms of a message of /tf or, `static`, of /tf_static."""
        with self._lock:
            for transform in message.transforms:
                child, parent = transform.child_frame_id.lstrip("/"), transform.header.frame_id.lstrip("/")
                if self._parents.get(child) != parent:
                    self._add_frame(child, parent, transform)
                if (static or child in self._relevant) and self._parents.get(child) == parent:
                    self._insert(child, transform, static)

    def _add_frame(self, child: str, parent: str, transform: Any) -> None:
        if not _is_valid(child, parent, transform.transform):
            _report(f"/tf: the transform of {printable(child)[:MAX_NAME]} is not valid and ignored", "invalid")
            return
        names = self._names | {child, parent}  # tf2 keeps those of former parents too
        if len(names) > max(MAX_FRAMES, len(self._names)):
            _report(f"/tf: more than {MAX_FRAMES} coordinate frames; the others are ignored", "number")
            return
        self._parents[child], self._names = parent, names
        self._relevant = {name for end in (self._world, self._head) for name in self._chain(end)}

    def _chain(self, name: str) -> list[str]:
        """Return a coordinate frame and those above it."""
        chain = [name]
        while (parent := self._parents.get(chain[-1])) is not None and parent not in chain:
            chain.append(parent)
        return chain

    def _insert(self, child: str, transform: Any, static: bool) -> None:
        if not _is_valid(child, self._parents[child], transform.transform):
            return
        stamp = transform.header.stamp
        if not static:
            if (self._latest.get(child, stamp) - stamp).to_sec() > CACHE_SECONDS:  # time has jumped back
                self._buffer.clear()
                self._latest.clear()
            self._latest[child] = max(stamp, self._latest.get(child, stamp))
        insert = self._buffer.set_transform_static if static else self._buffer.set_transform
        insert(transform, "tf")


def _is_valid(child: str, parent: str, transform: Any) -> bool:
    """Return whether tf2 accepts a transform; it would write others to the log, each time."""
    rotation, shift = transform.rotation, transform.translation
    norm = sum(part * part for part in (rotation.x, rotation.y, rotation.z, rotation.w))  # ** raises OverflowError
    names = child and parent and child != parent and max(len(child), len(parent)) <= MAX_NAME
    return bool(names) and abs(norm - 1) < _NORM_TOLERANCE and math.isfinite(shift.x + shift.y + shift.z)
