"""Frames that wait, that are dropped, and that are muted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization.live import AFTER_SECONDS, FixedHead, FrameQueue, Mute, NewFrames, Rotation
from rosafe.ros1.localizer.settings import node_status


def frames(*middles: float) -> NewFrames:
    """Return frames whose only cue is their time."""
    times = np.array(middles)
    return NewFrames({"itd": times[np.newaxis]}, times, 0)


def mute(begin: float, end: float) -> Mute:
    """Return the mute of a robot that speaks between two times."""

    def muted(times: FloatArray) -> Any:
        return (times >= begin) & (times <= end)

    return cast(Mute, SimpleNamespace(muted=muted, active=False))


def test_muted_frames_are_not_used() -> None:
    queue = FrameQueue(FixedHead(), mute(2.0, 3.0))
    queue.append(frames(1.0, 2.0, 2.5))
    queue.append(frames(3.0, 3.5, 4.0))
    used = queue.take(1)
    assert used is not None
    assert used.frames.middles.tolist() == used.frames.features["itd"][0].tolist() == [1.0, 3.5, 4.0]
    assert used.yaw.tolist() == [0.0, 0.0, 0.0]
    queue.append(frames(2.2))
    assert queue.take(1) is None and queue.take(1) is None


def test_frames_wait_for_others_and_for_their_rotation() -> None:
    known = 2.5  # s, of the newest transform

    class Head(FixedHead):
        def lookup(self, times: FloatArray) -> Rotation:
            ready = times[times <= known]
            return Rotation(10 * ready, ready != 2.0)

    queue = FrameQueue(Head(), mute(9.0, 9.0))
    queue.append(frames(1.0, 2.0))
    assert queue.take(3) is None
    queue.append(frames(2.5, 3.0))
    used = queue.take(3)
    assert used is not None and (used.frames.middles.tolist(), used.yaw.tolist()) == ([1.0, 2.5], [10.0, 25.0])
    assert queue.take(1) is None
    known = 3.0
    used = queue.take(1)
    assert used is not None and used.frames.middles.tolist() == [3.0]


@pytest.fixture
def clock() -> list[float]:
    """The clock time, which the test sets."""
    return [100.0]


def is_muted(mute: Mute, time: float) -> bool:
    """Return whether sources are hidden, or a frame at `time` is not used."""
    return mute.active or bool(mute.muted(np.array([time])).any())


def test_a_mute_lasts_a_little_longer_and_delays_count(clock: list[float]) -> None:
    mute = Mute(0.25, node_status(lambda: None), lambda: clock[0])
    mute.set(True)
    clock[0] = 105.0
    mute.set(False)
    end = 105.25 + AFTER_SECONDS
    assert mute.muted(np.array([100.2, 100.3, end - 0.05, end + 0.05])).tolist() == [False, True, True, False]


def test_a_mute_has_ended_if_the_time_jumps_back(clock: list[float]) -> None:
    mute = Mute(0.0, node_status(lambda: None), lambda: clock[0])
    mute.set(True)
    clock[0] = 105.0
    mute.set(False)
    assert is_muted(mute, 102.0)
    clock[0] = 1.0  # rosbag play in a loop
    assert not is_muted(mute, 0.9) and not is_muted(mute, 102.0)


def test_a_mute_continues_if_the_time_jumps_back(clock: list[float]) -> None:
    status = node_status(lambda: None)
    mute = Mute(0.0, status, lambda: clock[0])
    mute.set(True)
    clock[0] = 1.0
    assert is_muted(mute, 1.0) and is_muted(mute, 2.0)
    clock[0] = 0.0  # and at once again, before anything has asked
    mute.set(False)
    clock[0] = 0.5
    assert not is_muted(mute, 0.5) and status._values["muted"] == "no" and "muted" not in status.state()[1]
