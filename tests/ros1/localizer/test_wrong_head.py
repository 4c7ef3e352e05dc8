"""The node reports cues that do not belong to its head, until the microphones are those of the head."""

from __future__ import annotations

from pathlib import Path

import pytest

import rosafe
from rosafe.localization.live import OK, WARN
from tests.localization.test_head_check import walk
from tests.ros1.localizer.test_long_silence import Robot


def test_the_node_reports_a_wrong_head(monkeypatch: pytest.MonkeyPatch, sphere_model: Path) -> None:
    robot = Robot(monkeypatch, sphere_model)
    robot.hear(walk(rosafe.Head.pair(0.058)))
    level, text = robot.status.state()
    assert level == WARN and text.startswith("the cues do not fit the head: no level differences")
    right = walk(rosafe.Head.sphere())
    for _ in range(6):  # the last minute counts
        robot.hear(right)
    assert robot.status.state()[0] == OK
