"""The three topics of the localizer, with one stamp."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import rospy

from rosafe.localization.tracker import FORGOTTEN, PRESENT, Track
from rosafe.ros1.transport.publisher import NewestMessage, Publisher


class Publishers:
    """Publishes sources, poses and the posterior.

    Parameters
    ----------
    frame_id : str
        Coordinate frame of all azimuths.
    """

    def __init__(self, frame_id: str) -> None:
        from geometry_msgs.msg import Pose, PoseArray
        from rosAFE.msg import DirectionPosterior, SoundSource, SoundSources
        from std_msgs.msg import Header

        self._frame_id = frame_id
        self._first_id = self._last_id = 0
        self._header_class, self._pose_class, self._source_class = Header, Pose, SoundSource
        self._sources = Publisher("~sources", SoundSources)
        self._poses = Publisher("~poses", PoseArray)
        self._posterior = Publisher("~posterior", DirectionPosterior)

    def begin_again(self) -> None:
        """Prepare for tracks that are numbered from 1 again: published ids continue."""
        self._first_id = self._last_id

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
        present = [track.azimuth for track in named if track.probability > PRESENT]
        self._publish(self._sources, stamp, lambda: (sources,))
        self._publish(self._poses, stamp, lambda: ([self._pose(azimuth) for azimuth in present],))
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
        )

    def _pose(self, azimuth: float) -> Any:
        pose = self._pose_class()
        half = math.radians(azimuth) / 2
        pose.orientation.z, pose.orientation.w = math.sin(half), math.cos(half)
        return pose


def ros_time(seconds: float) -> rospy.Time:
    """Return a time in s as a time of ROS."""
    return rospy.Time.from_sec(max(0.0, seconds))
