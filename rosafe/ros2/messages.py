"""Messages of ROS 2: times, arrays, diagnostics, transforms of tf2, and the truth of a scene."""

from __future__ import annotations

import array
import functools
import math
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosafe_msgs.msg import SceneTruth
from tf2_msgs.msg import TFMessage

from rosafe.localization.rotations import RotationBuffer
from rosafe.system.clocks import clock_difference

MAX_SECONDS = 2**31 - 1  # since 1970, of a time of ROS 2


def ros_time(seconds: float) -> Time:
    """Return a time in s as a time of ROS; 0 for a negative one."""
    whole, nanoseconds = divmod(max(0, round(seconds * 1e9)), 1_000_000_000)
    return Time(sec=min(whole, MAX_SECONDS), nanosec=nanoseconds)


def clock_offset(node: Node) -> float:
    """Return by how much the clock of a node is ahead of the system's (s); 0 without `use_sim_time`."""
    clock = node.get_clock()
    if not clock.ros_time_is_active:
        return 0.0
    return clock_difference(lambda: clock.now().nanoseconds / 1e9, time.time)


def numbers(values: Any) -> array.array[float]:
    """Return numbers, row-major, for a field float64[]: an array is assigned at once, a list number by number."""
    return array.array("d", np.ascontiguousarray(values, np.float64).tobytes())


class DiagnosticReport:
    """A status of /diagnostics that a part of the node fills in."""

    def __init__(self, name: str) -> None:
        self.message = DiagnosticStatus(level=b"\0", name=name, hardware_id="none")

    def summary(self, level: int, text: str) -> None:
        """Set level and text."""
        self.message.level, self.message.message = bytes([level]), text

    def add(self, key: str, value: object) -> None:
        """Add an entry."""
        self.message.values.append(KeyValue(key=key, value=str(value)))


def diagnostics(stamp: Time, node: str, parts: Iterable[tuple[str, Callable[[Any], object]]]) -> DiagnosticArray:
    """Return the message of /diagnostics: one status for each part, filled in by its function."""
    message = DiagnosticArray()
    message.header.stamp = stamp
    for name, fill_in in parts:
        report = DiagnosticReport(f"{node}: {name}")
        fill_in(report)
        message.status.append(report.message)
    return message


# --- transforms and the truth of a scene --------------------------------------------------------------------------


def subscribe_transforms(node: Node, buffer: RotationBuffer) -> None:
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
        stamp = ros_time(moment + clock_difference(self._now, time.monotonic))
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
