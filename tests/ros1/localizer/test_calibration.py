"""The stored level of the noise: measured with real nodes, and loaded by the node."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rospy

import rosafe
from rosafe.localization.live import ERROR, OK, WARN
from rosafe.localization.noise import FORMAT, NoiseCalibration
from rosafe.localization.status import NodeStatus
from rosafe.localization.stored_noise import StoredNoise
from tests.harness import Graph
from tests.localization.conftest import RATE
from tests.ros1.localizer.room import Room


def test_calibration(graph: Graph, sphere_model: Path, tmp_path: Path) -> None:
    path = tmp_path / "noise.json"
    with Room(graph) as room, graph.node("rosAFE-ros"):
        room.azimuth = 30.0
        done = graph.run(
            "rosafe", "localize", "--calibrate-noise", "2", "--noise", str(path), "--head", str(sphere_model)
        )
    assert f"written to {path}" in done.stdout and "not steady" not in done.stdout
    stored = NoiseCalibration.load(path)
    model = rosafe.Localizer(RATE, sphere_model).model
    sound = room.sound(30.0)
    expected = rosafe.process(sound, RATE, parameters=model.parameters, outputs=["ratemap"])["ratemap"]
    assert np.allclose(stored.level_db, 10 * np.log10(expected.sum(axis=0).mean(axis=1)), atol=1.0)
    level = float(done.stdout.split("noise level ")[1].split()[0])
    assert level == pytest.approx(10 * np.log10(np.mean(sound**2)), abs=2.0)


class _Status(NodeStatus):
    def __init__(self) -> None:
        super().__init__(lambda: None, {OK: rospy.loginfo, WARN: rospy.logwarn, ERROR: rospy.logerr})

    @property
    def file(self) -> str:
        """The file in the diagnostics."""
        return self._values["noise calibration"]


def test_the_node_loads_a_calibration(sphere_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("rospy.logwarn", lambda text: None)
    localizer = rosafe.Localizer(RATE, sphere_model)
    status = _Status()
    StoredNoise("", status).apply(localizer)
    assert status.file == "none" and np.isneginf(localizer.noise.stored).all()
    path = tmp_path / "rosafe" / "noise.json"
    levels = np.linspace(-90, -40, localizer.model.channels)
    NoiseCalibration(RATE, localizer.model.parameters, levels).save(path)
    StoredNoise("", status).apply(localizer)
    assert status.file == str(path) and np.allclose(localizer.noise.stored, levels, atol=0.01)
    other = _Status()
    StoredNoise("none", other)
    assert other.file == "none"
    with pytest.raises(ValueError, match="missing file"):
        StoredNoise(str(tmp_path / "missing.json"), other)


def test_a_calibration_that_does_not_fit_is_not_used(
    sphere_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    warnings: list[str] = []
    monkeypatch.setattr("rospy.logwarn", warnings.append)
    localizer = rosafe.Localizer(RATE, sphere_model)
    path = tmp_path / "rosafe" / "noise.json"
    NoiseCalibration(44100.0, localizer.model.parameters, np.zeros(localizer.model.channels)).save(path)
    status = _Status()
    StoredNoise("", status).apply(localizer)
    assert status.state()[0] != OK and "sample_rate" in warnings[-1] and np.isneginf(localizer.noise.stored).all()
    path.write_text(json.dumps({"format": "other"}))
    StoredNoise("", status).apply(localizer)
    assert "damaged" in warnings[-1] and status.state()[0] != OK
    values = {"format": FORMAT, "sample_rate": 10**400, "parameters": {}, "level_db": [0.0]}
    path.write_text(json.dumps(values))
    StoredNoise("", status).apply(localizer)
    assert "damaged" in warnings[-1]
    NoiseCalibration(RATE, localizer.model.parameters, np.zeros(3)).save(path)
    StoredNoise(str(path), _Status()).apply(localizer)
    assert "level_db: expected" in warnings[-1] and np.isneginf(localizer.noise.stored).all()
