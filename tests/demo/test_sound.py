"""Interpretation of the audio argument, and errors that are detected before the start."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile

from rosafe.audio.files.audiofile import AudioFileError
from rosafe.demo import session
from rosafe.demo.sound import DemoSound, choose
from rosafe.interface import ComponentError


def wav(path: Path, sample_rate: int = 16000, seconds: float = 3.0, channels: int = 2) -> Path:
    """Write a file of noise."""
    samples = np.random.default_rng(0).normal(0, 0.1, (round(seconds * sample_rate), channels))
    soundfile.write(path, samples, sample_rate, subtype="PCM_16")
    return path


def test_the_defaults_are_those_of_the_user_guide() -> None:
    sound = choose("scene:")
    assert (sound.device, sound.requested_rate, sound.sample_rate) == ("scene:", 44100, 44100)
    assert (sound.frames_per_block, sound.frames_per_chunk, sound.max_frequency) == (12000, 2205, 8000)
    assert sound.truth is not None and sound.head is None
    assert [sound.truth(time) for time in (0.0, 5.0, 10.0)] == [(0.0, ("talker",), (a,)) for a in (90.0, 0.0, -90.0)]


def test_scene_with_options() -> None:
    sound = choose("scene:?level=-20&seconds=4")
    assert sound.truth is not None and sound.truth(4.0).azimuths == (-90.0,)


def test_a_scene_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "two.yaml"
    path.write_text(
        "{sample_rate: 16000, duration: 3, sources: [{name: a, signal: noise, azimuth: 30, end: 2}, "
        "{name: b, signal: tone, frequency: 500, azimuth: -100}]}"
    )
    sound = choose(f"scene:{path}")
    assert (sound.requested_rate, sound.sample_rate, sound.length, sound.title) == (0, 16000, 3.0, "two.yaml")
    assert sound.note == "sources: a, b; head: sphere" and sound.head is not None and sound.head.front_back_equal
    assert sound.truth is not None and sound.truth(1.0).azimuths == (30.0, -100.0) and sound.truth(2.5).names == ("b",)


def test_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = wav(tmp_path / "my sound.wav")
    monkeypatch.chdir(tmp_path)
    for argument in ("my sound.wav", "./my sound.wav", str(path)):
        sound = choose(argument)
        assert (sound.device, sound.requested_rate, sound.sample_rate) == (f"file:{path}", 0, 16000)
        assert (sound.title, sound.truth, sound.max_frequency) == ("my sound.wav", None, 8000)
        assert sound.seconds_to_follow(10) == 3.0 and sound.seconds_to_follow(2) == 2


def test_low_sample_rate_lowers_the_highest_channel(tmp_path: Path) -> None:
    sound = choose(str(wav(tmp_path / "telephone.wav", 8000)))
    assert sound.max_frequency == 3600 and "fb_highFreqHz 3600" in sound.note
    assert dict(session.requests(sound))["/rosAFE/GammatoneProc"]["fb_highFreqHz"] == 3600


def test_an_existing_file_may_have_any_suffix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wav(tmp_path / "sound.wav").rename(tmp_path / "default")
    monkeypatch.chdir(tmp_path)
    assert choose("default").device == f"file:{tmp_path}/default"


@pytest.mark.parametrize("name", ["hw:1,0", "plughw:CARD=PCH,DEV=0", "default", "pulse", "plug:'dmix:0'"])
def test_other_arguments_are_devices(name: str) -> None:
    sound = choose(name)
    assert (sound.device, sound.requested_rate, sound.has_beginning) == (name, 44100, False)


@pytest.mark.parametrize(
    "argument, reason",
    [
        ("missing.wav", "No such file"),
        ("no/such/folder/x", "No such file"),
        ("mono.wav", "2 channels, got 1"),
        ("empty.wav", "expected a sound file, got an empty file"),
        ("text.wav", "expected a sound file, got another file"),
        ("folder/", "regular file"),
        ("file:missing", "No such file"),
        ("scene:?speed=3", "unknown option 'speed'"),
        ("scene:fast", "question mark"),
    ],
)
def test_errors_are_one_line(argument: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    wav(tmp_path / "mono.wav", channels=1)
    (tmp_path / "empty.wav").touch()
    (tmp_path / "text.wav").write_text("no sound")
    (tmp_path / "folder").mkdir()
    with pytest.raises((AudioFileError, ComponentError), match=reason) as error:
        choose(argument)
    assert "\n" not in str(error.value)


def test_commands_can_be_copied_to_a_shell() -> None:
    """Names with quotes and spaces reach rosservice unchanged."""
    import shlex

    import yaml

    for device in (
        "scene:",
        "file:/tmp/it's a file.wav",
        'file:/tmp/a "b" $c `d` \\e!.wav',
        "hw:1,0",
        "file:/ü/{x}, y: z",
    ):
        sound = DemoSound(device, 0, 44100, "x")
        for service, arguments in session.requests(sound):
            command = session.command_line(service, arguments)
            assert shlex.split(session.shell_command(command)) == command
            assert command[:3] == ["rosservice", "call", service]
            assert yaml.safe_load(command[3]) == arguments
