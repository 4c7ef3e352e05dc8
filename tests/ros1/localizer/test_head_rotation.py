"""The rotation of the head by tf: interpolation, waiting, dropped frames, tilt, limits; and the node in a scene."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import rospy
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

from rosafe.localization import angles, rotations
from rosafe.localization.live import MAX_WAIT, OK, WARN, TransformedHead
from rosafe.localization.rotations import RotationBuffer
from rosafe.ros1.localizer.settings import node_status
from tests.harness import Graph, wait_for
from tests.ros1.localizer.room import Room
from tests.ros1.localizer.session import running_localizer

START = 1000.0  # s


def transform(
    parent: str, child: str, time: float, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0
) -> TransformStamped:
    """Return a transform with angles in degrees."""
    found = TransformStamped(child_frame_id=child)
    found.header.frame_id, found.header.stamp = parent, rospy.Time.from_sec(time)
    (cy, sy), (cp, sp), (cr, sr) = (
        (math.cos(math.radians(angle) / 2), math.sin(math.radians(angle) / 2)) for angle in (yaw, pitch, roll)
    )
    rotation = found.transform.rotation
    rotation.w, rotation.x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    rotation.y, rotation.z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    return found


class Head:
    """A head that is followed, without subscriptions."""

    def __init__(self, delay: float = 0.0) -> None:
        self.status = node_status(lambda: None)
        self.transforms = RotationBuffer("world", "head", lambda line, kind: None)
        self.head = TransformedHead(self.transforms, "world", "head", delay, self.status)

    def tf(self, *found: TransformStamped, static: bool = False) -> None:
        """Receive a message."""
        self.transforms.add_message(TFMessage(list(found)), static, rospy.Time.to_sec)

    def turn(self, seconds: float, speed: float, begin: float = START) -> None:
        """Receive transforms of a head that turns, 20 in each second."""
        for time in np.arange(0, seconds + 0.01, 0.05):
            self.tf(transform("world", "head", begin + time, float(angles.wrap(speed * time))))

    @property
    def dropped(self) -> int:
        """The number of dropped frames in the diagnostics."""
        return int(self.status._values.get("frames without a transform", 0))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time of `time.monotonic` in the module, which the test sets."""
    now = [50.0]
    monkeypatch.setattr("rosafe.localization.live.time.monotonic", lambda: now[0])
    return now


def test_the_rotation_is_that_of_the_time_of_each_frame() -> None:
    head = Head()
    head.turn(2.0, 100.0)
    times = START + np.arange(0.003, 1.99, 0.01)
    yaw, known = head.head.lookup(times)
    assert known.all() and len(yaw) == len(times)
    assert np.allclose(angles.difference(yaw, 100 * (times - START)), 0, atol=0.01)


def test_audio_delay_corrects_the_sound_card() -> None:
    head = Head(delay=0.05)
    head.turn(2.0, 100.0)
    yaw, _ = head.head.lookup(np.array([START + 1.0]))
    assert angles.difference(yaw[0], 95.0) == pytest.approx(0, abs=0.01)  # 50 ms at 100 degrees/s are 5 degrees


def test_frames_wait_for_their_transform(clock: list[float]) -> None:
    head = Head()
    head.turn(1.0, 10.0)
    times = START + np.array([0.9, 0.99, 1.01, 1.02])
    assert len(head.head.lookup(times).yaw) == 2
    clock[0] += 0.9 * MAX_WAIT
    assert not len(head.head.lookup(times[2:]).yaw)
    head.turn(1.0, 10.0, START + 1.0)
    yaw, known = head.head.lookup(times[2:])
    assert len(yaw) == 2 and known.all() and not head.dropped


def test_frames_without_a_transform_are_dropped_and_counted(clock: list[float]) -> None:
    head = Head()
    times = START + np.arange(5) * 0.01
    assert not len(head.head.lookup(times).yaw) and head.status.state()[0] == WARN
    clock[0] += 1.01 * MAX_WAIT
    later = np.append(times, START + 0.05)  # has not waited yet
    yaw, known = head.head.lookup(later)
    assert len(yaw) == 5 and not known.any() and head.dropped == 5
    assert head.status.state() == (WARN, "waiting for the transform from head to world on /tf")
    head.turn(1.0, 10.0)
    assert head.head.lookup(later[5:]).known.all()
    assert head.status.state()[0] == OK
    head.head.lookup(np.array([START + 1.5]))
    clock[0] += 1.01 * MAX_WAIT
    head.head.lookup(np.array([START + 1.5]))
    assert head.status.state() == (WARN, "no transform from head to world on /tf; the frames are dropped")


@pytest.mark.parametrize(("pitch", "roll", "warns"), [(14, 0, False), (16, 0, True), (0, -16, True), (-10, 10, False)])
def test_only_the_vertical_rotation_counts(pitch: float, roll: float, warns: bool) -> None:
    head = Head()
    for time in (START, START + 1):
        head.tf(transform("world", "head", time, 40.0, pitch, roll))
    assert head.head.lookup(np.array([START + 0.5])).yaw[0] == pytest.approx(40.0, abs=0.01)
    level, text = head.status.state()
    assert (level == WARN) == warns and ("tilted" in text) == warns
    for time in (START + 2, START + 3):
        head.tf(transform("world", "head", time, 40.0))
    head.head.lookup(np.array([START + 2.5]))
    assert head.status.state()[0] == OK


def test_time_jumps_back() -> None:
    head = Head()
    head.turn(2.0, 10.0, START + 100)
    assert head.head.lookup(np.array([START + 101.0])).known.all()
    head.turn(2.0, 20.0)  # rosbag play in a loop: 100 s earlier
    head.head.lookup(np.array([START + 0.1]))
    head.turn(2.0, 20.0)
    assert head.head.lookup(np.array([START + 1.0])).yaw[0] == pytest.approx(20.0, abs=0.01)


def test_simulated_time_from_zero() -> None:
    head = Head()
    head.turn(2.0, 20.0, 0.05)
    assert head.head.lookup(np.array([1.05])).yaw[0] == pytest.approx(20.0, abs=0.01)


def test_unsuitable_transforms_are_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rotations, "MAX_FRAMES", 10)
    head = Head()
    head.turn(1.0, 10.0)
    bad = [transform("world", "head", START + 0.5) for _ in range(4)]
    bad[0].transform.rotation.w = 0.0
    bad[1].transform.rotation.z = math.nan
    bad[2].transform.translation.x = math.inf
    bad[3].transform.rotation.x = 1e200
    head.tf(*bad, transform("", "a", START), transform("a", "", START), transform("a", "a", START))
    head.tf(transform("world", "x" * 300, START), transform("", "head", START), transform("x" * 300, "head", START))
    for number in range(20):
        head.tf(transform("world", f"frame{number}", START), transform(f"frame{number}", "moved", START), static=True)
    assert head.head.lookup(np.array([START + 0.5])).yaw[0] == pytest.approx(5.0, abs=0.01)
    head.tf(transform("head", "world", START))  # a loop
    head.head.lookup(np.array([START + 0.2]))
    assert len(head.transforms._frames) <= 10


def test_without_tf_there_are_no_sources(graph: Graph, sphere_model: Path) -> None:
    options = ("--head", str(sphere_model), "--world-frame", "world", "--noise", "none")
    with (
        Room(graph) as room,
        graph.node("rosAFE-ros"),
        running_localizer(graph, *options) as localizer,
        localizer.collect() as sources,
    ):
        room.azimuth = 30.0
        state = localizer.state(lambda entries: int(entries.get("frames without a transform", 0)) > 50)
        assert state["level"] == str(WARN) and "transform" in state["message"]
        count = len(sources)
        wait_for(lambda: len(sources) > count + 5)
        assert not any(message.sources for message in sources)
        assert {message.header.frame_id for message in sources} == {"world"}
