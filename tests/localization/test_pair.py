"""Two microphones without a head: responses, names, limits of the spacing, and directions of sound."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

import rosafe
from rosafe.commands.__main__ import main
from rosafe.commands.setup import _absolute
from rosafe.localization import angles, training
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.scene import SceneRenderer
from rosafe.localization.scene_file import SceneError, read_scene
from rosafe.localization.settings import LocalizerSettings, Models
from tests.localization.conftest import RATE, modulated

SPEED_OF_SOUND = 343.0


@pytest.mark.parametrize("rate", [16000, 44100])
@pytest.mark.parametrize("spacing", [0.05, 0.2])
def test_the_responses_are_delays_of_plane_waves(spacing: float, rate: int) -> None:
    pair = rosafe.Head.pair(spacing)
    frequencies = np.array([200.0, 1000.0, 5000.0])
    for azimuth in (0.0, 37.5, -60.0, 90.0, 150.0):
        response = pair.filters(rate).response(azimuth)
        left, right = response @ np.exp(-2j * np.pi * np.outer(np.arange(response.shape[1]) / rate, frequencies))
        assert np.allclose(np.abs(left), 1.0, atol=0.002) and np.allclose(np.abs(right), 1.0, atol=0.002)
        lead = spacing / SPEED_OF_SOUND * np.sin(np.radians(azimuth))
        assert np.allclose(left / right, np.exp(2j * np.pi * frequencies * lead), atol=0.005)
    assert np.allclose(pair.itd([500.0], [30.0, -90.0])[:, 0] * SPEED_OF_SOUND, [-spacing / 2, spacing], atol=1e-4)


def test_front_and_back_are_equal() -> None:
    pair = rosafe.Head.pair(0.1)
    assert pair.front_back_equal and pair.is_symmetric() and pair.name == "pair:0.1"
    assert np.array_equal(pair.render(modulated(0.1, 1), RATE, 40), pair.render(modulated(0.1, 1), RATE, 140))
    copy = pickle.loads(pickle.dumps(pair))
    assert copy.key == pair.key != rosafe.Head.pair(0.11).key != rosafe.Head.sphere().key
    assert np.array_equal(copy.filters(RATE).responses, pair.filters(RATE).responses)


@pytest.mark.parametrize("spacing", [0.0, -0.1, 1.5, float("nan"), "0.1", True])
def test_spacings_that_are_refused(spacing: object) -> None:
    with pytest.raises(ValueError, match=r"spacing: expected a distance of the microphones from 0\.01 to 1 m, got"):
        rosafe.Head.pair(spacing)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["pair:", "pair:wide", "pair:0", "pair:nan", "pair:5.8"])
def test_names_that_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match=rf"^head: expected pair: and the distance .* such as pair:0\.058, got '{name}'"
    ):
        rosafe.localize(np.zeros((2, 100)), RATE, name)
    scene = tmp_path / "scene.yaml"
    scene.write_text(f"head: '{name}'\nsources:\n  - {{signal: noise}}\n")
    with pytest.raises(SceneError, match="line 1: head: expected pair:"):
        read_scene(scene)


def test_a_spacing_beyond_the_largest_delay_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"at most 0\.377 m, .* cc_maxDelaySec \(0\.0011 s\), got 0\.4 m; raise .*0\.00117"
    ):
        rosafe.Localizer(RATE, "pair:0.4")
    with pytest.raises(ValueError, match=r"at most 0\.0343 m, .* cc_maxDelaySec \(0\.0001 s\), got 0\.058 m"):
        rosafe.Localizer(RATE, rosafe.Head.pair(0.058), parameters={"cc_maxDelaySec": 1e-4})


def test_scenes_setups_and_the_node_know_pairs(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("head: pair:0.2\nsample_rate: 16000\nsources:\n  - {signal: noise, azimuth: 90}\n")
    left, right = SceneRenderer(read_scene(path)).frames(RATE)
    lags = np.arange(-20, 21)
    correlation = [left[1000:15000] @ right[1000 + lag : 15000 + lag] for lag in lags]
    assert lags[np.argmax(correlation)] == round(0.2 / SPEED_OF_SOUND * RATE)
    assert np.std(left[1000:]) == pytest.approx(np.std(right[1000:]), rel=1e-3)
    assert _absolute({"head": "pair:0.2", "noise": "a.json"}, path) == {
        "head": "pair:0.2",
        "noise": str(tmp_path / "a.json"),
    }
    assert getattr(Models(LocalizerSettings(head="pair:0.2"))._head, "spacing", None) == 0.2


def test_the_command_learns_a_pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "SOUND_SECONDS", 5.0)
    monkeypatch.setattr(training, "SNR_DB", (20.0,))
    monkeypatch.setattr(training, "ROOM_SNR_DB", (20.0,))
    path = tmp_path / "pair.head"
    assert main(["head", "learn", "pair:0.1", "-o", str(path), "--rate", "16000"]) == 0
    assert DirectionModel.load(path).head == rosafe.Head.pair(0.1).key


def test_directions_of_a_narrow_pair(pair_model: DirectionModel, tmp_path: Path) -> None:
    """Also with a model from a file, and with gains that differ by 3 dB: levels do not count."""
    pair_model.save(tmp_path / "pair.head")
    model = DirectionModel.load(tmp_path / "pair.head")
    assert model.is_sphere and model.max_itd == pair_model.max_itd < 4e-4
    assert np.array_equal(model.itd_table, pair_model.itd_table) and model.parameters == pair_model.parameters
    for azimuth in (-60.0, -20.0, 0.0, 35.0, 60.0, 150.0):
        ears = rosafe.Head.pair(0.058).render(modulated(1.0, 3), RATE, azimuth) * np.array([[1.0], [0.7]])
        ears += 0.005 * np.random.default_rng(4).standard_normal(ears.shape)
        found = rosafe.localize(ears, RATE, tmp_path / "pair.head", 1.0)
        assert abs(found["azimuth"][-1] - angles.lateral(azimuth)) <= 5, azimuth
