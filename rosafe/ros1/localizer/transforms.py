"""The transforms of tf between two coordinate frames."""

from __future__ import annotations

import functools

import rospy

from rosafe.localization.rotations import RotationBuffer
from rosafe.system.log_throttle import ThrottledLog

_report = ThrottledLog(rospy.logwarn, 60.0)


class TransformBuffer(RotationBuffer):
    """The rotations between two coordinate frames, subscribed.

    Parameters
    ----------
    world, head : str
        Names of the coordinate frames.
    """

    def __init__(self, world: str, head: str) -> None:
        super().__init__(world, head, _report)
        self._subscribers: list[rospy.Subscriber] = []

    def subscribe(self) -> None:
        """Subscribe to /tf and /tf_static."""
        from tf2_msgs.msg import TFMessage  # without a world frame it is not needed

        for topic, static in (("/tf", False), ("/tf_static", True)):
            add = functools.partial(self.add_message, static=static, seconds=rospy.Time.to_sec)
            self._subscribers.append(rospy.Subscriber(topic, TFMessage, add, queue_size=100, tcp_nodelay=True))

    def close(self) -> None:
        """Unsubscribe."""
        for subscriber in self._subscribers:
            subscriber.unregister()
