"""The device `topic:`: sound of another driver, in `audio_common_msgs`."""

from __future__ import annotations

import threading
import time
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from rosafe.audio.devices import SoundSource, open_source
from rosafe.audio.devices.base import device_error
from rosafe.audio.devices.received import DESCRIPTION_SECONDS, FIRST_SECONDS, ReceivedSource
from rosafe.ros2.messages import clock_offset

PREFIX = "topic:"
INFO = "audio_info"  # the topic beside that of the sound that describes its format
PLAIN, STAMPED = "audio_common_msgs/msg/AudioData", "audio_common_msgs/msg/AudioDataStamped"
QUEUE = 1000  # messages
NOT_NUMBERED = 2**64 - 1


class TopicSource(ReceivedSource):
    """Two channels of the sound on a topic: see `ReceivedSource`."""

    def __init__(self, node: Node, text: str, sample_rate: int, chunk: int, stopping: threading.Event) -> None:
        super().__init__(text, sample_rate, chunk, stopping)
        try:
            from audio_common_msgs.msg import AudioData, AudioDataStamped, AudioInfo
        except ImportError:
            raise device_error(
                f"{self.name}: expected the package audio_common_msgs, got none; "
                "run apt install ros-$ROS_DISTRO-audio-common-msgs"
            ) from None
        self._node = node
        group = MutuallyExclusiveCallbackGroup()  # in their order, and also while a service waits for them
        publishers = self._find_publishers(stopping)
        stamped = any(one.topic_type == STAMPED for one in publishers)
        reliable = all(one.qos_profile.reliability == ReliabilityPolicy.RELIABLE for one in publishers)
        policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        qos = QoSProfile(depth=QUEUE, reliability=policy)
        namespace = self.topic.rpartition("/")[0]
        self._subscriptions = [
            node.create_subscription(
                AudioDataStamped if stamped else AudioData,
                self.topic,
                self._receive_stamped if stamped else self._receive_plain,
                qos,
                callback_group=group,
            )
        ]
        if self.needs_description:
            info = f"{namespace}/{INFO}" if namespace or self.topic.startswith("/") else INFO
            self._subscriptions.append(
                node.create_subscription(AudioInfo, info, self._describe, QoSProfile(depth=1), callback_group=group)
            )
        try:
            self.begin("", DESCRIPTION_SECONDS if self.needs_description else FIRST_SECONDS)
        except BaseException:
            self.close()
            raise

    def _find_publishers(self, stopping: threading.Event) -> list[TopicEndpointInfo]:
        """Return the publishers, whose type and reliability matter; the node discovers them after some time."""
        topic, end = self._node.resolve_topic_name(self.topic), time.monotonic() + FIRST_SECONDS
        while not (found := self._node.get_publishers_info_by_topic(topic)):
            if time.monotonic() > end or stopping.wait(0.05):
                self.begin("the topic has no publisher", 0.0)
        used = [one for one in found if one.topic_type in (PLAIN, STAMPED)]
        if not used:
            self.begin(f"messages of type {found[0].topic_type} are not used", 0.0)
        return used

    def _describe(self, info: Any) -> None:
        self.describe(info.channels, info.sample_rate, info.sample_format, info.coding_format)

    def _receive_plain(self, message: Any, info: Any) -> None:
        self.receive(message.data, 0, _number(info))

    def _receive_stamped(self, message: Any, info: Any) -> None:
        stamp = message.header.stamp
        time_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        if time_ns:  # 0 is unknown
            time_ns -= round(1e9 * clock_offset(self._node))
        self.receive(message.audio.data, time_ns, _number(info))

    def close(self) -> None:
        """Unsubscribe."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []


def _number(info: Any) -> int | None:
    """Return the number that the publisher has given to a message, if the middleware has it."""
    number = int(info.get("publication_sequence_number", NOT_NUMBERED))
    return None if number == NOT_NUMBERED else number


def open_device(node: Node, device: str, rate: int, chunk: int, stopping: threading.Event) -> SoundSource:
    """Open a device: see `rosafe.audio.devices.open_source`."""
    if device.startswith(PREFIX):
        return TopicSource(node, device.removeprefix(PREFIX), rate, chunk, stopping)
    return open_source(device, rate, chunk, stopping)
