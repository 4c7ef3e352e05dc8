"""Transforms of tf2: the rotation of the head from /tf, and that of a scene on /tf."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosafe_msgs.msg import SceneTruth
from tf2_msgs.msg import TFMessage

from rosafe.localization.rotations import RotationBuffer
from rosafe.ros2.messages import ros_time


def subscribe(node: Node, buffer: RotationBuffer) -> None:
    """Fill a buffer from /tf and /tf_static."""
    latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for topic, static, qos in (("/tf", False, QoSProfile(depth=100)), ("/tf_static", True, latched)):
        add = functools.partial(buffer.add_message, static=static, seconds=_seconds)
        node.create_subscription(TFMessage, topic, add, qos)


def _seconds(stamp: Time) -> float:
    return float(stamp.sec + 1e-9 * stamp.nanosec)


class TruthTopics:
    """Publishes the truth of a scene, and the rotation of its head on /tf, whose publisher the first one creates.

    Parameters
    ----------
    node : Node
    frames : tuple of two str
        Names of the coordinate frames of the world and of the head.
    now : callable
        Returns the clock time of the node in s.
    """

    def __init__(self, node: Node, frames: tuple[str, str], now: Callable[[], float]) -> None:
        self._node, self._now = node, now
        self._truth = node.create_publisher(SceneTruth, "~/scene_truth", QoSProfile(depth=5))
        self._rotation: Any = None
        self._transform = TransformStamped(child_frame_id=frames[1])
        self._transform.header.frame_id = frames[0]

    def publish(self, frame: int, moment: float, truth: Any) -> None:
        """Publish the truth at an audio frame, whose time is on the clock of time.monotonic."""
        stamp = ros_time(self._now() - (time.monotonic() - moment))
        yaw = math.radians(truth.head_yaw)
        azimuths = [math.radians(azimuth) for azimuth in truth.azimuths]
        message = SceneTruth(stamp=stamp, frame_index=frame, head_yaw=yaw, azimuths=azimuths)
        message.names = list(truth.names)
        self._truth.publish(message)
        if self._rotation is None:
            self._rotation = self._node.create_publisher(TFMessage, "/tf", QoSProfile(depth=100))
        self._transform.header.stamp = stamp
        rotation = self._transform.transform.rotation
        rotation.z, rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        self._rotation.publish(TFMessage(transforms=[self._transform]))
