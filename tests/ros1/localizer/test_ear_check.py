"""`rosafe localize --check`: swapped and silent ears, gains; with sounds, and with real nodes and a scene."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.localization import cues
from rosafe.localization.cues import PARAMETERS
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.live import NewFrames
from rosafe.localization.settings import LocalizerSettings
from rosafe.ros1.localizer import ear_check, measurement
from rosafe.ros1.localizer.ear_check import (
    DIRECTIONS,
    EarReport,
    HeardSound,
    assess,
    check_ears,
    check_ordinary,
    heard_sound,
)
from rosafe.ros1.transport import registration
from tests.harness import Graph, Process, wait_for
from tests.localization.conftest import RATE, modulated
from tests.localization.test_head_check import walk
from tests.ros1.localizer.room import Room

AZIMUTHS = {"left": 70.0, "ahead": 5.0, "right": -80.0}  # a person does not stand exactly there
QUIET = 1e-4


def measured(gains: tuple[float, float] = (1.0, 1.0), swapped: bool = False) -> dict[str, HeardSound]:
    """Return the sounds from the three directions, with a gain for each channel, of which ears may be swapped."""
    found = {}
    for seed, (direction, azimuth) in enumerate(AZIMUTHS.items()):
        ears = rosafe.Head.sphere().render(modulated(0.6, seed), RATE, azimuth)
        ears = np.array(gains)[:, np.newaxis] * (ears[::-1] if swapped else ears)
        ears = ears + QUIET * np.random.default_rng(seed).standard_normal(ears.shape)
        result = rosafe.process(ears, RATE, parameters=PARAMETERS, outputs=["itd", "ic", "ratemap"])
        levels = 10 * np.log10(result["ratemap"].sum(axis=1)).T
        quiet = rosafe.process(
            QUIET * np.random.default_rng(9).standard_normal(ears.shape),
            RATE,
            parameters=PARAMETERS,
            outputs=["ratemap"],
        )
        floor = np.median(10 * np.log10(quiet["ratemap"].sum(axis=1)), axis=1)
        found[direction] = heard_sound(levels, floor, result["itd"], result["ic"])
    return found


def gain_of(report: EarReport) -> tuple[str, float]:
    """Return the louder ear and the difference in dB."""
    match = re.search(r"gain: the (left|right) ear is (\S+) dB louder", "\n".join(report.lines))
    assert match is not None
    return match[1], float(match[2])


def test_correct_ears() -> None:
    sounds = measured()
    report = assess(sounds)
    assert not report.problems and any("not swapped" in line for line in report.lines)
    assert sounds["left"].lead_ms > 0.4 and sounds["right"].lead_ms < -0.4 and abs(sounds["ahead"].lead_ms) < 0.1
    assert sounds["left"].difference_db > 5 and sounds["right"].difference_db < -5
    assert gain_of(report)[1] < 2


def test_swapped_ears() -> None:
    report = assess(measured(swapped=True))
    assert report.problems == ("the ears are swapped: exchange the channels",)


@pytest.mark.parametrize("gain_db", [-12.0, -6.0, 6.0, 12.0])
def test_gain(gain_db: float) -> None:
    report = assess(measured(gains=(10 ** (gain_db / 20), 1.0)))
    louder, difference = gain_of(report)
    assert louder == ("left" if gain_db > 0 else "right") and difference == pytest.approx(abs(gain_db), abs=1.5)
    (problem,) = report.problems
    assert problem.startswith("the gains differ by") and "swapped" not in problem


@pytest.mark.parametrize(("gains", "ear"), [((0.0, 1.0), "left"), ((1.0, 0.0), "right"), ((1e-3, 1.0), "left")])
def test_a_silent_ear(gains: tuple[float, float], ear: str) -> None:
    problems = assess(measured(gains=gains)).problems
    assert problems == (f"the {ear} ear is silent: check its microphone, cable and channel",)


def test_one_microphone_on_both_channels() -> None:
    sound = HeardSound((-30.0, -30.0), (40.0, 40.0), 0.0)
    (problem,) = assess(dict.fromkeys(DIRECTIONS, sound)).problems
    assert "do not differ" in problem


def test_times_and_levels_that_contradict_each_other() -> None:
    sounds = {
        "left": HeardSound((-30.0, -40.0), (40.0, 30.0), -0.5),
        "ahead": HeardSound((-30.0, -30.0), (40.0, 40.0), 0.0),
        "right": HeardSound((-40.0, -30.0), (30.0, 40.0), 0.5),
    }
    (problem,) = assess(sounds).problems
    assert "contradict" in problem


class Sound:
    """The frames of a sound, in place of those of a rosAFE."""

    def __init__(self, sound: np.ndarray, head: Path) -> None:
        self.model = DirectionModel.load(head)
        self._features = rosafe.process(sound, RATE, parameters=self.model.parameters, outputs=list(cues.KINDS))
        self._begin = 0

    def discard(self) -> None:
        """Nothing waits."""

    def listen(self, seconds: float) -> Iterator[tuple[DirectionModel, NewFrames]]:
        end = min(self._begin + round(seconds * 100), self._features["itd"].shape[1])
        for begin in range(self._begin, end, 10):
            self._begin = min(begin + 10, end)
            features = {kind: np.asarray(self._features[kind])[..., begin : self._begin] for kind in cues.KINDS}
            yield self.model, NewFrames(features, np.arange(begin, self._begin) / 100, 0)


@pytest.mark.parametrize("ordinary", [False, True])
def test_ordinary_sound_of_a_pair(sphere_model: Path, ordinary: bool) -> None:
    """A place that is never quiet is noticed; also if the seconds were given."""
    listener: Any = Sound(walk(rosafe.Head.pair(0.058)), sphere_model)
    said: list[str] = []
    report = check_ordinary(listener, 60.0, said.append) if ordinary else check_ears(listener, said.append)
    assert report is not None and "--head pair:SPACING" in report.problems[0]
    assert any("it is not quiet" in line for line in said) != ordinary
    assert check_ordinary(Sound(np.zeros((2, RATE)), sphere_model), 60.0, said.append) is None  # type: ignore[arg-type]
    assert "too little sound" in said[-1]


def test_three_sounds_show_microphones_without_a_head(sphere_model: Path) -> None:
    pause = np.zeros((2, RATE))
    parts = [np.zeros((2, 2 * RATE))]
    for seed, azimuth in enumerate(AZIMUTHS.values()):
        parts += [rosafe.Head.pair(0.15).render(modulated(1.5, seed), RATE, azimuth), pause]
    sound = np.concatenate(parts, axis=1)
    sound += QUIET * np.random.default_rng(1).standard_normal(sound.shape)
    listener: Any = Sound(sound, sphere_model)
    report = check_ears(listener, lambda line: None)
    assert report is not None and len(report.problems) == 1
    assert report.problems[0].startswith("no level differences at high frequencies")


def said(process: Process, text: str) -> None:
    """Wait until a command has printed a text."""
    wait_for(lambda: text in process.out or not process.alive, what=lambda: f"{text!r}: {process}")
    assert text in process.out, process


@pytest.mark.parametrize("swapped", [False, True])
def test_the_command(graph: Graph, sphere_model: Path, swapped: bool) -> None:
    command = ("rosafe", "localize", "--check", "--head", str(sphere_model))
    with Room(graph) as room, graph.node("rosAFE-ros"):
        room.swapped = swapped
        with graph.start(*command) as check:
            for direction, name in (("left", "the left"), ("ahead", "straight ahead"), ("right", "the right")):
                said(check, f"now a sound from {name} of the head")
                room.azimuth = AZIMUTHS[direction]
                said(check, f"\n{direction}:")
                room.azimuth = None
            assert check.wait() == (1 if swapped else 0)
            assert ("the ears are swapped: exchange the channels" in check.out) == swapped
        left = wait_for(lambda: [p.name for p in graph.call("/rosAFE/getProcessors").processors])
        assert len(left) == 1 and left[0].startswith("input"), "processors that the check created are left"


def test_no_frames(graph: Graph, sphere_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    graph.client()
    monkeypatch.setattr(measurement, "SOUND_SECONDS", 1.0)
    settings = LocalizerSettings(head=str(sphere_model), rosafe="missing")
    said: list[str] = []
    with (
        measurement.FrameListener(settings) as listener,
        pytest.raises(measurement.NoFramesError, match="no frames of rosAFE for 1 s: waiting for rosAFE"),
    ):
        check_ears(listener, said.append)
    assert said == ["quiet, please: for 2 s"]


def test_a_sound_that_is_not_heard(
    graph: Graph, rosafe_node: Process, sphere_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph.client()
    ordinary = SimpleNamespace(is_replaced=False, parameters={})  # this process is a node of rospy
    monkeypatch.setattr(registration, "_registrar", ordinary)
    monkeypatch.setattr(ear_check, "QUIET_SECONDS", 0.5)
    monkeypatch.setattr(ear_check, "WAIT_SECONDS", 1.0)
    said: list[str] = []
    with Room(graph), measurement.FrameListener(LocalizerSettings(head=str(sphere_model))) as listener:
        assert check_ears(listener, said.append) is None
    assert said[-1].startswith("no sound was heard from the left of the head for 1 s")
