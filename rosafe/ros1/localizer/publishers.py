"""The topics of the localizer: sources, poses, markers and the posterior with one stamp, and streams of sources."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import rospy

from rosafe.localization.live_node import MAX_PARTS, MessageClasses, SourceTopics
from rosafe.localization.tracker import Track
from rosafe.ros1.transport.publisher import NewestMessage, Publisher

MARKER_SIZE = 0.2  # m


class Publishers(SourceTopics):
    """Publishes sources, poses, markers, the posterior, and the sound of each source: see `SourceTopics`."""

    def __init__(self, frame_id: str, speech_only: bool) -> None:
        from geometry_msgs.msg import Pose, PoseArray
        from rosAFE.msg import DirectionPosterior, SoundSource, SoundSources, SourceAudio
        from std_msgs.msg import Header
        from visualization_msgs.msg import MarkerArray

        super().__init__(MessageClasses(Header, Pose, SoundSource, ros_time), frame_id, speech_only)
        topics = {"sources": SoundSources, "poses": PoseArray, "markers": MarkerArray, "posterior": DirectionPosterior}
        self._newest = {name: Publisher(f"~{name}", message) for name, message in topics.items()}
        self._streams = rospy.Publisher("~streams", SourceAudio, queue_size=MAX_PARTS, tcp_nodelay=True)

    def has_subscribers(self, topic: str) -> bool:
        """See `SourceTopics`."""
        newest = self._newest.get(topic)
        return newest.has_subscribers if newest is not None else self._streams.get_num_connections() > 0

    def has_speech_subscribers(self) -> bool:
        """See `SourceTopics`; markers show whether a source speaks."""
        return super().has_speech_subscribers() or self.has_subscribers("markers")

    def send(self, topic: str, fields: Callable[[], Mapping[str, Any]]) -> None:
        """See `SourceTopics`."""
        newest = self._newest.get(topic)
        if newest is None:
            self._streams.publish(self._streams.data_class(**fields()))
        else:
            message_class = newest.data_class
            newest.publish_newest(NewestMessage(lambda: message_class(**fields())))

    def publish(self, time: float, tracks: Sequence[Track], gain_db: float, estimate: tuple[Any, Any]) -> None:
        """Publish the state at a clock time (s): see `SourceTopics`."""
        super().publish(time, tracks, gain_db, estimate)
        present = self.present(tracks)
        self.send("markers", lambda: {"markers": source_markers(self.header(time), present)})


def source_markers(header: Any, present: Sequence[tuple[int, float, bool]]) -> list[Any]:
    """Return the markers for rviz of sources (id, azimuth in degrees, whether it speaks), at a distance of 1 m.

    A source that speaks is a sphere, another one a ring.
    """
    from geometry_msgs.msg import Point, Quaternion, Vector3
    from std_msgs.msg import ColorRGBA
    from visualization_msgs.msg import Marker

    markers = [Marker(header=header, action=Marker.DELETEALL)]
    for id_, azimuth, speaks in present:
        x, y = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
        marker = Marker(
            header=header, ns="sources", id=id_ % 2**31, type=Marker.SPHERE if speaks else Marker.LINE_STRIP
        )
        marker.pose.orientation = Quaternion(w=1.0)
        marker.color = ColorRGBA(0.1, 0.6, 1.0, 1.0)
        if speaks:
            marker.pose.position = Point(x, y, 0.0)
            marker.scale = Vector3(MARKER_SIZE, MARKER_SIZE, MARKER_SIZE)
        else:
            marker.scale.x = MARKER_SIZE / 10  # of the line
            turns = np.linspace(0, 2 * math.pi, 25)
            circle = MARKER_SIZE / 2 * np.stack((np.cos(turns), np.sin(turns)), axis=1)
            marker.points = [Point(x - y * side, y + x * side, up) for side, up in circle]
        markers.append(marker)
    return markers


def ros_time(seconds: float) -> rospy.Time:
    """Return a time in s as a time of ROS."""
    return rospy.Time.from_sec(max(0.0, seconds))
