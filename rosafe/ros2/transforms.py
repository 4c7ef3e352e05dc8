"""Transforms of tf2: the rotation of the head from /tf, and that of a scene on /tf."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

from rosafe.localization.rotations import RotationBuffer
from rosafe.ros2.messages import ros_time


def subscribe(node: Node, buffer: RotationBuffer) -> None:
    """Fill a buffer from /tf and /tf_static."""
    latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(TFMessage, "/tf", _adding(buffer, static=False), QoSProfile(depth=100))
    node.create_subscription(TFMessage, "/tf_static", _adding(buffer, static=True), latched)


def _adding(buffer: RotationBuffer, static: bool) -> Callable[[Any], None]:
    def add(message: Any) -> None:
        for one in message.transforms:
            stamp, turn = one.header.stamp, one.transform.rotation
            time = stamp.sec + 1e-9 * stamp.nanosec
            buffer.add(one.child_frame_id, one.header.frame_id, time, (turn.x, turn.y, turn.z, turn.w), static)

    return add


class HeadTransform:
    """Publishes the rotation of the head of a scene.

    Parameters
    ----------
    node : Node
    world, head : str
        Names of the coordinate frames.
    """

    def __init__(self, node: Node, world: str, head: str) -> None:
        self._publisher = node.create_publisher(TFMessage, "/tf", QoSProfile(depth=100))
        self._transform = TransformStamped(child_frame_id=head)
        self._transform.header.frame_id = world

    def publish(self, time: float, yaw: float) -> None:
        """Publish a rotation about the z axis (rad) at a clock time in s."""
        self._transform.header.stamp = ros_time(time)
        rotation = self._transform.transform.rotation
        rotation.z, rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        self._publisher.publish(TFMessage(transforms=[self._transform]))
