"""Messages of ROS 2: times, arrays, diagnostics."""

from __future__ import annotations

import array
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

MAX_SECONDS = 2**31 - 1  # since 1970, of a time of ROS 2


def ros_time(seconds: float) -> Time:
    """Return a time in s as a time of ROS; 0 for a negative one."""
    whole, nanoseconds = divmod(max(0, round(seconds * 1e9)), 1_000_000_000)
    return Time(sec=min(whole, MAX_SECONDS), nanosec=nanoseconds)


def clock_offset(node: Node) -> float:
    """Return by how much the clock of a node is ahead of the system's (s); 0 without `use_sim_time`."""
    clock = node.get_clock()
    return clock.now().nanoseconds / 1e9 - time.time() if clock.ros_time_is_active else 0.0


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
