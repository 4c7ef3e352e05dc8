"""roslaunch with launch/rosafe.launch: all nodes start, and the localizer finds the talker of a scene."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from tests.harness import Graph, free_port, wait_for
from tests.ros1.localizer.conftest import RATE
from tests.ros1.localizer.session import watched, watcher

SCENE = "sample_rate: {rate}\nsources:\n  - {{name: talker, file: {file}, loop: true, azimuth: -50}}\n"
SETUP = """
sound: {{device: "scene:{scene}", sampleRate: 0}}
processors:
  input: {{kind: input, nFramesPerBlock: 800}}
"""


@pytest.mark.exploration
@pytest.mark.parametrize("namespace", ["/", "/robot/"])
def test_roslaunch_localizes(tmp_path: Path, talker: Path, sphere_model: Path, namespace: str) -> None:
    graph = Graph(f"http://127.0.0.1:{free_port()}", tmp_path)
    scene, setup = tmp_path / "scene.yaml", tmp_path / "tree.yaml"
    scene.write_text(SCENE.format(rate=RATE, file=talker))
    setup.write_text(SETUP.format(scene=scene))
    arguments = (f"setup:={setup}", "localize:=true", f"head:={sphere_model}", f"port:={free_port()}")
    with graph.start("roslaunch", "rosAFE", "rosafe.launch", *arguments, ROS_NAMESPACE=namespace) as launch:
        wait_for(lambda: "localizing with" in launch.out + launch.err, what=lambda: f"the localizer: {launch}")
        with watcher(graph, namespace) as seen:
            wait_for(
                lambda: any(abs(azimuth + 50) < 10 for line in watched(seen) for azimuth in line[1:]),
                what=lambda: seen.out,
            )
        nodes = {f"{namespace}{name}" for name in ("bass", "rosAFE", "genomixd", "localizer")}
        assert nodes <= graph.nodes()
        assert launch.stop(signal.SIGINT) == 0
    assert "Traceback" not in launch.out + launch.err, launch
