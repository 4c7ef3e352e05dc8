"""The truth of a running scene: the topic sceneTruth, and the rotation of the head on /tf."""

from __future__ import annotations

import math
import threading
import time
from typing import TYPE_CHECKING, Any, Protocol

import rospy

from rosafe.audio.devices.base import wall_time_ns
from rosafe.ros1.transport.publisher import Publisher

if TYPE_CHECKING:
    from rosafe.localization.scene import Truth  # imports scipy, which the options of bass-ros need not wait for

PERIOD = 0.05  # s of the scene between two messages
_START_POLL = 0.005  # s, until the source has started


class TruthSource(Protocol):
    """A source of sound whose true directions are known."""

    sample_rate: int
    frames: int | None  # length; None without an end

    @property
    def started(self) -> float | None:
        """When the first frame was due, on the clock of time.monotonic."""

    def truth(self, time: float) -> Truth:
        """Return the directions at a time in s from the first frame."""


class TruthPublisher:
    """Publishes the truth of one scene every 50 ms, on a thread of its own, from `start` to `stop`.

    Parameters
    ----------
    source : TruthSource
        The scene.
    publisher : Publisher
        Of the topic sceneTruth.
    message_class : type
        `bass.msg.SceneTruth`.
    frames : tuple of two str
        Names of the world's and of the head's coordinate frame in tf.
    """

    def __init__(self, source: TruthSource, publisher: Any, message_class: Any, frames: tuple[str, ...]) -> None:
        self._source = source
        self._publisher = publisher
        self._message_class = message_class
        self._transform = _HeadTransform(*frames)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="scene truth", daemon=True)

    def __enter__(self) -> None:
        """Begin to publish; the first message follows the first frame of the source."""
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        """End, and take the transform back."""
        self._stopping.set()
        self._thread.join()
        self._transform.close()

    def _run(self) -> None:
        while (started := self._source.started) is None:
            if self._stopping.wait(_START_POLL):
                return
        rate, number = self._source.sample_rate, 0
        while True:
            frame = round(number * PERIOD * rate)
            if self._source.frames is not None and frame >= self._source.frames:
                return
            moment = started + frame / rate
            if self._stopping.wait(max(0.0, moment - time.monotonic())):
                return
            self._publish(frame, wall_time_ns(moment), self._source.truth(frame / rate))
            # After a delay the thread continues with the present; it does not publish old states.
            number = max(number + 1, math.floor((time.monotonic() - started) / PERIOD))

    def _publish(self, frame: int, time_ns: int, truth: Truth) -> None:
        stamp = rospy.Time(*divmod(time_ns, 1_000_000_000))
        yaw = math.radians(truth.head_yaw)
        azimuths = [math.radians(azimuth) for azimuth in truth.azimuths]
        self._publisher.publish(
            self._message_class(stamp=stamp, frameIndex=frame, head_yaw=yaw, names=list(truth.names), azimuths=azimuths)
        )
        self._transform.publish(stamp, yaw)


class _HeadTransform:
    """The transform from world to head on /tf; nothing if the messages of tf2 are not installed."""

    def __init__(self, world: str, head: str) -> None:
        try:
            from geometry_msgs.msg import TransformStamped
            from tf2_msgs.msg import TFMessage
        except ImportError:
            rospy.logwarn("the rotation of the head is not published on /tf: tf2_msgs is missing; run scripts/install")
            self._publisher = None
            return
        self._publisher = Publisher("/tf", TFMessage)
        self._message_class = TFMessage
        self._transform = TransformStamped(child_frame_id=head)
        self._transform.header.frame_id = world

    def publish(self, stamp: rospy.Time, yaw: float) -> None:
        """Publish a rotation about the z axis (rad)."""
        if self._publisher is not None:
            self._transform.header.stamp = stamp
            rotation = self._transform.transform.rotation
            rotation.z, rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
            self._publisher.publish(self._message_class([self._transform]))

    def close(self) -> None:
        """Unregister."""
        if self._publisher is not None:
            self._publisher.unregister()
