"""A program with plain rclpy: it subscribes, publishes and calls services as lines of JSON on a socket say.

usage: robot.py SOCKET
"""

from __future__ import annotations

import importlib
import json
import math
import os
import socket
import sys
import time
from typing import Any

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions


def find(name: str) -> Any:
    """Return the class of a message or service, such as std_msgs/msg/Header."""
    package, kind, word = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), word)


def plain(value: Any) -> Any:
    """Return a message as JSON has it."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return list(value)
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, (str, int, float)):
        return value
    return [plain(item) for item in value]


def fill(message: Any, fields: dict[str, Any]) -> Any:
    """Set the fields of a message from JSON."""
    kinds = message.get_fields_and_field_types()
    for name, value in fields.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            element = find(kinds[name].removeprefix("sequence<").removesuffix(">").replace("/", "/msg/"))
            setattr(message, name, [fill(element(), item) for item in value])
        else:
            setattr(message, name, value)
    return message


class Robot:
    """The commands."""

    def __init__(self, name: str) -> None:
        self.node = rclpy.create_node(name)
        self.received: dict[str, list[tuple[float, Any]]] = {}
        self.publishers: dict[str, Any] = {}
        self.services: dict[str, Any] = {}

    def subscribe(self, kind: str, topic: str, reliable: bool = True, latched: bool = False) -> None:
        """Begin to receive."""
        qos = QoSProfile(depth=1000)
        qos.reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        qos.durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        kept: list[tuple[float, Any]] = []
        self.received[topic] = kept
        self.node.create_subscription(find(kind), topic, lambda m: kept.append((time.time(), m)), qos)

    def take(self, topic: str, count: int = 1, seconds: float = 20.0) -> list[Any]:
        """Return at least `count` messages, or those within a time, with the time of their arrival."""
        end = time.monotonic() + seconds
        kept = self.received[topic]
        while len(kept) < count and time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.05)
        taken = [{**plain(message), "arrived": arrived} for arrived, message in kept]
        kept.clear()
        return taken

    def publish(self, kind: str, topic: str, fields: Any, matched: int = 1, latched: bool = False) -> None:
        """Publish one message, after there are subscribers."""
        if topic not in self.publishers:
            durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
            self.publishers[topic] = self.node.create_publisher(
                find(kind), topic, QoSProfile(depth=100, durability=durability)
            )
        publisher = self.publishers[topic]
        while publisher.get_subscription_count() < matched:
            rclpy.spin_once(self.node, timeout_sec=0.02)
        publisher.publish(fill(find(kind)(), fields))

    def call(self, kind: str, name: str, fields: Any, seconds: float = 40.0) -> Any:
        """Call a service; None without an answer within a time."""
        service = self.services.setdefault(name, self.node.create_client(find(kind), name))
        if not service.wait_for_service(seconds):
            raise TimeoutError(name)
        future = service.call_async(fill(find(kind).Request(), fields))
        rclpy.spin_until_future_complete(self.node, future, timeout_sec=seconds)
        return plain(future.result()) if future.done() else None

    def topics(self) -> dict[str, list[str]]:
        """Return all topics with their types."""
        rclpy.spin_once(self.node, timeout_sec=0.05)
        return dict(self.node.get_topic_names_and_types())


def main() -> None:
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # those of rclpy end it with a segmentation fault
    robot = Robot("robot")
    server = socket.socket(socket.AF_UNIX)
    server.bind(sys.argv[1] + ".new")
    server.listen()
    os.rename(sys.argv[1] + ".new", sys.argv[1])
    with server.accept()[0].makefile("rw") as lines:
        for line in lines:
            name, arguments = json.loads(line)
            try:
                answer = getattr(robot, name)(**arguments)
            except Exception as problem:
                answer = {"error": repr(problem)}
            lines.write(json.dumps(answer) + "\n")
            lines.flush()


if __name__ == "__main__":
    main()
