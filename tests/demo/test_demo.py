"""scripts/demo from end to end: speech, telephone quality, and what must be refused. test_readme.py runs the scene."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.demo.running import DEMO_SECONDS, Demo, check_picture, check_table, demo, path
from tests.demo.test_sound import wav
from tests.harness import SCRIPTS, shared


def finished(running: Demo) -> str:
    """What it printed, once it has ended well and left nothing."""
    assert running.wait(DEMO_SECONDS) == 0, running
    assert running.err == ""
    running.assert_gone()
    return running.out


def test_speech(tmp_path: Path) -> None:
    """The shared speech, through bass-ros and rosAFE-ros: both cues say right, all of it, to its end.

    The graph that the user works on is another.
    """
    speech = shared("audio", "speech_anechoic_16k.wav")
    out = tmp_path / "new" / "folder"
    with demo(speech, "--out", out, ROS_MASTER_URI="http://192.0.2.1:11311", ROS_NAMESPACE="/elsewhere") as running:
        text = finished(running)
    check_table(text, 16000, 4000, 2.5)
    course = np.array(path(text))
    assert (course[:, 1:3] > 15).all()
    assert np.abs(course[:, 1] - course[:, 2]).max() < 10
    check_picture(out / "rosafe-demo.png")


def test_telephone_quality_without_home(tmp_path: Path) -> None:
    """8 kHz is too low for the guide's channels; no home and no terminal are no hindrance."""
    file = wav(tmp_path / "it's a call.wav", 8000, 2.2)
    with demo(file, "--out", tmp_path, HOME="/dev/null/none", XDG_CACHE_HOME="", LC_ALL="C") as running:
        text = finished(running)
    assert "fb_highFreqHz 3600" in text and "fb_highFreqHz: 3600" in text
    check_table(text, 8000, 2000, 2.0)
    assert "\nits last 0.20 s fill no block of 2000 frames, and are left out\n" in text


def test_through_a_link_with_a_dead_reader(tmp_path: Path) -> None:
    """A reader that goes away ends it, and everything that it has started."""
    link = tmp_path / "show"
    link.symlink_to(SCRIPTS / "demo")
    running = Demo("--out", tmp_path / "out", cwd=tmp_path, script=Path("/bin/sh"))
    running.close()
    reader, writer = os.pipe()
    process = subprocess.Popen(
        [str(link), "--out", str(tmp_path / "out")],
        stdout=writer,
        stderr=subprocess.PIPE,
        env={**os.environ, running.mark: "1"},
        text=True,
    )
    os.close(writer)
    with os.fdopen(reader) as stream:
        while "Acquire" not in stream.readline():
            pass
    _, err = process.communicate(timeout=DEMO_SECONDS)
    assert process.returncode == 1 and err == ""
    running.assert_gone()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "arguments, why, code",
    [
        (["missing.wav"], "missing.wav: No such file", 1),
        (["mono.wav"], "1 channel, two are needed", 1),
        (["short.wav"], "too short", 1),
        (["scene:?speed=2"], "no option 'speed'", 1),
        (["--out", "mono.wav"], "cannot write to mono.wav", 1),
        (["--out", "/dev/null/there"], "cannot write to /dev/null/there", 1),
        ([""], "it is empty", 2),
        (["--seconds", "0"], "'0' is no number of seconds from 2 to 600", 2),
        (["--seconds", "nan"], "'nan' is no number of seconds", 2),
        (["--seconds", "ten"], "'ten' is no number of seconds", 2),
        (["--seconds", "1e9"], "'1e9' is no number of seconds", 2),
        (["scene:", "scene:"], "unrecognized arguments", 2),
        (["--sceonds", "3"], "unrecognized arguments", 2),
    ],
)
def test_refused_in_one_line(arguments: list[str], why: str, code: int, tmp_path: Path) -> None:
    wav(tmp_path / "mono.wav", channels=1)
    wav(tmp_path / "short.wav", seconds=0.1)
    before = sorted(tmp_path.rglob("*"))
    with demo(*arguments, cwd=tmp_path) as running:
        assert running.wait() == code
        assert len(running.err.splitlines()) == 1 and why in running.err
        running.assert_gone()
    assert sorted(tmp_path.rglob("*")) == before


def test_unknown_device_says_so_and_leaves_nothing(tmp_path: Path) -> None:
    with demo("hw:77,7", "--out", tmp_path / "out") as running:
        assert running.wait(DEMO_SECONDS) == 1
        assert running.err.startswith("demo: /bass/Acquire was refused: ::bass::e_device: ")
        assert "hw:77,7" in running.err and len(running.err.splitlines()) == 1
        running.assert_gone()
    assert not (tmp_path / "out").exists()


def test_help_names_the_arguments() -> None:
    text = subprocess.run([SCRIPTS / "demo", "-h"], check=True, capture_output=True, text=True).stdout
    assert "[--seconds N] [--out DIR]" in text and "WAV or ALSA device" in text
