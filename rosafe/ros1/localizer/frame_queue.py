"""Frames that wait for the rotation of the head, or for others that make up an update."""

from __future__ import annotations

import time
from typing import NamedTuple

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.ros1.localizer.frame_source import NewFrames
from rosafe.ros1.localizer.head_rotation import HeadRotation
from rosafe.ros1.localizer.mute import Mute


class TurnedFrames(NamedTuple):
    """Frames with the direction of the head (F,) in degrees in world coordinates."""

    frames: NewFrames
    yaw: FloatArray


class FrameQueue:
    """Frames in their order; those without a rotation, and muted ones, are dropped.

    Parameters
    ----------
    rotation : HeadRotation
    mute : Mute

    Attributes
    ----------
    received_at : float
        When frames were added last (time.monotonic).
    """

    def __init__(self, rotation: HeadRotation, mute: Mute) -> None:
        self._rotation = rotation
        self._mute = mute
        self._waiting: list[NewFrames] = []
        self.received_at = 0.0

    @property
    def muted(self) -> bool:
        """Whether the robot speaks."""
        return self._mute.active

    def __len__(self) -> int:
        """The number of frames that wait."""
        return sum(len(frames.middles) for frames in self._waiting)

    def clear(self) -> None:
        """Drop all frames."""
        self._waiting.clear()

    def append(self, frames: NewFrames) -> None:
        """Add frames."""
        self.received_at = time.monotonic()
        self._waiting.append(frames)

    def take(self, least: int) -> TurnedFrames | None:
        """Return all frames whose rotation is known; None if these are none, or if less than `least` frames wait."""
        if len(self) < least:
            return None
        joined = NewFrames.joined(self._waiting)
        yaw, known = self._rotation.lookup(joined.middles)
        ready = len(yaw)
        later = joined.select(slice(ready, None))
        self._waiting = [later] if len(later.middles) else []
        kept = known & ~self._mute.muted(joined.middles[:ready])
        if not self._waiting and kept.all():  # mostly; copies are saved
            return TurnedFrames(joined, yaw) if ready else None
        now = joined.select(slice(ready))
        return TurnedFrames(now.select(kept), yaw[kept]) if kept.any() else None
