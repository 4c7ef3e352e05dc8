"""Steady noise and ~mute, with real nodes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rospy
import soundfile
from diagnostic_msgs.msg import DiagnosticArray
from rosAFE.msg import SoundSources
from std_msgs.msg import Bool

from rosafe.localization import angles
from tests.harness import Graph, Process, wait_for
from tests.localization.conftest import KEMAR, RATE, modulated
from tests.ros1.localizer.session import present

TALKER, NOISE = -40.0, 120.0
IMAGE = 60.0  # of the noise, front-back
SCENE = f"""
sample_rate: {RATE}
seed: 6
head: {KEMAR}
noise: {{snr_db: 40}}
sources:
  - {{name: talker, file: TALKER.wav, loop: true, level_db: -30, azimuth: {TALKER}}}
  - {{name: fan, signal: noise, level_db: -40, azimuth: {NOISE}}}
"""


def near(message: Any, azimuth: float) -> bool:
    """Return whether a source is present within 15 degrees."""
    return any(abs(angles.difference(found, azimuth)) < 15 for found in present(message))


@pytest.fixture(scope="module")
def talking(graph: Graph, kemar_model: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    """Run the nodes with a talker with a pause of two seconds, and a fan; yield the localizer."""
    folder = tmp_path_factory.mktemp("scene")
    talker = modulated(5.0, 2)
    talker[3 * RATE :] = 0.0
    soundfile.write(folder / "TALKER.wav", talker, RATE)
    (folder / "scene.yaml").write_text(SCENE)
    with (
        graph.node("bass-ros"),
        graph.node("rosAFE-ros"),
        graph.start("rosafe", "localize", "--head", str(kemar_model), "--noise", "none") as node,
    ):
        assert graph.call("/bass/Acquire", device=f"scene:{folder / 'scene.yaml'}").genom_success
        wait_for(lambda: "/localizer/sources" in graph.topics() or not node.alive, what=lambda: f"{node}")
        yield node


def test_mute(graph: Graph, talking: Process) -> None:
    mute = rospy.Publisher("/localizer/mute", Bool, latch=True, queue_size=1)
    with (
        graph.collect("/localizer/sources", SoundSources) as messages,
        graph.collect("/diagnostics", DiagnosticArray) as diagnostics,
    ):

        def muted() -> bool:
            texts = [(s.message, {v.key: v.value for v in s.values}) for m in list(diagnostics) for s in m.status]
            return any("muted" in text and values.get("muted") == "yes" for text, values in texts)

        wait_for(lambda: messages and near(messages[-1], TALKER), what=lambda: f"{talking}")
        mute.publish(True)
        wait_for(lambda: muted() and not messages[-1].sources, what=lambda: f"{talking}")
        first = len(messages)
        wait_for(lambda: len(messages) > first + 60)  # longer than the talker pauses
        assert not any(message.sources for message in messages[first:])
        stamps = np.array([message.header.stamp.to_sec() for message in messages[first:]])
        assert np.median(np.diff(stamps)) < 0.2
        mute.publish(False)
        ended = rospy.get_time()
        found = wait_for(lambda: next((m for m in list(messages)[first:] if near(m, TALKER)), None))
        assert found is not None and found.header.stamp.to_sec() > ended + 0.3
        assert not [present(m) for m in messages if near(m, NOISE) or near(m, IMAGE)]
        diagnostics.clear()
        wait_for(lambda: any("localization" in s.name for m in list(diagnostics) for s in m.status))
        assert not muted()
    mute.unregister()
