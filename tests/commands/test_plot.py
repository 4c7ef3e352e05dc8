"""`rosafe plot`: pictures of sounds and results, and clear errors."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from rosafe.processing.files import process_file
from tests.commands.command import SMALL, noise, refused, rosafe, write
from tests.harness import shared


def size(path: Path) -> tuple[int, int]:
    """Return height and width of a picture, and assert that it is not blank."""
    picture = matplotlib.image.imread(path)
    assert len(np.unique((255 * picture).astype(np.uint8).reshape(-1, picture.shape[2]), axis=0)) > 20
    height, width, _ = picture.shape
    return height, width


def test_speech(tmp_path: Path) -> None:
    speech = shared("audio", "speech_anechoic_16k.wav")
    done = rosafe("plot", speech, "-o", tmp_path / "speech.png", "--set", "fb_highFreqHz=7200")
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr.startswith("rosafe plot: pi_rangeHz, ac_wSizeSec: ")
    height, width = size(tmp_path / "speech.png")
    assert height > 800 and width > 1000
    assert [path.name for path in tmp_path.iterdir()] == ["speech.png"]


def test_result_and_sound_give_the_same_picture(tmp_path: Path) -> None:
    sound = write(tmp_path / "sound.wav", noise(8000))
    outputs = ("--outputs", "gammatone,spectralFeatures,amsFeatures,precedence")
    assert rosafe("process", sound, *outputs, *SMALL).returncode == 0
    assert rosafe("plot", tmp_path / "sound.npz", "--at", "0.2").stderr == ""
    assert rosafe("plot", sound, "-o", tmp_path / "same.png", "--at", "0.2", *outputs, *SMALL).stderr == ""
    assert (tmp_path / "sound.png").read_bytes() == (tmp_path / "same.png").read_bytes()


def test_one_ear_at_8_khz(tmp_path: Path) -> None:
    """Outputs that compare two ears are left out, and there is one column."""
    mono = write(tmp_path / "mono.wav", noise(4000)[:1], 8000)
    done = rosafe("plot", mono, "--set", "pi_rangeHz=150,500")  # within the default window
    assert (done.returncode, done.stderr) == (0, "")
    height, width = size(tmp_path / "mono.png")
    assert 600 < width < 1000 < height + 200


def test_existing_pictures_are_kept(tmp_path: Path) -> None:
    sound = write(tmp_path / "sound.wav", noise(4000))
    (tmp_path / "sound.png").write_bytes(b"old")
    few = ("--outputs", "ild", *SMALL)
    refused(rosafe("plot", sound, *few), "sound.png already exists; --force replaces it")
    assert (tmp_path / "sound.png").read_bytes() == b"old"
    assert rosafe("plot", sound, "--force", *few).returncode == 0
    assert size(tmp_path / "sound.png")[0] > 100


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with sounds, a result, and files that are no results. No test changes it."""
    here = tmp_path_factory.mktemp("inputs")
    write(here / "sound.wav", noise(4000), 8000)
    write(here / "mono.wav", noise(4000)[:1])
    write(here / "three.wav", noise(4000)[[0, 1, 0]])
    np.savez(here / "other.npz", x=np.zeros(3))
    write(here / "16k.wav", noise(4000))
    process_file(here / "16k.wav", here / "result.npz", outputs=["ild"])
    return here


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["sound.wav", "--set", "fb_highFreqHz=8000"], ["fb_highFreqHz", "use at most 3800 Hz"]),
        (
            ["mono.wav", "--outputs", "ild"],
            ["outputs: expected representations of single ears for a signal with one ear, got ild"],
        ),
        (["three.wav"], ["expected one or two channels, got 3", "--channels"]),
        (["mono.wav", "-o", "sound.pdf"], ["-o: expected a name ending in .png, got sound.pdf"]),
        (["nothing.npz"], ["nothing.npz: No such file or directory"]),
        (["other.npz"], ["other.npz: expected a result of rosafe process, got a"]),
        (
            ["other.npz", "--set", "fb_nChannels=3"],
            ["--set: expected a sound, got a result, which already has its parameters"],
        ),
        (["result.npz", "--outputs", "itd"], ["outputs: expected outputs of the result", "got 'itd'"]),
    ],
)
def test_refusals(folder: Path, arguments: list[str], words: list[str]) -> None:
    before = sorted(folder.iterdir())
    refused(rosafe("plot", *arguments, cwd=folder), *words)
    assert sorted(folder.iterdir()) == before


def test_wrong_command_lines() -> None:
    refused(rosafe("plot"), "one sound file", code=2)
    refused(rosafe("plot", "a.wav", "b.wav"), "one sound file", code=2)
    refused(rosafe("plot", "a.wav", "--ear", "third"), "--ear", code=2)
    refused(
        rosafe("plot", "a.wav", "--output", "ild"), "--output", code=2
    )  # a mistyped --outputs does not create a picture "ild"


def test_numbers_are_limited(tmp_path: Path) -> None:
    for option, value in (("--at", "nan"), ("--at", "-1"), ("--channel", "1e308")):
        done = rosafe("plot", "sound.wav", option, value, cwd=tmp_path)
        assert done.returncode == 2 and f"{option}: expected a " in done.stderr and f"got '{value}'" in done.stderr
