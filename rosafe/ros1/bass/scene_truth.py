"""The truth of a running scene: the topic sceneTruth, and the rotation of the head on /tf."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import rospy

from rosafe.audio.devices.base import wall_time_ns
from rosafe.audio.stream.truth import TruthLoop, TruthSource
from rosafe.ros1.transport.publisher import Publisher

if TYPE_CHECKING:
    from rosafe.localization.scene import Truth  # imports scipy, which the options of bass-ros need not wait for


class TruthPublisher(TruthLoop):
    """Publishes the truth of one scene; a context.

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
        super().__init__(source, self._publish_truth)
        self._publisher = publisher
        self._message_class = message_class
        self._transform = _HeadTransform(*frames)

    def __exit__(self, *_: object) -> None:
        """End, and take the transform back."""
        super().__exit__()
        self._transform.close()

    def _publish_truth(self, frame: int, moment: float, truth: Truth) -> None:
        stamp = rospy.Time(*divmod(wall_time_ns(moment), 1_000_000_000))
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
