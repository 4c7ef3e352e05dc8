"""The topics of the localizer: sources, poses, markers and the posterior with one stamp, and streams of sources."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import rospy

from rosafe.localization.live_streams import LiveStreams
from rosafe.localization.speech import SPEAKS
from rosafe.localization.streams import RATE, SourcePart
from rosafe.localization.tracker import FORGOTTEN, PRESENT, Track
from rosafe.ros1.transport.publisher import NewestMessage, Publisher

MAX_PARTS = 200  # of streams for a slow subscriber: at least a second; older ones are dropped
MARKER_SIZE = 0.2  # m


class Publishers:
    """Publishes sources, poses, markers, the posterior, and the sound of each source.

    Parameters
    ----------
    frame_id : str
        Coordinate frame of all azimuths.
    speech_only : bool
        Whether only sources that speak have poses.

    Attributes
    ----------
    streams : LiveStreams
        Provides the probability that a source speaks.
    """

    streams: LiveStreams

    def __init__(self, frame_id: str, speech_only: bool = False) -> None:
        from geometry_msgs.msg import Pose, PoseArray
        from rosAFE.msg import DirectionPosterior, SoundSource, SoundSources, SourceAudio
        from std_msgs.msg import Header
        from visualization_msgs.msg import MarkerArray

        self._frame_id = frame_id
        self._first_id = self._last_id = 0
        self._header_class, self._pose_class, self._source_class = Header, Pose, SoundSource
        self._sources = Publisher("~sources", SoundSources)
        self._poses = Publisher("~poses", PoseArray)
        self._markers = Publisher("~markers", MarkerArray)
        self._posterior = Publisher("~posterior", DirectionPosterior)
        self._streams = rospy.Publisher("~streams", SourceAudio, queue_size=MAX_PARTS, tcp_nodelay=True)
        self._speech_only = speech_only

    def begin_again(self) -> None:
        """Prepare for tracks that are numbered from 1 again: published ids continue."""
        self._first_id = self._last_id
        self.streams.begin_again(self._first_id)

    def has_stream_subscribers(self) -> bool:
        """Return whether the sound of sources is used."""
        return bool(self._streams.get_num_connections())

    def has_speech_subscribers(self) -> bool:
        """Return whether the probability that a source speaks is used."""
        topics = [self._sources, self._markers, *([self._poses] if self._speech_only else [])]
        return any(topic.has_subscribers for topic in topics)

    def publish_part(self, part: SourcePart, time: float) -> None:
        """Publish the next samples of a source, of which the first is that of a clock time (s)."""
        if self.has_stream_subscribers():
            message = self._streams.data_class(
                self._header_class(stamp=ros_time(time), frame_id=self._frame_id),
                part.id,
                math.radians(part.azimuth),
                RATE,
                part.first_sample,
                part.samples,
            )
            self._streams.publish(message)

    def publish(self, time: float, tracks: Sequence[Track], gain_db: float, estimate: tuple[Any, Any]) -> None:
        """Publish the state at a clock time (s).

        Parameters
        ----------
        time : float
            The end of the newest frame that was used.
        tracks : sequence of Track
            All sources; improbable ones are left out.
        gain_db : float
            From the power of a track to its level.
        estimate : tuple of ndarray
            The grid in degrees and the posterior.
        """
        stamp = ros_time(time)
        named = [track for track in tracks if track.id and track.probability >= FORGOTTEN]
        self._last_id = max([self._last_id, *(self._first_id + track.id for track in named)])
        sources = [self._source(track, gain_db) for track in named]
        present = [
            (source.id, track.azimuth, source.speech > SPEAKS)
            for source, track in zip(sources, named, strict=True)
            if track.probability > PRESENT
        ]
        posed = [azimuth for _, azimuth, speaks in present if speaks or not self._speech_only]
        self._publish(self._sources, stamp, lambda: (sources,))
        self._publish(self._poses, stamp, lambda: ([self._pose(azimuth) for azimuth in posed],))
        header = self._header_class(stamp=stamp, frame_id=self._frame_id)
        markers = self._markers.data_class
        self._markers.publish_newest(NewestMessage(lambda: markers(source_markers(header, present))))
        self._publish(self._posterior, stamp, lambda: (np.radians(estimate[0]), estimate[1]))

    def _publish(self, topic: Publisher, stamp: rospy.Time, members: Callable[[], tuple[Any, ...]]) -> None:
        """Publish a message with a header and `members`, which are computed only for subscribers."""

        def build() -> Any:
            return topic.data_class(self._header_class(stamp=stamp, frame_id=self._frame_id), *members())

        topic.publish_newest(NewestMessage(build))

    def _source(self, track: Track, gain_db: float) -> Any:
        return self._source_class(
            id=self._first_id + track.id,
            azimuth=math.radians(track.azimuth),
            azimuth_std=math.radians(track.azimuth_std),
            probability=track.probability,
            level=track.level_db(gain_db),
            first_seen=ros_time(track.first_time),
            last_seen=ros_time(track.last_time),
            speech=self.streams.speech(self._first_id + track.id),
        )

    def _pose(self, azimuth: float) -> Any:
        pose = self._pose_class()
        half = math.radians(azimuth) / 2
        pose.orientation.z, pose.orientation.w = math.sin(half), math.cos(half)
        return pose


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
