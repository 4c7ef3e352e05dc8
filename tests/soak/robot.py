"""The rest of a robot in the soak: a second bass and rosAFE with localizer and live page, and the ROS 2 node."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from contextlib import ExitStack
from typing import Any

import numpy as np
import soundfile

from rosafe.localization.head import Head
from tests import models
from tests.harness import PYTHON, Graph, Process, freeze, wait_for
from tests.localization.conftest import RATE, modulated
from tests.ros1.afe.session import diagnosed
from tests.ros1.localizer.session import running_localizer, scene_file
from tests.ros2.client import Client
from tests.ros2.network import Network, network, variables
from tests.web.live.world import live, page

AZIMUTH = 40.0  # degrees, of the talker that both localizers track
LISTENER = """
import rospy
from rosAFE.msg import SourceAudio
rospy.init_node("listener", anonymous=True)
rospy.Subscriber("/robot_localizer/streams", SourceAudio, lambda part: print(part.id, flush=True))
rospy.spin()
"""
SCENE = """
sample_rate: {rate}
sources:
  - {{name: talker, file: {file}, loop: true, level_db: -25, azimuth: {azimuth}}}
"""
MESSAGES = 20  # for one subscriber: two seconds


class Robot:
    """A talker at a fixed direction, and everything that tracks or shows it."""

    def __init__(self, graph: Graph, stack: ExitStack) -> None:
        self._graph = graph
        file = graph.home / "talker.wav"
        soundfile.write(file, modulated(10.0, 5, RATE) / 10, RATE, subtype="PCM_32")
        device = scene_file(graph.home, SCENE.format(rate=RATE, file=file, azimuth=AZIMUTH))
        ears, afe = (
            stack.enter_context(graph.node(f"{name}-ros", "-i", f"robot_{name}")) for name in ("bass", "rosAFE")
        )
        answer = graph.call("/robot_bass/Acquire", device=device, nFramesPerChunk=RATE // 20, nChunksOnPort=60)
        assert answer.genom_success, answer.genom_exdetail
        model = graph.home / "sphere.head"
        models.learn_in(graph.home, RATE, None, Head.sphere()).save(model)
        options = ("--rosafe", "robot_rosAFE", "--connect", "robot_bass/Audio", "--head", str(model))
        self._localizer = stack.enter_context(running_localizer(graph, *options, name="robot_localizer"))
        self._live = stack.enter_context(live(graph, "-i", "robot_rosAFE", "--bass", "robot_bass"))
        self.processes = {
            "robot's bass": ears,
            "robot's rosAFE": afe,
            "localizer": self._localizer.process,
            "live": self._live.process,
        }
        self._ros2: Network | None = None
        environment = variables()
        if isinstance(environment, str):
            print(f"soak: without ROS 2: {environment}", flush=True)
        else:
            self._ros2 = stack.enter_context(network(environment, graph.home))
            node = self.processes["ROS 2 node"] = self._ros2.node(
                f"device:={device}", "localize:=true", f"head:={model}"
            )
            wait_for(lambda: "acquiring" in node.err or not node.alive, what=lambda: f"the sound of {node}")
        self._lost = self.lost()  # while the nodes connect

    def lost(self) -> int:
        """Return the number of frames that rosAFE has lost."""
        return int(diagnosed(self._graph, "robot_rosAFE: audio", lambda _: True)["lost"])

    def check(self) -> None:
        """Check that no frame was lost since the start."""
        lost = self.lost() - self._lost
        assert lost == 0, f"robot_rosAFE has lost {lost} frames"

    def visit(self, chance: random.Random) -> None:
        """Let subscribers come: each finds the talker and leaves, by itself, killed, or killed while it is stopped."""
        self._localizer.wait_present(AZIMUTH)
        with self._graph.start(PYTHON, "-c", LISTENER) as listener:
            wait_for(lambda: len(listener.out.splitlines()) >= MESSAGES, what=lambda: f"streams in {listener}")
            _end(listener, chance)
        views = [{"what": "levels"}, {"what": "picture", "name": "ild_0"}]
        asyncio.run(self._open_page(views))
        if self._ros2 is not None:
            self._subscribe_in_ros2(self._ros2, chance)

    async def _open_page(self, views: list[dict[str, Any]]) -> None:
        async with page(self._live) as client:
            await client.subscribe(*views)
            while client.messages < MESSAGES:
                await client.receive()

    def _subscribe_in_ros2(self, ros2: Network, chance: random.Random) -> None:
        client = Client(ros2, self._graph.home)
        client.subscribe("sources", "rosafe_msgs/msg/SoundSources")
        found = client.take("sources", MESSAGES)
        azimuths = [np.degrees(s["azimuth"]) for m in found for s in m["sources"] if s["probability"] > 0.5]
        assert azimuths and abs(np.median(azimuths) - AZIMUTH) < 10, found[-1]
        _end(client.process, chance)


def _end(process: Process, chance: random.Random) -> None:
    """End a subscriber in one of three ways."""
    if chance.random() < 0.5:
        process.stop(signal.SIGINT)
        return
    if chance.random() < 0.5:
        freeze(process.pid)
    os.kill(process.pid, signal.SIGKILL)
