"""`rosafe.localize` and `rosafe.Localizer`: directions, equality of block lengths, silence, limits, rejected input."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.localization import cues
from rosafe.localization.cues import KINDS
from rosafe.localization.direction_model import TABLES, DirectionModel
from rosafe.localization.localize import clipped_samples
from tests.localization.conftest import RATE, modulated


def test_directions_in_the_front_half(sphere_model: Path) -> None:
    sphere = rosafe.Head.sphere()
    for azimuth in (-80.0, -30.0, 0.0, 45.0, 90.0):
        found = rosafe.localize(sphere.render(modulated(1.0, 3), RATE, azimuth), RATE, sphere_model)
        assert found["azimuth"][-1] == pytest.approx(azimuth, abs=5)
        assert found["confidence"][-1] > 0.9
        behind = 180 - azimuth if azimuth > 0 else -180 - azimuth
        posterior = dict(zip(found["azimuths"].tolist(), found["posterior"][-1], strict=True))
        assert posterior[5.0 * round(azimuth / 5)] == pytest.approx(posterior[180.0 if azimuth == 0 else behind])


def test_front_and_back_on_a_real_head(kemar_model: Path, kemar: rosafe.Head) -> None:
    for azimuth in (-150.0, -60.0, 20.0, 120.0):
        found = rosafe.localize(kemar.render(modulated(1.0, 3), RATE, azimuth), RATE, kemar_model, 1.0)
        assert found["azimuth"][-1] == pytest.approx(azimuth, abs=5)
    found = rosafe.localize(kemar.render(modulated(1.0, 3), RATE, 180.0), RATE, kemar_model, 1.0)
    posterior = dict(zip(found["azimuths"].tolist(), found["posterior"][-1], strict=True))
    assert found["azimuth"][-1] == 0 and posterior[0.0] == pytest.approx(posterior[180.0])


def test_a_turning_head_resolves_front_and_back(kemar_model: Path, kemar: rosafe.Head) -> None:
    yaw = np.linspace(0, 20, RATE)
    for azimuth in (180.0, 0.0, 170.0):
        ears = kemar.render(modulated(1.0, 5), RATE, azimuth - yaw)
        found = rosafe.localize(ears, RATE, kemar_model, 1.0, head_yaw=[[0, 0], [1, 20]])
        assert abs((found["azimuth"][-1] - azimuth + 180) % 360 - 180) <= 5


def test_the_shape_of_results(sphere_model: Path) -> None:
    found = rosafe.localize(modulated(2.0, 1).reshape(2, -1), RATE, sphere_model, 0.3)
    frames = len(found["time"])
    assert np.allclose(np.diff(found["time"]), 0.01) and 1.0 - found["time"][-1] < 0.01
    assert found["posterior"].shape == (frames, 72) and found["azimuths"].shape == (72,)
    assert np.allclose(found["posterior"].sum(axis=1), 1) and (found["posterior"] >= 0).all()
    assert ((found["confidence"] >= 0) & (found["confidence"] <= 1)).all()
    for track in found["tracks"]:
        assert {len(track[name]) for name in ("time", "azimuth", "azimuth_std", "probability")} == {len(track["time"])}


def _equal(first: dict[str, Any], second: dict[str, Any]) -> None:
    for name in ("time", "azimuth", "confidence", "posterior", "level_db"):
        assert np.array_equal(first[name], second[name], equal_nan=True), name


@pytest.mark.parametrize(("sizes", "seconds"), [([1], 0.1), ([160, 1, 999], 0.4), ([5000], 0.4)])
def test_blocks_do_not_matter(sphere_model: Path, sizes: list[int], seconds: float) -> None:
    sound = rosafe.Head.sphere().render(modulated(seconds, 2), RATE, 30)
    sound = sound + 0.01 * np.random.default_rng(1).standard_normal(sound.shape)
    yaw = [[0.0, 0.0], [seconds, 15.0]]
    whole = rosafe.localize(sound, RATE, sphere_model, 0.2, head_yaw=yaw)
    localizer = rosafe.Localizer(RATE, sphere_model, 0.2)
    for _ in range(2):  # the second time after a reset
        parts, begin, number = [], 0, 0
        while begin < sound.shape[1]:
            size = sizes[number % len(sizes)]
            parts.append(localizer.process(sound[:, begin : begin + size], yaw))
            begin, number = begin + size, number + 1
        names = ("time", "azimuth", "confidence", "posterior", "level_db")
        _equal(whole, {name: np.concatenate([part[name] for part in parts]) for name in names})
        assert len(localizer.tracks) == len(whole["tracks"])
        localizer.reset()


def test_frames_give_the_same_numbers_as_sound(sphere_model: Path) -> None:
    sound = rosafe.Head.sphere().render(modulated(0.5, 2), RATE, -40)
    localizer = rosafe.Localizer(RATE, sphere_model)
    features = rosafe.process(sound, RATE, parameters=localizer.model.parameters, outputs=list(KINDS))
    middle = 20
    parts = [
        localizer.update({kind: features[kind][..., part] for kind in KINDS}, features["itd_time"][part])
        for part in (slice(0, middle), slice(middle, None))
    ]
    whole = rosafe.localize(sound, RATE, sphere_model)
    _equal(whole, {name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name != "azimuths"})


def test_silence_is_nan(sphere_model: Path) -> None:
    found = rosafe.localize(np.zeros((2, RATE)), RATE, sphere_model)
    assert np.isnan(found["azimuth"]).all() and (found["confidence"] == 0).all() and not found["tracks"]
    assert np.allclose(found["posterior"], 1 / 72)
    sound = np.zeros((2, RATE))
    sound[:, : RATE // 2] = rosafe.Head.sphere().render(modulated(0.5, 2), RATE, 30)
    pause = rosafe.localize(sound, RATE, sphere_model, 0.8)
    assert pause["azimuth"][-1] == pytest.approx(30, abs=5)  # the window still contains sound
    assert np.isnan(rosafe.localize(sound, RATE, sphere_model, 0.2)["azimuth"][-1])


def test_noise_without_a_direction_has_a_low_confidence(kemar_model: Path) -> None:
    noise = 0.05 * np.random.default_rng(4).standard_normal((2, 8 * RATE))
    found = rosafe.localize(noise, RATE, kemar_model)
    assert np.mean(found["confidence"] < 0.3) >= 0.95
    assert not found["tracks"]


@pytest.mark.parametrize("level_db", [-20, -40])
def test_the_level_does_not_matter(kemar_model: Path, kemar: rosafe.Head, level_db: float) -> None:
    sound = kemar.render(modulated(1.0, 7), RATE, 65)
    sound += 0.02 * np.random.default_rng(2).standard_normal(sound.shape)
    sound *= 0.1 / np.sqrt(np.mean(sound**2))  # -20 dB
    loud = rosafe.localize(sound, RATE, kemar_model)
    soft = rosafe.localize(sound * 10 ** (level_db / 20), RATE, kemar_model)
    assert np.array_equal(loud["azimuth"], soft["azimuth"])
    assert np.abs(loud["posterior"] - soft["posterior"]).max() < 1e-3
    assert np.allclose(loud["level_db"] + level_db, soft["level_db"], atol=0.01)


def test_the_level_is_that_of_the_sound(sphere_model: Path) -> None:
    sound = 0.05 * np.random.default_rng(2).standard_normal((2, RATE))
    found = rosafe.localize(sound, RATE, sphere_model)
    assert found["level_db"][-1] == pytest.approx(20 * np.log10(0.05), abs=4)


def test_the_level_counts_the_power_of_both_ears() -> None:
    features = {"itd": np.zeros((1, 2)), "ild": np.zeros((1, 2)), "ic": np.ones((1, 2))}
    features["ratemap"] = np.array([[[0.25, 1e-9]], [[0.75, 1.0]]])  # (ear, channel, frame)
    found = cues.quantize(features, 0.0, cues.MAX_ITD)
    np.testing.assert_allclose(found.level, [[0.0], [10 * np.log10(1 + 1e-9)]], atol=1e-12)


def test_integers_are_the_same_sound(sphere_model: Path) -> None:
    whole = np.round(rosafe.Head.sphere().render(modulated(0.3, 2), RATE, 30) * 2**15).astype(np.int16)
    floats, integers = (rosafe.localize(sound, RATE, sphere_model) for sound in (whole / 2.0**15, whole.T))
    assert np.array_equal(floats["azimuth"], integers["azimuth"])
    assert np.allclose(floats["posterior"], integers["posterior"], atol=1e-3)


def test_clipping_is_one_warning(sphere_model: Path) -> None:
    sound = np.clip(40 * rosafe.Head.sphere().render(modulated(0.3, 2), RATE, 30), -1, 1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = rosafe.localize(sound, RATE, sphere_model)
    assert len(caught) == 1 and f"{np.count_nonzero(np.abs(sound) == 1)} samples are clipped" in str(caught[0].message)
    assert np.isfinite(found["azimuth"][-1])
    single = np.zeros((2, 1000))
    single[:, ::2] = 1.0  # peaks of a sound that reaches full scale
    assert (clipped_samples(single), clipped_samples(np.ones((2, 3)))) == (0, 6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sound": np.zeros(100)}, "two ears"),
        ({"sound": np.zeros((1, 100))}, "two ears"),
        ({"sound": np.full((2, 100), np.nan)}, "finite"),
        ({"sample_rate": 0}, "sample_rate: expected"),
        ({"sample_rate": 44100}, "sample_rate: expected 16000 Hz"),
        ({"seconds": 0}, "seconds: expected"),
        ({"head": "/nonexistent.sofa"}, "/nonexistent.sofa: "),
        ({"head": "/nonexistent.head"}, "/nonexistent.head: "),
        ({"head": 3}, "head: expected"),
        ({"parameters": {"ild_wname": "hamming"}}, "ild_wname: expected"),
        ({"parameters": {"nothing": 2.0}}, "nothing"),
        ({"head_yaw": "left"}, "head_yaw: expected"),
        ({"head_yaw": [[1, 0], [0, 5]]}, "head_yaw: expected ascending"),
        ({"head_yaw": float("nan")}, "head_yaw: expected"),
        ({"head_yaw": 1e308}, "head_yaw: expected a number from -1000000 to 1000000 degrees, got 1e+308"),
        (
            {"head_yaw": [[0, 1], [1, -2e6]]},
            "head_yaw: expected numbers from -1000000 to 1000000 degrees and times up to",
        ),
        ({"head_yaw": [[-1e300, 1], [1e300, 2]]}, "and times up to 1e+10 s, got [[-1e+300, 1], [1e+300, 2]]"),
        ({"head_yaw": [["a", 1]]}, "head_yaw: expected finite [time, degrees], got [['a', 1]]"),
        ({"head_yaw": [[0, 1], [2]]}, "head_yaw: expected finite [time, degrees], got"),
        ({"head_yaw": [[0, 10**400]]}, "head_yaw: expected finite [time, degrees], got"),
        ({"head_yaw": [[0, None]]}, "head_yaw: expected finite [time, degrees], got"),
        ({"parameters": 3, "head": "sphere"}, "parameters: expected a dict of names and values, got int"),
        ({"parameters": [], "head": "sphere"}, "parameters: expected a dict of names and values, got list"),
    ],
)
def test_wrong_arguments(sphere_model: Path, change: dict[str, Any], message: str) -> None:
    arguments = {"sound": np.ones((2, 4000)) * 0.1, "sample_rate": RATE, "head": sphere_model, **change}
    with pytest.raises(ValueError) as caught:
        rosafe.localize(**arguments)
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("rate", [1e9, 7999.0])
def test_absurd_rates_are_refused_at_once(monkeypatch: pytest.MonkeyPatch, rate: float) -> None:
    monkeypatch.setattr(cues, "describe", lambda *_: pytest.fail("computed"))
    with pytest.raises(ValueError, match=f"^sample_rate: expected 8000 to 768000 Hz, got {rate}$"):
        rosafe.localize(np.zeros((2, 100)), rate)


def test_a_refused_block_changes_nothing(sphere_model: Path) -> None:
    sound = modulated(0.5, 3) * np.ones((2, 1))
    localizer = rosafe.Localizer(RATE, sphere_model)
    with pytest.raises(ValueError, match="head_yaw: expected"):
        localizer.process(sound, "left")
    _equal(localizer.process(sound), rosafe.Localizer(RATE, sphere_model).process(sound))


def test_features_are_checked(sphere_model: Path) -> None:
    features = rosafe.process(np.ones((2, 4000)) * 0.1, RATE, outputs=list(KINDS))
    localizer = rosafe.Localizer(RATE, sphere_model)
    for change in ({"ild": features["ild"][:5]}, {"ic": features["ic"] * np.nan}, {"ratemap": features["ild"]}):
        with pytest.raises(ValueError, match="features"):
            localizer.update({**features, **change}, features["itd_time"])
    with pytest.raises(ValueError, match="features: expected a mapping with itd, ild, ic, ratemap, got NoneType"):
        localizer.update(None, [])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="got none for ratemap"):
        localizer.update({kind: features[kind] for kind in KINDS[:3]}, features["itd_time"])
    with pytest.raises(ValueError, match="time: expected"):
        localizer.update(features, features["itd_time"][:3])
    for time in (np.nan, 1e300):
        with pytest.raises(ValueError, match=r"time: expected finite times up to 1e\+10 s"):
            localizer.update(features, np.full_like(features["itd_time"], time))


def test_damaged_models_are_one_line(tmp_path: Path, sphere_model: Path) -> None:
    whole = sphere_model.read_bytes()
    changed = bytearray(whole)
    changed[len(whole) // 2] ^= 255
    for content in (b"", whole[: len(whole) // 2], bytes(changed), b"PK\3\4" + 100 * b"x"):
        path = tmp_path / "damaged.head"
        path.write_bytes(content)
        with pytest.raises(ValueError) as caught:
            rosafe.Localizer(RATE, path)
        assert str(caught.value).startswith(f"{path}: expected a model of rosafe head learn, got another or a damaged")
        assert "\n" not in str(caught.value)


def test_the_memory_order_of_the_tables_does_not_matter(sphere_model: Path) -> None:
    """As numpy interpolates them for recordings: the kernel reads rows of contiguous memory."""
    model = DirectionModel.load(sphere_model)
    description = {**vars(model), "parameters": model.parameters}
    with np.load(sphere_model) as file:
        other = DirectionModel(description, *(np.asfortranarray(file[name]) for name in TABLES))
    assert other.itd_table.flags.c_contiguous and other.ild_table.flags.c_contiguous
    sound = rosafe.Head.sphere().render(modulated(0.3, 2), RATE, 30)
    _equal(rosafe.localize(sound, RATE, model), rosafe.localize(sound, RATE, other))  # type: ignore[arg-type]
