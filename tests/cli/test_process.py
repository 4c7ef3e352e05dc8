"""`rosafe process`: the numbers of `rosafe.process` bit for bit, for any kind of file, and where they go."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from rosafe import process
from rosafe.interface import KINDS
from rosafe.npz import memory_map
from tests.cli.command import SMALL, SMALL_PARAMETERS, as_int32, noise, rosafe, write
from tests.harness import shared

BESIDES = {"sample_rate", "block_frames", "parameters"}


def assert_equal(path: Path, expected: dict[str, Any]) -> None:
    """The file holds exactly the results of `rosafe.process`, and what the command adds."""
    assert zipfile.ZipFile(path).testzip() is None
    with np.load(path) as loaded:
        assert set(loaded) == {*expected, *BESIDES}
        for name, value in expected.items():
            np.testing.assert_array_equal(loaded[name], value, strict=isinstance(value, np.ndarray), err_msg=name)
    mapped = memory_map(path)
    for name, value in expected.items():
        np.testing.assert_array_equal(mapped[name], value, err_msg=name)


@pytest.mark.parametrize(
    ("name", "subtype", "bits"),
    [
        ("in.wav", "PCM_U8", 8),
        ("in.wav", "PCM_16", 16),
        ("in.wav", "PCM_24", 24),
        ("in.wav", "PCM_32", 32),
        ("in.flac", "PCM_16", 16),
        ("in.aiff", "PCM_24", 24),
    ],
)
def test_integer_files(tmp_path: Path, name: str, subtype: str, bits: int) -> None:
    full = 2 ** (bits - 1)
    signal = np.random.default_rng(bits).integers(-full, full, (2, 5000)) / full  # exactly what the file can hold
    path = write(tmp_path / name, signal, subtype=subtype)
    done = rosafe("process", path, *SMALL, "--outputs", "input,ild")
    assert done.returncode == 0, done
    samples = as_int32(signal)
    assert np.all(samples % 2 ** (32 - bits) == 0)
    assert_equal(tmp_path / "in.npz", process(samples, 16000, SMALL_PARAMETERS, outputs=["input", "ild"]))


@pytest.mark.parametrize("subtype", ["PCM_U8", "PCM_24", "FLOAT", "DOUBLE"])
def test_extensible_header(tmp_path: Path, subtype: str) -> None:
    """WAVE_FORMAT_EXTENSIBLE, as many programs write it."""
    signal = np.random.default_rng(9).integers(-128, 128, (2, 5000)) / 128
    for name, form in (("plain.wav", "WAV"), ("extensible.wav", "WAVEX")):
        soundfile.write(tmp_path / name, signal.T, 16000, subtype, format=form)
    assert rosafe("process", "plain.wav", "extensible.wav", *SMALL, "--outputs", "input", cwd=tmp_path).returncode == 0
    with np.load(tmp_path / "plain.npz") as plain, np.load(tmp_path / "extensible.npz") as extensible:
        np.testing.assert_array_equal(plain["input"], extensible["input"])


@pytest.mark.parametrize("subtype", ["FLOAT", "DOUBLE"])
def test_float_files(tmp_path: Path, subtype: str) -> None:
    signal = np.random.default_rng(5).normal(0, 0.3, (2, 5000)).astype(np.float32).astype(np.float64)
    signal[:, 7] = 1.5, -1.5  # clipped
    path = write(tmp_path / "in.wav", signal, subtype=subtype)
    assert rosafe("process", path, *SMALL, "--outputs", "input,ratemap").returncode == 0
    samples = np.rint(np.clip(signal * (2**31 - 1), -(2**31), 2**31 - 1)).astype(np.int32)
    assert_equal(tmp_path / "in.npz", process(samples, 16000, SMALL_PARAMETERS, outputs=["input", "ratemap"]))


@pytest.mark.parametrize("rate", [22050, 44100, 96000])
def test_everything_at_any_rate_with_defaults(tmp_path: Path, rate: int) -> None:
    samples = np.random.default_rng(rate).integers(-(2**31), 2**31, (2, 30000)).astype(np.int32)
    path = write(tmp_path / "in.wav", samples, rate, "PCM_32")
    done = rosafe("process", path, "-o", tmp_path / "out.npz")
    assert done.returncode == 0, done
    expected = process(samples, rate)
    assert set(KINDS) < set(expected)
    assert_equal(tmp_path / "out.npz", expected)
    with np.load(tmp_path / "out.npz") as loaded:
        assert loaded["sample_rate"] == rate
        assert loaded["block_frames"] == 12000


def test_settings_and_blocks(tmp_path: Path) -> None:
    samples = np.random.default_rng(3).integers(-(2**30), 2**30, (2, 20000)).astype(np.int32)
    path = write(tmp_path / "in.wav", samples, 16000, "PCM_32")
    settings = ["pp_bNormalizeRMS=true", "fb_cfHz=500,1000", "ihc_method=bernstein", "rm_wname=hamming"]
    # gain control starts with the first block: this one fails if the blocks are not those that were asked for
    done = rosafe("process", path, "--block", "1777", "--set", *settings, "--set", "in_doNormalize=0")
    assert done.returncode == 0, done
    parameters = {
        "pp_bNormalizeRMS": True,
        "fb_cfHz": [500.0, 1000.0],
        "ihc_method": "bernstein",
        "rm_wname": "hamming",
        "in_doNormalize": False,
    }
    expected = process(samples, 16000, parameters, 1777)
    assert not np.array_equal(expected["preProc"], process(samples, 16000, parameters, 1600)["preProc"])
    assert_equal(tmp_path / "in.npz", expected)
    with np.load(tmp_path / "in.npz") as loaded:
        told = json.loads(str(loaded["parameters"]))
        assert loaded["block_frames"] == 1777
    assert set(told) == {p.name for kind in KINDS.values() for p in kind.parameters}
    assert parameters.items() <= told.items()
    again = process(samples, 16000, told, 1777)
    for name, value in expected.items():
        np.testing.assert_array_equal(again[name], value)


def test_what_nobody_needs_is_not_there(tmp_path: Path) -> None:
    path = write(tmp_path / "in.wav", noise(4000))
    assert rosafe("process", path, "--outputs", "preProc").returncode == 0
    with np.load(tmp_path / "in.npz") as loaded:
        assert set(loaded) == {"preProc", *BESIDES}


@pytest.mark.parametrize("frames", [1, 100, 319, 320, 481, 12000, 12001])
def test_short_files(tmp_path: Path, frames: int) -> None:
    """Shorter than a window (of 320 frames), just one, not a whole number of hops, just a block."""
    samples = np.random.default_rng(frames).integers(-(2**31), 2**31, (2, frames)).astype(np.int32)
    path = write(tmp_path / "in.wav", samples, subtype="PCM_32")
    assert rosafe("process", path, *SMALL).returncode == 0
    assert_equal(tmp_path / "in.npz", process(samples, 16000, SMALL_PARAMETERS))


@pytest.mark.parametrize("settings", [["ild_hSizeSec=0.05"], ["cc_hSizeSec=0.0123", "cc_maxDelaySec=0.03"]])
def test_frames_that_do_not_overlap_or_divide(tmp_path: Path, settings: list[str]) -> None:
    samples = np.random.default_rng(8).integers(-(2**31), 2**31, (2, 9999)).astype(np.int32)
    path = write(tmp_path / "in.wav", samples, subtype="PCM_32")
    done = rosafe("process", path, "--block", "700", *SMALL, *settings)
    assert done.returncode == 0, done
    changes = {name: float(value) for name, value in (setting.split("=") for setting in settings)}
    parameters: dict[str, Any] = {**SMALL_PARAMETERS, **changes}
    assert_equal(tmp_path / "in.npz", process(samples, 16000, parameters, 700))


def test_the_recordings(tmp_path: Path) -> None:
    names = ["speech_anechoic_16k.wav", "speech_room_16k.wav"]
    paths = [shared("audio", name) for name in names]
    done = rosafe("process", *paths, "--outputs", "ild,crossCorrelation", "-o", f"{tmp_path}/", timeout=120)
    assert done.returncode == 0, done
    for path in paths:
        samples, rate = soundfile.read(path, dtype="int32")
        expected = process(np.ascontiguousarray(samples.T), rate, outputs=["ild", "crossCorrelation"])
        assert_equal(tmp_path / f"{path.stem}.npz", expected)


# --- several files, and where outputs go ---


@pytest.mark.parametrize("jobs", ["1", "2", "5"])
def test_several_files(tmp_path: Path, jobs: str) -> None:
    signals = {f"{n}.wav": noise(3000 + 500 * n, seed=n) for n in range(5)}
    for name, signal in signals.items():
        write(tmp_path / name, signal)
    done = rosafe("process", *signals, "--jobs", jobs, *SMALL, "--outputs", "ild", cwd=tmp_path)
    assert done.returncode == 0, done
    assert done.stdout == ""
    assert sorted(line.split(" ->")[0] for line in done.stderr.splitlines()) == sorted(signals)
    for name, signal in signals.items():
        expected = process(as_int32(signal), 16000, SMALL_PARAMETERS, outputs=["ild"])
        assert_equal((tmp_path / name).with_suffix(".npz"), expected)
    assert len(list(tmp_path.iterdir())) == 10


def test_one_bad_file_does_not_keep_the_others(tmp_path: Path) -> None:
    write(tmp_path / "a.wav", noise(3000))
    write(tmp_path / "b.wav", noise(3000)[:1])
    write(tmp_path / "c.wav", noise(3000))
    done = rosafe("process", "a.wav", "b.wav", "c.wav", "-q", *SMALL, cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr == "rosafe process: b.wav is mono (one channel); wanted are two: left and right ear\n"
    assert {path.name for path in tmp_path.glob("*.npz")} == {"a.npz", "c.npz"}


def test_input_files_may_follow_settings(tmp_path: Path) -> None:
    write(tmp_path / "a.wav", noise(3000))
    assert rosafe("process", "--quiet", *SMALL, "a.wav", cwd=tmp_path).returncode == 0
    assert (tmp_path / "a.npz").exists()


def test_quiet_is_quiet(tmp_path: Path) -> None:
    path = write(tmp_path / "a.wav", noise(3000))
    done = rosafe("process", path, "--quiet", *SMALL)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_output_file_is_replaced_where_it_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "a.wav", noise(3000))
    old, out = tmp_path / "old", tmp_path / "out"
    old.write_text("something")
    out.symlink_to(old)
    assert rosafe("process", path, *SMALL, "-o", out).returncode == 0
    assert out.is_symlink()
    with np.load(old) as loaded:
        assert "ild" in loaded


def test_outputs_in_a_folder(tmp_path: Path) -> None:
    path = write(tmp_path / "a.b.wav", noise(3000))
    (tmp_path / "results").mkdir()
    assert rosafe("process", path, *SMALL, "-o", tmp_path / "results").returncode == 0
    assert [path.name for path in (tmp_path / "results").iterdir()] == ["a.b.npz"]


def test_same_input_same_file(tmp_path: Path) -> None:
    path = write(tmp_path / "a.wav", noise(3000))
    for name in "xy":
        assert rosafe("process", path, *SMALL, "-o", tmp_path / name).returncode == 0
    assert (tmp_path / "x").read_bytes() == (tmp_path / "y").read_bytes()
    assert (tmp_path / "x").stat().st_mode & 0o777 == 0o666 & ~_umask()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
