"""Ten minutes of silence between two sounds, without waiting for them; a machine that is busy; long blocks."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rospy

from rosafe.localization import cues, live
from rosafe.localization.head import Head
from rosafe.localization.live import OK, FixedHead, FrameFormat, FrameQueue, LocalizationLoop
from rosafe.localization.localizer import Localizer
from rosafe.processing.stream import Stream
from rosafe.ros1.localizer.inputs import PortSource
from rosafe.ros1.localizer.settings import node_status
from tests.localization.conftest import RATE, modulated

BLOCK = RATE  # 1 s
SILENCE = 600  # blocks
START = 1_700_000_000.0  # clock time of the first sample


class Robot:
    """The loop of the localizer with the messages of a rosAFE; time passes only with blocks."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, head: Path) -> None:
        self.index = 0
        self.late = 0.0  # s since the end of the newest block
        self.published: list[tuple[float, list[float]]] = []  # stamp and azimuths of present sources
        clock: Any = SimpleNamespace(monotonic=lambda: self.index / RATE + self.late)
        monkeypatch.setattr(live, "time", clock)
        monkeypatch.setattr(rospy, "Subscriber", lambda *_, **__: SimpleNamespace(unregister=lambda: None))
        frame_clock: Any = SimpleNamespace(
            covers=lambda *_: True,
            problem="",
            missing="sound",
            time=lambda frame: SimpleNamespace(ros=rospy.Time.from_sec(START + frame / RATE)),
        )
        self.updated: Callable[..., None] = lambda *_: None
        self.begun = 0  # how often localization began again
        publishers: Any = SimpleNamespace(begin_again=self._begin_again, publish=self._publish)
        mute: Any = SimpleNamespace(active=False, muted=lambda times: np.zeros(len(times), bool))
        self.status = node_status(lambda: None)
        self.loop = LocalizationLoop(
            lambda model: Localizer(RATE, model, keep_history=False),
            publishers,
            FrameQueue(FixedHead(), mute),
            self.status,
            lambda: None,
            lambda: START + self.index / RATE + self.late,
            lambda *values: self.updated(*values),
        )
        model = Localizer(RATE, str(head)).model
        window, hop = (round(model.parameters[f"cc_{name}"] * RATE) for name in ("wSizeSec", "hSizeSec"))
        frame_format = FrameFormat(RATE, model.channels, window, hop, BLOCK)
        topics = dict.fromkeys(cues.KINDS, "")
        self.loop.connect(model, partial(PortSource, topics, frame_format, frame_clock))
        self._stream = Stream(RATE, model.parameters, list(cues.KINDS))

    def _begin_again(self) -> None:
        self.begun += 1

    def _publish(self, time: float, tracks: Any, *_: Any) -> None:
        present = [track.azimuth for track in tracks if track.id and track.probability > 0.5]
        self.published.append((time, present))

    def features(self, block: np.ndarray) -> dict[str, np.ndarray]:
        """Return the representations of a block of sound."""
        features = self._stream.process(block)
        return {kind: np.asarray(features[kind]) for kind in cues.KINDS}

    def receive(self, features: dict[str, np.ndarray]) -> None:
        """Deliver the representations of a block, and let the loop do what its thread does."""
        self.index += BLOCK
        source = self.loop._source
        assert isinstance(source, PortSource)
        for port in source._ports:
            found = features[port.kind]
            left, right = found if found.ndim == 3 else (found, None)
            message: Any = SimpleNamespace(
                lastFrameIndex=self.index,
                framesOnPort=found.shape[-1],
                left=left,
                right=right,
                problem="",
            )
            port._receive(message)
        self.loop._attempt(self.loop._use_new_frames)
        self.loop._attempt(self.loop._publish)

    def hear(self, sound: np.ndarray) -> None:
        """Deliver sound, (2, n)."""
        for begin in range(0, sound.shape[1], BLOCK):
            self.receive(self.features(sound[:, begin : begin + BLOCK]))


def test_long_silence(monkeypatch: pytest.MonkeyPatch, sphere_model: Path) -> None:
    robot = Robot(monkeypatch, sphere_model)
    talker = Head.sphere().render(modulated(4.0, 3), RATE, azimuth=40.0)
    robot.hear(talker)
    robot.hear(talker)
    assert any(abs(azimuth - 40) < 10 for azimuth in robot.published[-1][1])
    silence = np.zeros((2, BLOCK))
    robot.hear(np.tile(silence, 3))
    assert not robot.published[-1][1]
    features = robot.features(silence)  # from here on they are equal
    memory = []
    for second in range(SILENCE):
        robot.receive(features)
        if second % 250 == 50:
            gc.collect()
            memory.append(sys.getallocatedblocks() - 4 * len(robot.published))  # of this list
    stamps = np.array([stamp for stamp, _ in robot.published[-SILENCE:]])
    assert np.abs(np.diff(stamps) - 1).max() < 1e-6 and abs(stamps[-1] - (START + robot.index / RATE)) < 0.03
    assert not any(azimuths for _, azimuths in robot.published[-SILENCE:])
    assert max(memory) - memory[0] < SILENCE, memory
    robot.hear(talker)
    robot.hear(talker)
    assert any(abs(azimuth - 40) < 10 for azimuth in robot.published[-1][1])
    assert robot.status.state()[0] == OK and "lost frames" not in robot.status._values


def test_blocks_that_are_late_change_no_source(monkeypatch: pytest.MonkeyPatch, sphere_model: Path) -> None:
    """Until they arrive, no source is published. Localization begins again only if sound is missing."""
    robot = Robot(monkeypatch, sphere_model)
    talker = Head.sphere().render(modulated(4.0, 3), RATE, azimuth=40.0)
    robot.hear(talker)
    before, begun = robot.loop._localizer, robot.begun
    assert before is not None and robot.published[-1][1]
    ids = [track.id for track in before.sources]
    robot.late = 5.0
    robot.loop._attempt(robot.loop._publish)
    assert robot.published[-1] == (START + robot.index / RATE + 5.0, [])
    robot.hear(talker[:, :BLOCK])
    robot.late = 0.0
    robot.loop._attempt(robot.loop._publish)
    assert robot.published[-1][1] and [track.id for track in before.sources] == ids and robot.begun == begun
    robot.index += 3 * BLOCK
    robot.hear(talker)
    assert robot.begun > begun


def test_each_update_of_the_tracks_in_a_long_block_is_used(monkeypatch: pytest.MonkeyPatch, sphere_model: Path) -> None:
    """The streams get each of them. A block of one second has ten, as have frames that wait for a busy localizer."""
    robot, localizer = Robot(monkeypatch, sphere_model), Localizer(RATE, str(sphere_model))
    talker = Head.sphere().render(modulated(4.0, 3), RATE, azimuth=40.0)
    updates = []
    robot.updated = lambda time, tracks, _: updates.append((time, [track.azimuth for track in tracks]))
    first, *others = [robot.features(talker[:, begin : begin + BLOCK]) for begin in range(0, 4 * BLOCK, BLOCK)]
    robot.receive(first)  # whose frames are not used: their numbers follow from the next message
    for features in others:
        robot.receive(features)
    joined = {kind: np.concatenate([features[kind] for features in others], axis=-1) for kind in cues.KINDS}
    offline = []
    for begin in range(0, 3 * BLOCK // 160, 10):
        times = 1.0 + 0.01 * np.arange(begin, begin + 10)
        localizer.update({kind: array[..., begin : begin + 10] for kind, array in joined.items()}, times)
        offline.append((localizer.updated_at, [track.azimuth for track in localizer.sources]))
    assert len(updates) == 30 and any(azimuths for _, azimuths in offline)
    for (time, azimuths), (expected_time, expected) in zip(updates, offline, strict=True):
        assert time - START == pytest.approx(expected_time, abs=0.01) and azimuths == pytest.approx(expected, abs=1e-3)
