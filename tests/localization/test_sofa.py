"""SOFA files of laboratories: labels of ears and azimuths, errors of measurement, values for each measurement."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rosafe
from rosafe.commands.__main__ import main
from rosafe.localization import angles, settings, training
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.horizontal_plane import near_ear_gain
from rosafe.localization.scene import SceneRenderer
from rosafe.localization.scene_file import SceneError, read_scene
from rosafe.localization.sofa import read_sofa
from tests.harness import shared
from tests.models import random_model

h5py = pytest.importorskip("h5py")
DEGREE = "degree, degree, metre"
AZIMUTHS = np.arange(0, 360, 5.0)
RANDOM = np.random.default_rng(3)


class Laboratory:
    """The contents of a SOFA file of the rigid sphere with a flat level, to be changed before `write`."""

    def __init__(self, azimuths: np.ndarray = AZIMUTHS, rate: float = 44100.0) -> None:
        self.rate = rate
        count = len(azimuths)
        self.source = np.stack((azimuths, np.zeros(count), np.full(count, 1.2)), 1)
        filters = rosafe.Head.sphere().filters(rate)
        self.responses = np.stack([filters.response(float(angle)) for angle in angles.wrap(azimuths)])
        self.variables: dict[str, Any] = {
            "ReceiverPosition": np.array([[0, 0.09, 0], [0, -0.09, 0]])[..., np.newaxis],
            "Data.SamplingRate": np.array([rate]),
            "Data.Delay": np.zeros((1, 2)),
        }
        self.attributes: dict[str, dict[str, Any]] = {"SourcePosition": {"Type": "spherical", "Units": DEGREE}}

    def write(self, path: Path) -> Path:
        with h5py.File(path, "w") as file:
            file.attrs["SOFAConventions"] = "SimpleFreeFieldHRIR"
            for name, value in {**self.variables, "SourcePosition": self.source, "Data.IR": self.responses}.items():
                file[name] = value
                file[name].attrs.update(self.attributes.get(name, {}))
        return path

    def repeat(self, *changes: Callable[[np.ndarray], None]) -> None:
        """Measure all directions again for each change of their positions; other responses are attenuated by 6 dB."""
        sources = []
        for change in changes:
            sources.append(self.source.copy())
            change(sources[-1])
        self.responses = np.concatenate(
            [self.responses * (1.0 if place == 1 else 0.5) for place in range(len(changes))]
        )
        self.source = np.concatenate(sources)


def read(path: Path, mirror: bool | None = None) -> tuple[rosafe.Head, list[str]]:
    """Return the head in a file, and the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        head = rosafe.Head.from_sofa(path, mirror)
    return head, [str(one.message) for one in caught]


def left_level(head: rosafe.Head) -> float:
    """Return the level of the left ear above the right one in dB, of a source at 60 degrees left."""
    return -float(head.ild([2500.0], [60.0])[0, 0])


@pytest.fixture
def plain(tmp_path: Path) -> rosafe.Head:
    return rosafe.Head.from_sofa(Laboratory().write(tmp_path / "plain.sofa"))


# --- ears and azimuths ------------------------------------------------------------------------------------------


def _right_ear_first(lab: Laboratory) -> None:
    lab.variables["ReceiverPosition"] = lab.variables["ReceiverPosition"][::-1]


def _clockwise(lab: Laboratory) -> None:
    lab.source[:, 0] = -lab.source[:, 0] % 360


@pytest.mark.parametrize("rate", [8000.0, 16000.0, 44100.0, 96000.0])
@pytest.mark.parametrize(
    ("change", "correction"), [(_right_ear_first, "the ears are exchanged"), (_clockwise, "the azimuths are negated")]
)
def test_wrong_labels_are_corrected(
    tmp_path: Path, change: Callable[[Laboratory], None], correction: str, rate: float
) -> None:
    """The left ear is stored first and labelled as the right one, or azimuths are clockwise."""
    lab = Laboratory(rate=rate)
    right = rosafe.Head.from_sofa(lab.write(tmp_path / "right.sofa"))
    change(lab)
    path = lab.write(tmp_path / "wrong.sofa")
    head, reported = read(path)
    assert len(reported) == 1 and reported[0].startswith(f"{path}: sources that are labelled left are ")
    assert correction in reported[0] and "--no-mirror" in reported[0] and "\n" not in reported[0]
    assert head.key == right.key and left_level(head) > 2
    for mirror, level in ((True, left_level(head)), (False, -left_level(head))):
        asked, reported = read(path, mirror)
        assert reported == [] and left_level(asked) == pytest.approx(level, abs=1e-6)


def test_labels_that_agree_with_each_other_are_right(tmp_path: Path, plain: rosafe.Head) -> None:
    """The right ear first, labelled so; and azimuths clockwise with exchanged ears."""
    both = Laboratory()
    _right_ear_first(both)
    both.responses = both.responses[:, ::-1]
    head, reported = read(both.write(tmp_path / "a.sofa"))
    assert reported == [] and head.key == plain.key


def test_an_uncalibrated_ear_does_not_decide(tmp_path: Path) -> None:
    lab = Laboratory()
    lab.responses = lab.responses * np.array([[1.0], [20.0]])
    assert read(lab.write(tmp_path / "a.sofa"))[1] == []


def test_microphones_without_a_head_are_read_as_labelled(tmp_path: Path) -> None:
    lab = Laboratory()
    lab.responses = RANDOM.normal(0, 0.01, lab.responses.shape)
    lab.responses[..., 20] += 1.0
    path = lab.write(tmp_path / "pair.sofa")
    assert abs(near_ear_gain(*read_sofa(path)[:3])) < 1
    assert read(path)[1] == []


def test_a_measured_file_with_clockwise_azimuths_in_the_front_half() -> None:
    head, reported = read(shared("rooms", "UniS_Anechoic_BRIR_16k.sofa"))
    assert len(reported) == 1 and "the azimuths are negated" in reported[0]
    assert head.front_only and head.front_back_equal and head.azimuths.tolist() == np.arange(-90, 91, 5.0).tolist()
    assert left_level(head) > 3 and head.itd([500.0], [60.0])[0, 0] < -300e-6


# --- the front half ---------------------------------------------------------------------------------------------


def test_a_head_of_the_front_half(tmp_path: Path, plain: rosafe.Head) -> None:
    path = Laboratory(np.arange(-90, 91, 5.0)).write(tmp_path / "front.sofa")
    head, reported = read(path)
    assert reported == [] and head.front_only and not plain.front_only
    assert np.array_equal(head.filters(44100).response(30.0), plain.filters(44100).response(30.0))
    noise = RANDOM.standard_normal(1000)
    assert np.allclose(head.render(noise, 44100, -70), plain.render(noise, 44100, -70))
    for azimuth in (100, np.linspace(0, 91, 1000)):
        with pytest.raises(ValueError, match=r"azimuth: expected -90 to 90 degrees, which .* covers"):
            head.render(noise, 44100, azimuth)
    scene = tmp_path / "scene.yaml"
    scene.write_text(f"head: {path.name}\nsources: [{{signal: noise, azimuth: 110}}]\n")
    assert main(["record", str(tmp_path / "a.wav"), "--device", f"scene:{scene}", "-q", "--seconds", "0.1"]) == 1


@pytest.mark.parametrize(
    ("azimuth", "problem"),
    [
        ("[[0, 80], [5, 20]]", ""),
        ("[[0, 90], [1.5, 0], [3, -90]]", ""),
        ("[[0, 450], [1.5, 360], [3, 270]]", ""),
        ("120", "azimuth: expected -90 to 90 degrees, which .*got 120"),
        ("[[0, 90], [5, -90]]", "a: expected directions in front of the head, got a course behind it"),
    ],
)
def test_scenes_with_a_front_half(tmp_path: Path, azimuth: str, problem: str) -> None:
    """Also with labels that the scene corrects, and with noise from the front half."""
    lab = Laboratory(np.arange(-90, 91, 5.0))
    _right_ear_first(lab)
    lab.write(tmp_path / "front.sofa")
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        "head: {file: front.sofa, mirror: true}\nnoise: {snr_db: 20}\n"
        f"sources:\n  - {{name: a, signal: noise, azimuth: {azimuth}}}\n"
    )
    with pytest.raises(SceneError, match=problem) if problem else contextlib.nullcontext():
        samples = SceneRenderer(read_scene(scene)).frames(44100)
        assert np.std(samples[0]) > 1.2 * np.std(samples[1])


def test_the_model_of_a_front_half_is_equal_front_and_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "SOUND_SECONDS", 60.0)
    monkeypatch.setattr(training, "SNR_DB", (30.0, 10.0))
    monkeypatch.setattr(training, "ROOM_SNR_DB", (30.0,))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    lab = Laboratory(np.arange(-90, 91, 5.0), 16000.0)
    lab.responses *= np.array([[1.0], [1.2]])  # not symmetric: each side is learned
    head = rosafe.Head.from_sofa(lab.write(tmp_path / "front.sofa"))
    noise = 0.1 * RANDOM.standard_normal(16000)
    for azimuth in (-50.0, 20.0):
        found = rosafe.localize(head.render(noise, 16000, azimuth), 16000, head)
        assert abs(found["azimuth"][-1] - azimuth) <= 5
        at = {float(angle): p for angle, p in zip(found["azimuths"], found["posterior"][-1], strict=True)}
        assert at[azimuth] == pytest.approx(at[float(angles.wrap(180.0 - azimuth))], rel=1e-9)


@pytest.mark.parametrize("azimuths", [np.arange(-90, 70, 5.0), np.arange(0, 181, 5.0), np.arange(-70, 71, 5.0)])
def test_other_parts_are_refused(tmp_path: Path, azimuths: np.ndarray) -> None:
    path = Laboratory(azimuths).write(tmp_path / "part.sofa")
    with pytest.raises(ValueError, match="expected directions all around the head or from -90 to 90 degrees"):
        rosafe.Head.from_sofa(path)


# --- errors of measurement --------------------------------------------------------------------------------------


def test_measured_distances_and_elevations(tmp_path: Path, plain: rosafe.Head) -> None:
    lab = Laboratory()
    lab.source[:, 2] += RANDOM.normal(0, 0.01, 72)
    lab.source[:, 1] += np.clip(RANDOM.normal(0, 0.7, 72), -2.4, 2.4)
    head, reported = read(lab.write(tmp_path / "noisy.sofa"))
    assert reported == [] and head.key == plain.key


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_the_distance_with_most_directions_is_used(tmp_path: Path, plain: rosafe.Head, noise: float) -> None:
    def at(distance: float) -> Callable[[np.ndarray], None]:
        def change(source: np.ndarray) -> None:
            source[:, 2] = distance + RANDOM.normal(0, noise, len(source))

        return change

    lab = Laboratory()
    lab.repeat(at(0.5), at(1.0), at(2.0))
    kept = np.r_[0:60, 72:144, 144:200]  # the second distance is complete
    lab.source, lab.responses = lab.source[kept], lab.responses[kept]
    head, reported = read(lab.write(tmp_path / "distances.sofa"))
    assert reported == [] and head.key == plain.key


def test_the_ring_in_the_plane_is_used(tmp_path: Path, plain: rosafe.Head) -> None:
    lab = Laboratory()
    lab.repeat(*(lambda source, ring=ring: source.__setitem__((slice(None), 1), ring) for ring in (-1.0, 0.0, 1.0)))
    head, reported = read(lab.write(tmp_path / "rings.sofa"))
    assert reported == [] and head.key == plain.key


def test_directions_that_are_left_out_are_counted(tmp_path: Path) -> None:
    lab = Laboratory()
    lab.source[[3, 10, 11], 1] = (3.5, -4.0, 4.5)
    lab.source[[20, 50], 2] = (1.7, 0.9)
    head, reported = read(lab.write(tmp_path / "gaps.sofa"))
    assert len(reported) == 1 and ": 5 directions are left out: more than 3 degrees" in reported[0]
    assert len(head.azimuths) == 67 and not {15.0, 50.0, 55.0, 100.0, -110.0} & set(head.azimuths)


def test_the_error_names_tolerance_and_nearest_elevation(tmp_path: Path) -> None:
    lab = Laboratory()
    lab.source[:, 1] = RANDOM.uniform(10, 30, 72)
    lab.source[5, 1] = -4.25
    with pytest.raises(
        ValueError, match=r"within 3 degrees of the horizontal plane, got 4\.25 degrees as the nearest elevation"
    ):
        rosafe.Head.from_sofa(lab.write(tmp_path / "high.sofa"))


# --- coordinates and rates by measurement -----------------------------------------------------------------------


def _turned(lab: Laboratory, rotations: Rotation) -> None:
    """Turn head and sources together, for each measurement, and move them."""
    azimuth = np.radians(lab.source[:, 0])
    positions = 1.2 * np.stack((np.cos(azimuth), np.sin(azimuth), np.zeros(len(azimuth))), 1)
    place = RANDOM.normal(0, 2, (len(azimuth), 3))
    lab.source = rotations.apply(positions) + place
    lab.attributes["SourcePosition"] = {"Type": "cartesian", "Units": "metre"}
    ones = np.ones((len(azimuth), 1))
    lab.variables |= {
        "ListenerPosition": place,
        "ListenerView": rotations.apply(ones * [3.0, 0, 0]),
        "ListenerUp": rotations.apply(ones * [0, 0, 0.5]),
    }


@pytest.mark.parametrize("seed", [None, 4], ids=["one rotation", "a rotation for each measurement"])
def test_the_plane_is_that_of_the_head(tmp_path: Path, plain: rosafe.Head, seed: int | None) -> None:
    lab = Laboratory()
    one = Rotation.from_euler("ZYX", [130, 40, -25], degrees=True)
    _turned(lab, one if seed is None else Rotation.random(72, random_state=seed))
    head, reported = read(lab.write(tmp_path / "turned.sofa"))
    assert reported == [] and np.allclose(head.azimuths, plain.azimuths, atol=1e-5)
    assert np.array_equal(head.filters(44100).responses, plain.filters(44100).responses)


def test_a_view_in_degrees_for_each_measurement(tmp_path: Path, plain: rosafe.Head) -> None:
    """A fixed source and a head that turns; `ListenerUp` has the coordinates of `ListenerView`."""
    lab = Laboratory()
    lab.variables["ListenerView"] = np.stack((-lab.source[:, 0], np.zeros(72), np.ones(72)), 1)
    lab.variables["ListenerUp"] = np.array([[0.0, 90.0, 1.0]])
    lab.attributes["ListenerView"] = {"Type": "spherical", "Units": DEGREE}
    lab.source = np.array([[0.0, 0.0, 1.2]])
    assert read(lab.write(tmp_path / "view.sofa"))[0].key == plain.key


@pytest.mark.parametrize(
    "attributes",
    [
        {"Units": "Degrees, Degrees, Meters"},
        {"Type": h5py.Empty("S1"), "Units": DEGREE},
        {"Type": h5py.Empty("S1"), "Units": h5py.Empty("S1")},
        {"Type": "Spherical", "Units": h5py.Empty("S1")},
        {},
    ],
)
def test_coordinates_of_sources(tmp_path: Path, plain: rosafe.Head, attributes: dict[str, Any]) -> None:
    lab = Laboratory()
    lab.attributes["SourcePosition"] = attributes
    assert read(lab.write(tmp_path / "a.sofa"))[0].key == plain.key


def test_values_for_each_measurement(tmp_path: Path, plain: rosafe.Head) -> None:
    lab = Laboratory()
    lab.variables["Data.SamplingRate"] = np.full(72, 44100.0)
    lab.variables["ReceiverPosition"] = np.repeat(lab.variables["ReceiverPosition"], 72, axis=2)
    assert read(lab.write(tmp_path / "a.sofa"))[0].key == plain.key


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        (
            "Data.SamplingRate",
            np.r_[44100.0, np.full(71, 48000.0)],
            "one Data.SamplingRate for all directions, got 44100",
        ),
        ("Data.SamplingRate", np.full(5, 44100.0), "1 or 72 numbers in Data.SamplingRate, got shape (5,)"),
        ("ListenerView", np.zeros((1, 3)), "vectors that are not zero in ListenerView, got zero"),
        ("ListenerUp", np.array([[2.0, 0, 0]]), "ListenerUp that is not parallel to ListenerView"),
        ("ListenerView", np.ones((5, 3)), "1 or 72 rows in ListenerView, got 5"),
        ("ReceiverPosition", np.zeros((2, 3, 7)), "ReceiverPosition for two receivers"),
    ],
)
def test_unsuitable_coordinates_are_refused(tmp_path: Path, name: str, value: np.ndarray, message: str) -> None:
    lab = Laboratory()
    lab.variables[name] = value
    path = lab.write(tmp_path / "a.sofa")
    with pytest.raises(ValueError) as caught:
        rosafe.Head.from_sofa(path)
    assert str(caught.value).startswith(f"{path}: expected ") and message in str(caught.value)


def test_ears_that_change_sides_are_refused(tmp_path: Path) -> None:
    lab = Laboratory()
    positions = np.repeat(lab.variables["ReceiverPosition"], 72, axis=2)
    positions[:, 1, 30:] *= -1
    lab.variables["ReceiverPosition"] = positions
    with pytest.raises(ValueError, match="one receiver on the left"):
        rosafe.Head.from_sofa(lab.write(tmp_path / "a.sofa"))


# --- commands and the node --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("option", "corrected"), [((), True), (("--mirror",), True), (("--no-mirror",), False)])
def test_the_option_of_head_learn(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    option: tuple[str, ...],
    corrected: bool,
) -> None:
    """The head that is learned; other tests learn models by this command."""
    learned: list[rosafe.Head] = []

    def learn(head: rosafe.Head, *_: Any) -> DirectionModel:
        learned.append(head)
        return random_model(3, np.random.default_rng(1))

    monkeypatch.setattr(training, "learn_head", learn)
    lab = Laboratory()
    right = rosafe.Head.from_sofa(lab.write(tmp_path / "a.sofa"))
    _right_ear_first(lab)
    path = lab.write(tmp_path / "a.sofa")
    assert main(["head", "learn", str(path), "-o", str(tmp_path / "a.head"), "--rate", "16000", *option]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert [line.startswith("rosafe head: ") for line in lines] == ([True, False] if not option else [False])
    assert [head.key == right.key for head in learned] == [corrected]


def test_the_setting_of_the_node() -> None:
    given = {"head": "a.sofa", "mirror": False, "seconds": 0.5, "world_frame": "", "head_frame": "head"}
    given |= {"rosafe": "rosAFE", "connect": "", "audio_delay": 0.0, "noise": "none"}
    assert settings.checked_settings(given).mirror is False
    assert settings.checked_settings({**given, "mirror": ""}).mirror is None  # of the launch file
    with pytest.raises(ValueError, match="mirror: expected true or false, got 'no'"):
        settings.checked_settings({**given, "mirror": "no"})
    with pytest.raises(ValueError, match="mirror: expected a SOFA file as the head, got 'sphere'"):
        settings.Models(settings.LocalizerSettings(mirror=True))
    with pytest.raises(ValueError, match="world_frame: expected another frame than head_frame, got 'head'"):
        settings.checked_settings({**given, "world_frame": "/head"})
