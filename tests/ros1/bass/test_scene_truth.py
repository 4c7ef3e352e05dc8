"""The truth of a running scene: the topic sceneTruth and the rotation of the head on /tf."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest
import rospy

from tests.harness import Graph, Process, wait_for

SCENE = """
sample_rate: 8000
duration: 1
head_yaw: [[0, 0], [1, 40]]
sources:
  - {name: left, signal: noise, azimuth: 90, end: 0.5}
  - {name: right, signal: tone, azimuth: [[0, 0], [1, -30]]}
"""


def test_truth_of_a_scene_file(graph: Graph, bass_node: Process, tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    message_class = importlib.import_module("bass.msg").SceneTruth
    transform_class = importlib.import_module("tf2_msgs.msg").TFMessage
    with (
        graph.collect("/bass/sceneTruth", message_class) as truths,
        graph.collect("/tf", transform_class) as transforms,
    ):
        response = graph.call(
            "/bass/Acquire", device=f"scene:{path}", sampleRate=0, nFramesPerChunk=3000, nChunksOnPort=2
        )
        assert response.genom_success
        wait_for(lambda: truths and truths[-1].frameIndex >= 7200, what="the truth near the end of the scene")
    frames = [truth.frameIndex for truth in truths]
    assert frames == sorted(set(frames)) and len(frames) >= 10
    assert all(frame % 400 == 0 and frame < 8000 for frame in frames)  # every 50 ms, whatever the chunks are
    for truth in truths:
        seconds = truth.frameIndex / 8000
        assert truth.names == (["left", "right"] if seconds < 0.5 else ["right"])
        assert abs(np.degrees(truth.head_yaw) - 40 * seconds) < 1e-6
        assert abs(np.degrees(truth.azimuths[-1]) - (-30 * seconds - 40 * seconds)) < 1e-6
    stamps = np.array([truth.stamp.to_sec() for truth in truths])
    assert np.allclose(np.diff(stamps), np.diff(frames) / 8000, atol=5e-3)
    transform = transforms[-1].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("world", "head")
    rotation = transform.transform.rotation
    assert 0.1 < np.degrees(2 * np.arctan2(rotation.z, rotation.w)) <= 40


@pytest.mark.parametrize(
    ("names", "expected"),
    [(("/map", "/robot/head"), ("map", "robot/head")), (("/", "head"), ("world", "head"))],
)
def test_names_of_coordinate_frames(
    graph: Graph, bass_node: Process, names: tuple[str, str], expected: tuple[str, str]
) -> None:
    """In tf2 they have no leading slash."""
    graph.client()
    transform_class = importlib.import_module("tf2_msgs.msg").TFMessage
    parameters = dict(zip(("/bass/world_frame", "/bass/head_frame"), names, strict=True))
    for parameter, name in parameters.items():
        rospy.set_param(parameter, name)
    try:
        with graph.collect("/tf", transform_class) as transforms:
            graph.call("/bass/Acquire", device="scene:", sampleRate=8000, nFramesPerChunk=400, nChunksOnPort=4)
            wait_for(lambda: transforms)
            graph.call("/bass/Stop")
    finally:
        for parameter in parameters:
            rospy.delete_param(parameter)
    transform = transforms[-1].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == expected


def test_equal_names_of_coordinate_frames_are_an_error(graph: Graph, bass_node: Process) -> None:
    """A transform from a coordinate frame to itself is not valid. The running acquisition continues."""
    graph.client()
    graph.call("/bass/Acquire", device="scene:", sampleRate=8000, nFramesPerChunk=400, nChunksOnPort=4)
    rospy.set_param("/bass/world_frame", "/head")
    try:
        answer = graph.call("/bass/Acquire", device="scene:", sampleRate=8000, nFramesPerChunk=800, nChunksOnPort=4)
    finally:
        rospy.delete_param("/bass/world_frame")
    assert not answer.genom_success
    assert "world_frame: expected another frame than head_frame, got 'head'" in answer.genom_exdetail
    assert graph.call("/bass/getAcquisition").nFramesPerChunk == 400
    graph.call("/bass/Stop")
