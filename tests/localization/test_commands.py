"""`rosafe localize`, `rosafe head learn`, the truth file of `rosafe record`, and the files of results."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import soundfile

import rosafe
from rosafe.commands.__main__ import main
from rosafe.localization import recordings, training
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.results import read_recordings, read_yaw
from tests.localization.conftest import RATE, modulated


@pytest.fixture
def wav(tmp_path: Path) -> Path:
    """Write half a second of a source at 50 degrees on the left."""
    path = tmp_path / "sound.wav"
    ears = rosafe.Head.sphere().render(modulated(0.5, 3), RATE, 50)
    soundfile.write(path, ears.T, RATE, subtype="FLOAT")
    return path


def test_csv_on_the_standard_output(wav: Path, sphere_model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["localize", str(wav), "--head", str(sphere_model)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "time_s,azimuth_deg,confidence,level_db" and len(lines) == 50
    time, azimuth, confidence, level = map(float, lines[-1].split(","))
    assert time == 0.5 and abs(azimuth - 50) <= 5 and 0.9 < confidence <= 1 and -40 < level < -10


def test_files(wav: Path, sphere_model: Path, tmp_path: Path) -> None:
    targets = [tmp_path / f"out.{suffix}" for suffix in ("csv", "json", "png")]
    arguments = ["localize", str(wav), "--head", str(sphere_model), "--seconds", "0.2"]
    arguments += [word for target in targets for word in ("-o", str(target))]
    assert main(arguments) == 0
    table: Any = np.genfromtxt(targets[0], delimiter=",", names=True)
    document = json.loads(targets[1].read_text())
    assert np.allclose(table["azimuth_deg"], np.array(document["azimuth_deg"], float))
    tracks: Any = np.atleast_1d(np.genfromtxt(tmp_path / "out.tracks.csv", delimiter=",", names=True))
    assert tracks.dtype.names == ("id", "time_s", "azimuth_deg", "azimuth_std_deg", "probability")
    assert abs(tracks["azimuth_deg"][-1] - 50) <= 5 and len(document["tracks"][0]["time_s"]) == len(tracks)
    assert targets[2].read_bytes().startswith(b"\x89PNG")
    assert main(arguments) == 1  # the files exist
    assert main([*arguments, "--force"]) == 0


def test_silence_is_nan_and_null(tmp_path: Path, sphere_model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "silence.wav"
    soundfile.write(path, np.zeros((RATE // 4, 2)), RATE)
    assert main(["localize", str(path), "--head", str(sphere_model), "-o", str(tmp_path / "a.json")]) == 0
    assert set(json.loads((tmp_path / "a.json").read_text())["azimuth_deg"]) == {None}
    assert main(["localize", str(path), "--head", str(sphere_model)]) == 0
    assert capsys.readouterr().out.splitlines()[1] == "0.020,nan,0.0000,-200.00"


def test_errors_are_one_line(wav: Path, tmp_path: Path, sphere_model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mono = tmp_path / "mono.wav"
    soundfile.write(mono, np.zeros(1000), RATE)
    for arguments, message in (
        ([str(mono)], "is mono"),
        ([str(wav), "--head", str(wav)], "expected a model"),
        ([str(wav), "--head", str(tmp_path / "none.sofa")], "none.sofa"),
        ([str(wav), "--yaw", str(wav)], "sound.wav"),
    ):
        assert main(["localize", *arguments]) == 1
        error = capsys.readouterr().err
        assert error.startswith("rosafe localize: ") and message in error and error.count("\n") == 1
        assert "--outputs" not in error and "--channels 1,1" not in error  # no direction would come of it
    for arguments, message in (
        (["-o", "out.txt"], "-o: expected a name that ends in .csv, .json, .png, got out.txt"),
        (["-o", "a.csv", "-o", "a.tracks.csv"], "-o: expected different files, got a.tracks.csv twice"),
        ([str(wav)], "SOUND: expected one file, got 2"),
    ):
        with pytest.raises(SystemExit, match="2"):
            main(["localize", str(wav), *arguments])
        assert message in capsys.readouterr().err


def test_targets_are_checked_before_anything_is_computed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The sound is missing as well, which would be found later."""
    for command, suffix in (
        (["localize", "none.wav"], "csv"),
        (["enhance", "none.wav", "--azimuth", "0"], "wav"),
        (["head", "learn", "none.sofa"], "head"),
    ):
        present = tmp_path / f"present.{suffix}"
        present.touch()
        for target, message in (
            (tmp_path / "missing" / f"out.{suffix}", "missing does not exist"),
            (present, "already exists; --force replaces it"),
        ):
            assert main([*command, "-o", str(target)]) == 1
            assert message in capsys.readouterr().err
        assert main([*command, "-o", str(tmp_path / f"new.{suffix}")]) == 1
        assert "none." in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"present.csv", "present.wav", "present.head"}


@pytest.mark.parametrize("words", [["localize", "none.wav", "-o", "new.png"], ["validate", "-o", "new.md"]])
def test_pictures_need_matplotlib_before_anything_is_computed(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(cast(dict[str, object], sys.modules), "matplotlib", None)
    monkeypatch.chdir(tmp_path)
    assert main(words) == 1
    output, error = capsys.readouterr()
    assert "matplotlib is not installed" in error and not output and not list(tmp_path.iterdir())


def test_a_csv_without_its_tracks_is_not_left(wav: Path, sphere_model: Path, tmp_path: Path) -> None:
    (tmp_path / "out.tracks.csv").mkdir()
    arguments = ["localize", str(wav), "--head", str(sphere_model), "-o", str(tmp_path / "out.csv"), "--force"]
    assert main(arguments) == 1
    assert {path.name for path in tmp_path.iterdir()} == {"sound.wav", "out.tracks.csv"}


def test_yaw_files(tmp_path: Path) -> None:
    path = tmp_path / "yaw.csv"
    path.write_text("name,head_yaw_deg,time_s\na,5,0\nb,5,0\na,7.5,1\n")
    assert read_yaw(path) == [[0.0, 5.0], [1.0, 7.5]]
    for text, message in (
        ("time_s,yaw\n0,1\n", "expected the columns"),
        ("time_s,head_yaw_deg\n0,x\n", "line 2: expected numbers"),
        ("time_s,head_yaw_deg\n0,1e308\n", "from -1000000 to 1000000 degrees, got '0,1e308'"),
        ("time_s,head_yaw_deg\n-1e300,0\n", "got '-1e300,0'"),
        ("time_s,head_yaw_deg\n1,0\n0,0\n", "line 3: expected ascending"),
        ("time_s,head_yaw_deg\n1\n", "line 2: expected 2 columns"),
        ("time_s,head_yaw_deg\n", "got none"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            read_yaw(path)


def test_lists_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "list.csv"
    path.write_bytes(b"\xff\xfe\0")
    with pytest.raises(ValueError, match=r"list\.csv: expected a CSV file in UTF-8, got other bytes$"):
        read_yaw(path)
    path.write_text("file,azimuth_deg\na.wav,left\n")
    with pytest.raises(ValueError, match=r"line 2: expected a file and an azimuth from .* degrees, got 'a\.wav,left'$"):
        read_recordings(path)


def test_a_model_of_recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Learned from recordings of the sphere every 15 degrees, it localizes sounds of the sphere."""
    monkeypatch.setattr(training, "SNR_DB", (20.0, 5.0))
    head = rosafe.Head.sphere()
    lines = ["file,azimuth_deg"]
    for azimuth in range(-180, 180, 15):
        ears = head.render(modulated(1.5, azimuth + 500), RATE, azimuth)
        soundfile.write(tmp_path / f"{azimuth}.wav", ears.T, RATE, subtype="FLOAT")
        lines.append(f"{azimuth}.wav,{azimuth}")
    table = tmp_path / "recordings.csv"
    table.write_text("\n".join(lines))
    assert len(read_recordings(table)) == 24
    target = tmp_path / "robot.head"
    assert main(["head", "learn", str(table), "-o", str(target)]) == 0
    assert DirectionModel.load(target).sample_rate == RATE
    found = rosafe.localize(head.render(modulated(1.0, 3), RATE, 45), RATE, target)
    assert min(abs(found["azimuth"][-1] - 45), abs(found["azimuth"][-1] - 135)) <= 5
    tables = recordings._interpolated(np.arange(25.0)[np.newaxis], np.arange(-180.0, 180.0, 15.0))
    assert np.allclose(tables[0, :5], np.arange(1, 6) / 3)  # of -175, -170 ... -155 degrees
    assert tables.shape == (1, 73) and tables[0, -1] == 24  # of reverberation
    table.write_text("file,azimuth_deg\n0.wav,0\n90.wav,90\n")
    assert main(["head", "learn", str(table), "-o", str(target), "--force"]) == 1
