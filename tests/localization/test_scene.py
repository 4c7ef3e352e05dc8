"""Scenes: rendering, truth, limits of the parser, the device, the truth file."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
import soundfile

import rosafe
from rosafe.audio.devices import open_source
from rosafe.audio.devices.scene import SceneFileSource
from rosafe.interface import ComponentError
from rosafe.localization.results import read_yaw
from rosafe.localization.scene import Course, SceneRenderer, truth_csv
from rosafe.localization.scene_file import SampleRateError, SceneError, read_scene
from tests.harness import ROOT
from tests.localization.conftest import KEMAR

RATE = 44100


def scene_file(folder: Path, text: str) -> Path:
    path = folder / "scene.yaml"
    path.write_text(text)
    return path


def test_courses_take_the_shorter_way() -> None:
    course = Course((0.0, 10.0), (170.0, -170.0))
    assert course.at(np.array([-1.0, 0.0, 5.0, 10.0, 20.0])).tolist() == [170, 170, 180, 190, 190]


def test_a_static_source_is_the_rendered_signal(tmp_path: Path) -> None:
    signal = 0.1 * np.random.default_rng(1).standard_normal(RATE)
    soundfile.write(tmp_path / "noise.wav", signal, RATE, "DOUBLE")
    path = scene_file(tmp_path, "sources: [{file: noise.wav, level_db: -20, azimuth: 40}]")
    ears = SceneRenderer(read_scene(path)).frames(RATE)
    scaled = signal * 0.1 / np.sqrt(np.mean(signal**2))
    assert np.allclose(ears, rosafe.Head.sphere().render(scaled, RATE, 40), atol=1e-6)


@pytest.mark.parametrize("room", ["", "room: {rt60: 0.3, drr_db: 0}, "])
def test_samples_do_not_depend_on_chunks_and_repeat(tmp_path: Path, room: str) -> None:
    path = scene_file(
        tmp_path,
        f"{{seed: 5, {room}noise: {{snr_db: 10}}, head_yaw: [[0, 0], [1, 30]], sources: ["
        "{signal: noise, azimuth: [[0, 0], [1, 90]]}, {signal: vowel, start: 0.2, end: 0.3}]}",
    )
    whole = SceneRenderer(read_scene(path)).frames(30000)
    renderer = SceneRenderer(read_scene(path))
    pieces = [renderer.frames(count) for count in (1, 4095, 10000, 15904)]
    assert np.array_equal(np.concatenate(pieces, axis=1), whole)
    other = scene_file(tmp_path, path.read_text().replace("seed: 5", "seed: 6"))
    assert not np.array_equal(SceneRenderer(read_scene(other)).frames(30000), whole)


@pytest.mark.parametrize("signal", ["noise", "tone", "vowel"])
def test_levels_are_those_of_the_file(tmp_path: Path, signal: str) -> None:
    scene = read_scene(scene_file(tmp_path, f"sources: [{{signal: {signal}, level_db: -30}}]"))
    samples = scene.sources[0].signal.samples(1000, RATE)
    assert np.sqrt(np.mean(samples**2)) == pytest.approx(1, rel=0.02)
    assert np.allclose(scene.sources[0].signal.samples(3000, 100), samples[2000:2100], atol=1e-9)
    assert scene.sources[0].level_db == -30


def test_the_noise_has_its_snr_and_is_diffuse(tmp_path: Path) -> None:
    """The power of the noise at the ears is that of independent sources all around."""
    base = "noise: {snr_db: 10}\nsources: [{signal: noise, level_db: -20, start: 100}]"
    noise = SceneRenderer(read_scene(scene_file(tmp_path, base))).frames(4 * RATE)
    filters = rosafe.Head.sphere().filters(RATE)
    gain = np.mean([np.sum(filters.response(float(a)) ** 2, axis=1) for a in range(-170, 181, 10)], axis=0)
    expected = -30 + 10 * np.log10(gain)
    assert np.allclose(10 * np.log10(np.mean(noise**2, axis=1)), expected, atol=0.1)
    low = np.corrcoef(noise)[0, 1]
    assert abs(low) < 0.6


def test_start_end_loop(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "short.wav", 0.1 * np.ones(4410), RATE)
    path = scene_file(
        tmp_path,
        """
sources:
  - {name: once, file: short.wav, start: 0.5}
  - {name: loop, file: short.wav, loop: true, start: 0.2, end: 0.7}
  - {name: tone, signal: tone, azimuth: -200}
""",
    )
    scene = read_scene(path)
    once, loop = (source.signal.samples(4000, 6000) for source in scene.sources[:2])
    assert np.all(loop == loop[0]) and np.array_equal(once, np.where(np.arange(6000) < 410, loop, 0.0))
    assert scene.truth(0.1).names == ("tone",)
    assert scene.truth(0.55).names == ("once", "loop", "tone")
    assert scene.truth(0.65).names == ("loop", "tone")
    assert scene.truth(0.75) == (0.0, ("tone",), (160.0,))


def test_truth_is_relative_to_the_head(tmp_path: Path) -> None:
    path = scene_file(tmp_path, "head_yaw: [[0, 0], [1, 20]]\nsources: [{name: a, signal: noise, azimuth: -175}]")
    text = truth_csv(read_scene(path).truth, 0.03)
    assert text.splitlines() == [
        "time_s,head_yaw_deg,name,azimuth_deg",
        "0.00,0.000,a,-175.000",
        "0.01,0.200,a,-175.200",
        "0.02,0.400,a,-175.400",
    ]
    (tmp_path / "a.truth.csv").write_text(text)
    assert read_yaw(tmp_path / "a.truth.csv") == [[0.0, 0.0], [0.01, 0.2], [0.02, 0.4]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "sources: expected a list"),
        ("sources: []", "sources: expected a list"),
        ("sources: [{signal: noise}]\nvolume: 3", "unknown"),
        ("sources: [{signal: bang}]", "signal: expected one of noise, tone, vowel"),
        ("sources: [{azimuth: 3}]", "expected either file or signal"),
        ("sources: [{signal: noise, file: a.wav}]", "expected either file or signal"),
        ("sources: [{file: none.wav}]", "none.wav"),
        ("sources: [{signal: noise, azimuth: .nan}]", "azimuth: expected a number"),
        ("sources: [{signal: noise, azimuth: [[1, 0], [0, 0]]}]", "ascending"),
        ("sources: [{signal: noise, azimuth: [[1, 0, 2]]}]", "[time in s, degrees]"),
        ("sources: [{signal: noise, start: 3, end: 2}]", "end: expected more than start"),
        ("sources: [{signal: noise, start: 3, end: 3}]", "end: expected more than start"),
        ("sources: [{signal: noise, name: 'a,b'}]", "name: expected"),
        ("sources: [{signal: noise, name: a}, {signal: noise, name: a}]", "occurs twice"),
        ("sources: [" + "{signal: noise}," * 40 + "]", "1 to 32 sources"),
        ("duration: 1e9\nsources: [{signal: noise}]", "duration: expected"),
        ("sample_rate: 3\nsources: [{signal: noise}]", "sample_rate: expected"),
        ("head: /etc/passwd\nsources: [{signal: noise}]", "ends in .sofa"),
        ("head: none.sofa\nsources: [{signal: noise}]", "none.sofa"),
        ("noise: {}\nsources: [{signal: noise}]", "expected snr_db"),
        ("sources: !!python/object:os.system [x]", "tags"),
        ("a: &b 1\nsources: *b", "anchors"),
        pytest.param("sources: [{signal: noise}]\n" + "#" * 300_000, "at most 262144 bytes", id="large"),
    ],
)
def test_wrong_scenes_are_rejected(tmp_path: Path, text: str, message: str) -> None:
    path = scene_file(tmp_path, text)
    with pytest.raises(SceneError) as caught:
        read_scene(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
    assert message in str(caught.value)


def test_a_list_may_have_10000_points(tmp_path: Path) -> None:
    def text(count: int) -> str:
        return "sources: [{signal: noise, azimuth: [" + ",".join(f"[{n},0]" for n in range(count)) + "]}]"

    assert len(read_scene(scene_file(tmp_path, text(10_000))).sources[0].azimuth.times) == 10_000
    with pytest.raises(SceneError, match="expected 1 to 10000 points, got 10001"):
        read_scene(scene_file(tmp_path, text(10_001)))


def test_the_device(tmp_path: Path) -> None:
    path = scene_file(tmp_path, "duration: 0.1\nsources: [{signal: tone}]")
    source = open_source(f"scene:{path}", 0, 2000, threading.Event())
    assert isinstance(source, SceneFileSource) and source.sample_rate == RATE
    chunks = []
    while (chunk := source.read()) is not None:
        chunks.append(chunk.samples)
    assert [piece.shape for piece in chunks] == [(2, 2000)] * 3 and not chunks[-1][:, 410:].any()
    expected = SceneRenderer(read_scene(path)).frames(4410)
    assert np.allclose(np.concatenate(chunks, axis=1)[:, :4410] / 2.0**31, expected, atol=1e-9)


def test_the_device_rejects_other_rates_and_quotes_nothing(tmp_path: Path) -> None:
    path = scene_file(tmp_path, "sources: [{signal: tone}]")
    with pytest.raises(SampleRateError):
        read_scene(path, 16000)
    with pytest.raises(ComponentError) as caught:
        open_source(f"scene:{path}", 16000, 100, threading.Event())
    assert caught.value.ex == "::bass::e_hwparams"
    secret = scene_file(tmp_path, "password: hunter2")
    with pytest.raises(ComponentError) as caught:
        open_source(f"scene:{secret}", 0, 100, threading.Event())
    assert caught.value.ex == "::bass::e_device" and "password" not in caught.value.reason
    with pytest.raises(ComponentError) as caught:
        open_source("scene:/etc/passwd", 0, 100, threading.Event())
    assert "ends in .yaml" in caught.value.reason


@pytest.mark.parametrize("name", ["talker_in_noise", "talkers_in_room", "two_sources_crossing", "turning_head"])
def test_the_examples_can_be_read(name: str) -> None:
    if not KEMAR.exists() or not Path("/usr/share/sounds/alsa/Front_Center.wav").exists():
        pytest.skip("libmysofa1 or alsa-utils is not installed")
    scene = read_scene(ROOT / "examples" / "scenes" / f"{name}.yaml")
    ears = SceneRenderer(scene).frames(RATE)
    assert np.isfinite(ears).all() and 0.001 < np.std(ears) < 0.3 and np.abs(ears).max() < 1
