"""`rosafe process`: the numbers of `rosafe.process`, bit for bit, for all kinds of files; paths of the results."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rosafe import load, process
from rosafe.interface import CORE_REPRESENTATIONS
from tests.commands.command import SMALL, SMALL_PARAMETERS, as_int32, noise, rosafe, write

BESIDES = {"block_frames", "source"}
FRAMES = ["ild", "ratemap", "crossCorrelation"]
SEVEN = ("--outputs", ",".join(CORE_REPRESENTATIONS))


def assert_equal(path: Path, expected: dict[str, Any]) -> None:
    """Assert that the file contains exactly the results of `rosafe.process` and the additions of the command."""
    loaded = load(path)
    assert set(loaded) == {*expected, *BESIDES}
    for name, value in expected.items():
        np.testing.assert_array_equal(loaded[name], value, strict=isinstance(value, np.ndarray), err_msg=name)


def test_settings_and_blocks(tmp_path: Path) -> None:
    samples = np.random.default_rng(3).integers(-(2**30), 2**30, (2, 20000)).astype(np.int32)
    path = write(tmp_path / "in.wav", samples, 16000, "PCM_32")
    settings = ["pp_bNormalizeRMS=true", "fb_cfHz=500,1000", "ihc_method=bernstein", "rm_wname=hamming"]
    # gain control starts with the first block, so this comparison fails for other block lengths
    done = rosafe("process", path, "--block", "1777", "--set", *settings, "--set", "in_doNormalize=0", *SEVEN)
    assert done.returncode == 0, done
    parameters = {
        "pp_bNormalizeRMS": True,
        "fb_cfHz": [500.0, 1000.0],
        "ihc_method": "bernstein",
        "rm_wname": "hamming",
        "in_doNormalize": False,
    }
    expected = process(samples, 16000, parameters=parameters, block_frames=1777)
    other = process(samples, 16000, parameters=parameters, block_frames=1600)
    assert not np.array_equal(expected["preProc"], other["preProc"])
    assert_equal(tmp_path / "in.npz", expected)


def test_framed_outputs_are_the_default_and_are_named(tmp_path: Path) -> None:
    path = write(tmp_path / "in.wav", noise(4000))
    done = rosafe("process", path, *SMALL)
    assert done.returncode == 0 and "; ild, ratemap, crossCorrelation (see --outputs)\n" in done.stderr
    expected = process(as_int32(noise(4000)), 16000, parameters=SMALL_PARAMETERS, outputs=FRAMES)
    assert_equal(tmp_path / "in.npz", expected)


# --- several files and the paths of their results ---


@pytest.mark.parametrize("jobs", ["1", "5"])
def test_several_files(tmp_path: Path, jobs: str) -> None:
    signals = {f"{n}.wav": noise(3000 + 500 * n, seed=n) for n in range(5)}
    for name, signal in signals.items():
        write(tmp_path / name, signal)
    done = rosafe("process", *signals, "--jobs", jobs, *SMALL, "--outputs", "ild", cwd=tmp_path)
    assert done.returncode == 0, done
    assert done.stdout == ""
    assert done.stderr.startswith("5 files: 5 done; 1.2 s of sound, ") and done.stderr.count("\n") == 1
    for name, signal in signals.items():
        expected = process(as_int32(signal), 16000, parameters=SMALL_PARAMETERS, outputs=["ild"])
        assert_equal((tmp_path / name).with_suffix(".npz"), expected)
    assert len(list(tmp_path.iterdir())) == 10


def test_input_files_may_follow_settings_and_quiet_is_quiet(tmp_path: Path) -> None:
    write(tmp_path / "a.wav", noise(3000))
    done = rosafe("process", "--quiet", *SMALL, "a.wav", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "a.npz").exists()


def test_an_output_that_is_named_is_replaced(tmp_path: Path) -> None:
    path = write(tmp_path / "a.wav", noise(3000))
    old, out = tmp_path / "old", tmp_path / "out.npz"
    old.write_text("something")
    out.symlink_to(old)
    assert rosafe("process", path, *SMALL, "-o", out).returncode == 0
    assert out.is_symlink()
    with np.load(old) as loaded:
        assert "ild" in loaded


def test_outputs_in_a_new_folder(tmp_path: Path) -> None:
    """As in `rosafe process *.wav -o results/`."""
    write(tmp_path / "a.wav", noise(3000))
    write(tmp_path / "mono.wav", noise(3000)[:1])
    assert rosafe("process", "a.wav", "mono.wav", *SMALL, "-o", "results/", cwd=tmp_path).returncode == 1
    assert {path.name for path in (tmp_path / "results").iterdir()} == {"a.npz", "failed.csv"}
    assert rosafe("process", "mono.wav", *SMALL, "-o", "others/", cwd=tmp_path).returncode == 1
    assert [path.name for path in (tmp_path / "others").iterdir()] == ["failed.csv"]
    done = rosafe("process", "a.wav", *SMALL, "-o", "deep/er/", cwd=tmp_path)
    assert done.returncode == 0 and (tmp_path / "deep" / "er" / "a.npz").exists(), done


def test_same_input_same_file(tmp_path: Path) -> None:
    path = write(tmp_path / "a.wav", noise(3000))
    for name in ("x.npz", "y.npz"):
        assert rosafe("process", path, *SMALL, "-o", tmp_path / name).returncode == 0
    assert (tmp_path / "x.npz").read_bytes() == (tmp_path / "y.npz").read_bytes()
    assert (tmp_path / "x.npz").stat().st_mode & 0o777 == 0o666 & ~_umask()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
