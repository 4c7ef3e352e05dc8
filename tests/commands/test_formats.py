"""Files of results: each format returns the results of `rosafe.process` with their origin."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import soundfile

import rosafe
from rosafe.audio.files.audiofile import AudioFileError
from rosafe.interface import KINDS
from rosafe.processing.files import FileResult, process_file
from rosafe.processing.sounds import read_ears
from rosafe.results import formats, writers
from rosafe.results.readers import READERS
from rosafe.system.output import OutputError
from rosafe.system.version import VERSION
from tests.audio import bags
from tests.commands.command import SMALL, SMALL_PARAMETERS, as_int32, ild_in, noise, refused, write
from tests.commands.command import rosafe as command
from tests.harness import run_program

RATE = 16000


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    return write(tmp_path / "sound.wav", noise(9000))


def assert_same(loaded: dict[str, Any], expected: dict[str, Any]) -> None:
    for name, value in expected.items():
        assert type(loaded[name]) is type(value), name
        np.testing.assert_array_equal(loaded[name], value, strict=isinstance(value, np.ndarray), err_msg=name)


@pytest.mark.parametrize("extension", [".npz", ".h5"])
@pytest.mark.parametrize(
    ("frames", "channels"),
    [(9000, [500.0]), (100, [200.0, 800.0, 2000.0])],  # a single channel also has axes; shorter than a frame
)
def test_all_outputs_are_loaded(tmp_path: Path, extension: str, frames: int, channels: list[float]) -> None:
    path = write(tmp_path / "sound.wav", noise(frames))
    target = tmp_path / f"result{extension}"
    parameters = {"fb_cfHz": channels}
    done = process_file(path, target, parameters, 4000, list(KINDS))
    assert done.seconds == frames / RATE and not done.skipped
    loaded = rosafe.load(target)
    expected = rosafe.process(
        as_int32(noise(frames)), RATE, parameters=parameters, block_frames=4000, outputs=list(KINDS)
    )
    assert_same(loaded, expected)
    assert loaded["parameters"]["fb_cfHz"] == channels and loaded["parameters"]["in_doNormalize"] is True
    about = {name: loaded[name] for name in ("sample_rate", "block_frames", "source", "rosafe_version")}
    assert about == {"sample_rate": RATE, "block_frames": 4000, "source": "sound.wav", "rosafe_version": VERSION}
    assert loaded["axes"]["crossCorrelation"] == ("channel", "lag", "time") and loaded["units"]["ild"] == "dB"
    again = rosafe.process(as_int32(noise(frames)), RATE, parameters=loaded["parameters"], block_frames=4000)
    np.testing.assert_array_equal(again["ild"], loaded["ild"])


def test_parameters_in_effect_are_stored(tmp_path: Path, sound: Path) -> None:
    """This includes the highest channel, which may follow from the sample rate."""
    target = tmp_path / "result.npz"
    few: dict[str, Any] = {"fb_nChannels": 3}
    process_file(sound, target, few, outputs=["ild"])
    effective = rosafe.load(target)["parameters"]
    assert effective["fb_highFreqHz"] == rosafe.load(target)["fb_cfHz"][-1] == 7600.0
    every = {p.name for kind in KINDS.values() for p in kind.parameters}
    assert every - set(effective) == {"ams_highFreqHz"}  # follows the sample rate, and is not computed
    again = rosafe.process(as_int32(noise(9000)), RATE, parameters=effective, outputs=["ild"])
    np.testing.assert_array_equal(again["ild"], rosafe.load(target)["ild"])
    for same in (few, {**few, "fb_highFreqHz": 7600.0}):
        assert process_file(sound, target, same, outputs=["ild"], resume=True).skipped
    with pytest.raises(OutputError, match="was computed with other parameters"):
        process_file(sound, target, {**few, "fb_highFreqHz": 7000.0}, outputs=["ild"], resume=True)
    process_file(sound, target, {**few, "fb_highFreqHz": 7000.0}, outputs=["ild"], replace=True)
    with pytest.raises(OutputError, match="was computed with other parameters"):
        process_file(sound, target, few, outputs=["ild"], resume=True)


@pytest.mark.parametrize("extension", [".npz", ".mat"])
def test_a_result_older_than_its_input_is_replaced(tmp_path: Path, sound: Path, extension: str) -> None:
    target = tmp_path / f"result{extension}"
    process_file(sound, target, SMALL_PARAMETERS, outputs=["ild"])
    assert process_file(sound, target, SMALL_PARAMETERS, outputs=["ild"], resume=True).skipped
    write(sound, noise(5000, 9))
    os.utime(sound, (2e9 + 2e9, 2e9 + 2e9))  # from a wrong clock: the result would be replaced each time
    assert process_file(sound, target, SMALL_PARAMETERS, outputs=["ild"], resume=True).skipped
    os.utime(sound)
    os.utime(target, (1e9, 1e9))
    assert not process_file(sound, target, SMALL_PARAMETERS, outputs=["ild"], resume=True).skipped
    expected = rosafe.process(as_int32(noise(5000, 9)), RATE, parameters=SMALL_PARAMETERS, outputs=["ild"])
    np.testing.assert_array_equal(ild_in(target), expected["ild"])


@pytest.mark.parametrize("output", ["ild", "input", "itd"])
def test_csv(tmp_path: Path, sound: Path, output: str) -> None:
    target = tmp_path / "result.csv"
    process_file(sound, target, SMALL_PARAMETERS, outputs=[output])
    expected = rosafe.process(as_int32(noise(9000)), RATE, parameters=SMALL_PARAMETERS, outputs=[output])
    table = np.loadtxt(target, delimiter=",", skiprows=2)
    np.testing.assert_array_equal(table[:, 0], expected[f"{output}_time"])
    np.testing.assert_array_equal(table[:, 1:].T, expected[output])
    first, second = target.read_text().splitlines()[:2]
    about = json.loads(first.removeprefix("# rosafe "))
    assert about["source"] == "sound.wav" and about["fixed"].get("fb_cfHz", [200, 800, 2000]) == [200, 800, 2000]
    head = second.split(",")
    assert head[1:] == (["left", "right"] if output == "input" else ["200 Hz", "800 Hz", "2000 Hz"])


@pytest.mark.parametrize("outputs", [["ratemap"], ["ild", "itd"], ["precedence"], None])
def test_csv_accepts_tables_only(tmp_path: Path, sound: Path, outputs: list[str] | None) -> None:
    match = r"^outputs: expected for a \.csv one output of two axes \(input, preProc, ild, .*\), got "
    with pytest.raises(ValueError, match=match):
        process_file(sound, tmp_path / "result.csv", outputs=outputs)
    assert not (tmp_path / "result.csv").exists()


@pytest.mark.parametrize("extension", [".npz", ".mat"])
def test_large_arrays_are_buffered_on_disk(
    tmp_path: Path, sound: Path, extension: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    process_file(sound, tmp_path / f"a{extension}", SMALL_PARAMETERS, 1000, ["ihc", "ild"])
    monkeypatch.setattr(writers, "IN_MEMORY", 1000)
    process_file(sound, tmp_path / f"b{extension}", SMALL_PARAMETERS, 1000, ["ihc", "ild"])
    read = np.load if extension == ".npz" else scipy.io.loadmat
    first, second = read(tmp_path / f"a{extension}"), read(tmp_path / f"b{extension}")
    for name in ("ihc", "ild", "fb_cfHz", "parameters"):
        np.testing.assert_array_equal(second[name], first[name])
    assert len(list(tmp_path.iterdir())) == 3


def test_mat(tmp_path: Path, sound: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Version 7.3 is HDF5 with MATLAB's types as attributes and reversed axes."""
    kinds = list(KINDS)
    expected = rosafe.process(as_int32(noise(9000)), RATE, parameters=SMALL_PARAMETERS, outputs=kinds)
    numbers = {name: value for name, value in expected.items() if not isinstance(value, list)}
    stored = {name for name, value in numbers.items() if not (name.endswith("_time") and np.size(value) == 9000)}
    process_file(sound, tmp_path / "a.mat", SMALL_PARAMETERS, 4000, kinds)
    found = scipy.io.loadmat(tmp_path / "a.mat")
    assert stored <= found.keys() and json.loads(found["parameters"][0]) == {
        **expected.parameters,
        "in_doNormalize": True,
    }
    for name in stored:
        np.testing.assert_array_equal(found[name].reshape(np.shape(expected[name])), expected[name], err_msg=name)
    monkeypatch.setattr(formats, "MAX_MAT5", 1000)
    process_file(sound, tmp_path / "b.mat", SMALL_PARAMETERS, 1000, kinds)
    content = (tmp_path / "b.mat").read_bytes()
    assert content.startswith(b"MATLAB 7.3 MAT-file") and content[124:128] == b"\x00\x02IM"
    with h5py.File(tmp_path / "b.mat") as file:
        for name in stored:
            np.testing.assert_array_equal(np.reshape(file[name][()].T, np.shape(expected[name])), expected[name])
        assert file["ihc"].shape == (9000, 3, 2) and file["ihc"].attrs["MATLAB_class"] == b"double"
        assert file["source"].attrs["MATLAB_class"] == b"char" and file["fb_cfHz"].shape == (1, 3)
        assert file["source"][()].astype("<u2").tobytes().decode("utf-16-le") == "sound.wav"
    process_file(
        write(tmp_path / "short.wav", noise(100)), tmp_path / "c.mat", SMALL_PARAMETERS, outputs=["ihc", "ild"]
    )
    with h5py.File(tmp_path / "c.mat") as file:
        assert file["ild"].attrs["MATLAB_empty"] and file["ild"][()].tolist() == [3, 0]


def test_mat_in_octave(tmp_path: Path, sound: Path) -> None:
    process_file(sound, tmp_path / "a.mat", SMALL_PARAMETERS, outputs=["ild"])
    program = (
        f"r = load('{tmp_path}/a.mat'); p = jsondecode(r.parameters);"
        "printf('%s %d %d %d %.17g %g', r.source, size(r.ild), size(r.fb_cfHz, 1), r.ild(2, 5), p.fb_cfHz(3))"
    )
    done = run_program(["octave-cli", "--no-init-file", "--eval", program])
    ild = ild_in(tmp_path / "a.mat")
    assert done.stdout.split() == ["sound.wav", "3", "55", "3", f"{ild[1, 4]:.17g}", "2000"], done


def test_metadata_of_hdf5(tmp_path: Path, sound: Path) -> None:
    process_file(sound, tmp_path / "a.h5", SMALL_PARAMETERS)
    with h5py.File(tmp_path / "a.h5") as file:
        assert [axis.label for axis in file["ratemap"].dims] == ["ear", "channel", "time"]
        assert file["ild"].attrs["unit"] == "dB" and "fb_nChannels" in json.loads(file.attrs["parameters"])


@pytest.mark.parametrize("extension", [".npz", ".h5", ".mat", ".csv"])
def test_resume(tmp_path: Path, sound: Path, extension: str) -> None:
    """Complete results are kept, partial ones replaced; results with other parameters and other files are refused."""
    target = tmp_path / f"a{extension}"

    def resume(parameters: dict[str, Any], **options: Any) -> FileResult:
        return process_file(sound, target, parameters, **{"outputs": ["ild"], "resume": True, **options})

    assert not resume(SMALL_PARAMETERS).skipped
    before, content = ild_in(target), target.read_bytes()
    assert resume(SMALL_PARAMETERS).skipped
    changes: list[dict[str, Any]] = [{"parameters": {"fb_cfHz": [500.0]}}, {"block_frames": 100}, {"channels": (2, 1)}]
    for changed in (*changes, {"outputs": ["itd"]}, {"pad": True}, {"clip": False}):
        name = next(iter(changed)) if extension in READERS else "options"
        with pytest.raises(OutputError, match=f"was computed with other {name}; .*--force"):
            resume(**{"parameters": SMALL_PARAMETERS, **changed})
    target.write_bytes(content[: 20 if extension in (".mat", ".csv") else len(content) // 3])
    assert not resume(SMALL_PARAMETERS).skipped
    np.testing.assert_array_equal(ild_in(target), before)
    target.write_text("foreign text")
    with pytest.raises(OutputError, match="expected a result of rosafe process, got another file; --force replaces it"):
        resume(SMALL_PARAMETERS)
    assert target.read_text() == "foreign text"


# --- inputs ---------------------------------------------------------------------------------------------------


def test_a_sound_file_of_floats(tmp_path: Path) -> None:
    """tests/audio has the other formats."""
    soundfile.write(tmp_path / "a.ogg", noise(20000).T / 4, RATE)
    assert command("process", "a.ogg", *SMALL, "--outputs", "input,ild", cwd=tmp_path).returncode == 0
    samples = np.rint(soundfile.read(tmp_path / "a.ogg")[0].T * (2**31 - 1)).astype(np.int32)
    expected = rosafe.process(samples, RATE, parameters=SMALL_PARAMETERS, outputs=["input", "ild"])
    assert_same(rosafe.load(tmp_path / "a.npz"), expected)


def test_channels(tmp_path: Path) -> None:
    """tests/audio has the rules of channels."""
    five = np.random.default_rng(5).integers(-(2**15), 2**15, (5, 3000)) / 2.0**15
    write(tmp_path / "five.wav", five)
    write(tmp_path / "mono.wav", five[:1])
    options = ("--channels", "5,1", "--outputs", "ild", "-o", "out.npz")
    assert command("process", "five.wav", *SMALL, *options, cwd=tmp_path).returncode == 0
    expected = rosafe.process(as_int32(five[[4, 0]]), RATE, parameters=SMALL_PARAMETERS, outputs=["ild"])
    loaded = rosafe.load(tmp_path / "out.npz")
    assert_same(loaded, expected)
    assert loaded["channels"] == [5, 1]
    refused(
        command("process", "five.wav", cwd=tmp_path), "left and right ear, got 5", "--channels 1,2 takes the first two"
    )
    refused(command("process", "mono.wav", cwd=tmp_path), "is mono)", "--channels 1,1 uses it for both")


def test_nan_and_infinite_samples_are_reported(tmp_path: Path) -> None:
    signal = noise(3000)
    signal[0, 5:7] = np.nan
    write(tmp_path / "a.wav", signal, subtype="FLOAT")
    done = command("process", "a.wav", *SMALL, "--outputs", "input", cwd=tmp_path)
    assert (
        done.returncode == 0
        and "; 2 samples were NaN or infinite and were replaced by silence or full scale" in done.stderr
    )
    assert rosafe.load(tmp_path / "a.npz")["input"][0, 5] == 0


def test_bags(tmp_path: Path) -> None:
    """Each frame is read once, from the first sound on; lost frames are replaced by silence."""
    samples = bags.stream(9000)
    indexes = [*range(120, 6000, 100), *range(6500, 9001, 100)]  # windows of 120; between them, 380 frames are lost
    messages = [bags.message(samples, index, 120, RATE) for index in indexes]
    bags.write(tmp_path / "a.bag", messages)
    bags.write(tmp_path / "left.bag", messages, "/left/Audio")
    expected_samples = samples.copy()
    expected_samples[:, 5920:6380] = 0
    parameters: dict[str, Any] = SMALL_PARAMETERS
    expected = rosafe.process(
        expected_samples, RATE, parameters=parameters, block_frames=1000, outputs=["input", "ild"]
    )
    options = (*SMALL, "--outputs", "input,ild", "--block", "1000")
    assert command("process", "a.bag", "left.bag", *options, cwd=tmp_path).returncode == 0
    for name in ("a", "left"):
        assert_same(rosafe.load(tmp_path / f"{name}.npz"), expected)
    done = command("process", "left.bag", *options, "--topic", "/bass/Audio", "-o", "b.npz", cwd=tmp_path)
    refused(done, "left.bag: expected the topic /bass/Audio, got /left/Audio")
    done = command("process", "a.bag", *options, "--channels", "2,1", "-o", "b.h5", cwd=tmp_path)
    assert done.returncode == 0
    np.testing.assert_array_equal(rosafe.load(tmp_path / "b.h5")["input"], expected["input"][::-1])


def test_small_bags_with_hours_of_sound(tmp_path: Path) -> None:
    """Silence in place of lost frames, and compressed silence that is read as a whole."""
    samples = bags.stream(240)
    jump = [bags.message(samples, 120, 120, 10**6), bags.message(samples, 240, 120, 10**6)]
    jump[1].lastFrameIndex = 3 * 10**9
    bags.write(tmp_path / "a.bag", jump)
    refused(
        command("process", "a.bag", *SMALL, cwd=tmp_path),
        "a.bag: expected at most 10 times as many lost frames as frames of sound, got 2999999760 and 240",
    )
    window = 2**21
    silence = [bags.message(np.zeros((2, 0), np.int32), 0, window, RATE, window) for _ in range(20)]
    for number, message in enumerate(silence, 1):
        message.lastFrameIndex = number * window
    bags.write(tmp_path / "b.bag", silence, compression="bz2")
    with pytest.raises(AudioFileError, match=r"b\.bag: its arrays: expected less than 320 MiB in a file of"):
        read_ears(tmp_path / "b.bag")


def test_a_bag_with_several_streams(tmp_path: Path) -> None:
    samples = bags.stream(2000)
    both = [bags.message(samples, index, 120, RATE) for index in (*range(100, 2001, 100), *range(100, 501, 100))]
    bags.write(tmp_path / "a.bag", both)
    refused(
        command("process", "a.bag", *SMALL, cwd=tmp_path),
        "a.bag: expected one stream of sound, got several successive ones",
        "rosafe record OUT.wav",
    )
    (tmp_path / "cut.bag").write_bytes((tmp_path / "a.bag").read_bytes()[:3000])
    refused(
        command("process", "cut.bag", *SMALL, cwd=tmp_path),
        "cut.bag: expected a complete bag, got one that was not closed by its recorder",
    )
