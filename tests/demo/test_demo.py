"""Complete runs of scripts/demo: speech, telephone quality, and errors. test_readme.py runs the scene."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

from rosafe.demo import command
from tests.demo.conftest import SCENE_RATE, Learn
from tests.demo.running import DEMO_SECONDS, Demo, check_picture, check_table, demo, path
from tests.demo.test_sound import wav
from tests.harness import SCRIPTS, shared


def finished(running: Demo) -> str:
    """Wait for a successful end without remaining processes, and return the output."""
    assert running.wait(DEMO_SECONDS) == 0, running
    assert running.err == ""
    running.assert_gone()
    return running.out


@pytest.mark.exploration
def test_speech_without_home(tmp_path: Path, learn: Learn) -> None:
    """The shared speech is on the right until its end, except a rest that is shorter than a block.

    Another ROS graph of the user has no effect. Home directory, a folder for matplotlib and a terminal are not needed.
    """
    learn(16000)
    speech = tmp_path / "it's speech.wav"
    shutil.copy(shared("audio", "speech_anechoic_16k.wav"), speech)
    out, cache = tmp_path / "new" / "folder", tmp_path / "cache" / "rosafe"
    cache.mkdir(parents=True)
    (cache / "matplotlib").write_text("not a folder")
    for model in Path(os.environ["XDG_CACHE_HOME"], "rosafe").glob("head-*.npz"):
        os.link(model, cache / model.name)
    with demo(
        *(speech, "--out", out),
        HOME="/dev/null/none",
        XDG_CACHE_HOME=str(cache.parent),
        LC_ALL="C",
        ROS_MASTER_URI="http://192.0.2.1:11311",
        ROS_NAMESPACE="/elsewhere",
    ) as running:
        text = finished(running)
    check_table(text, 16000, 4000, 2.5)
    assert "\nthe last 0.14 s are shorter than a block of 4000 frames and are omitted\n" in text
    azimuths = np.array(path(text))
    assert azimuths.shape == (len(azimuths), 2) and (azimuths[:, 1] < -15).all()
    assert re.fullmatch(r"at 2\.\d s: estimate \d\d deg right \(confidence .*\)", text.splitlines()[-1])
    check_picture(out / "rosafe-demo.png")


@pytest.mark.exploration
def test_telephone_quality_until_ctrl_c(tmp_path: Path, learn: Learn) -> None:
    """At 8 kHz, the highest channel is lower than in the user guide. Ctrl-C before the figure ends the demo."""
    learn(8000)
    file = wav(tmp_path / "it's a call.wav", 8000, 2.2)
    with demo(file, "--out", tmp_path / "out") as running:
        running.wait_for_output("direction of the source")
        assert running.stop(signal.SIGINT) == 128 + signal.SIGINT
        assert running.err == ""
        running.assert_gone()
    assert "fb_highFreqHz 3600" in running.out and "fb_highFreqHz: 3600" in running.out
    check_table(running.out, 8000, 2000, 2.0)
    assert "\nthe last 0.20 s are shorter than a block of 2000 frames and are omitted\n" in running.out
    assert not (tmp_path / "out").exists()


@pytest.mark.exploration
def test_a_closed_output_pipe_ends_the_demo(tmp_path: Path, learn: Learn) -> None:
    """It is started through a symbolic link. When the reader of its output ends, all its processes end."""
    learn(SCENE_RATE)
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
    "arguments, reason, code",
    [
        (["missing.wav"], "missing.wav: No such file", 1),
        (["short.wav"], "too short", 1),
        (["--out", "short.wav"], "cannot write to short.wav", 1),
        (["--out", "/dev/null/there"], "cannot write to /dev/null/there", 1),
        (["--seconds", "nan"], "expected a number of seconds from 2 to 600, got 'nan'", 2),
    ],
)
def test_errors_are_one_line(arguments: list[str], reason: str, code: int, tmp_path: Path) -> None:
    """The other errors of the sound are in test_sound.py."""
    wav(tmp_path / "short.wav", seconds=0.1)
    before = sorted(tmp_path.rglob("*"))
    with demo(*arguments, cwd=tmp_path) as running:
        assert running.wait(DEMO_SECONDS) == code  # the first one may build the kernels
        assert len(running.err.splitlines()) == 1 and reason in running.err
        running.assert_gone()
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    "arguments, reason",
    [
        ([""], "got an empty text"),
        (["--seconds", "0"], "expected a number of seconds from 2 to 600, got '0'"),
        (["--seconds", "ten"], "expected a number of seconds from 2 to 600, got 'ten'"),
        (["--seconds", "1e9"], "expected a number of seconds from 2 to 600, got '1e9'"),
        (["scene:", "scene:"], "unrecognized arguments"),
        (["--sceonds", "3"], "unrecognized arguments"),
    ],
)
def test_wrong_command_lines(arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        command.main(arguments)
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and reason in error


@pytest.mark.exploration
def test_an_unknown_device_leaves_no_files(tmp_path: Path, learn: Learn) -> None:
    learn(SCENE_RATE)
    with demo("hw:77,7", "--out", tmp_path / "out") as running:
        assert running.wait(DEMO_SECONDS) == 1
        assert running.err.startswith("demo: /bass/Acquire failed: ::bass::e_device: ")
        assert "hw:77,7" in running.err and len(running.err.splitlines()) == 1
        running.assert_gone()
    assert not (tmp_path / "out").exists()


def test_the_help_lists_the_arguments() -> None:
    text = subprocess.run([SCRIPTS / "demo", "-h"], check=True, capture_output=True, text=True).stdout
    assert "[--seconds N] [--out DIR]" in text and "WAV or ALSA device" in text
