"""scripts/demo: its sound, runs with files and devices, errors, signals, crashes. test_readme.py runs the scene."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import soundfile

from rosafe.commands import CommandError, demo
from rosafe.commands.demo import DemoSound, nearest
from rosafe.interface import ComponentError
from rosafe.localization import model_cache
from rosafe.ros1.client import whole_trees
from rosafe.tree.setups import read, write
from tests.audio.pulseaudio import PulseServer
from tests.demo.conftest import SCENE_RATE, Learn
from tests.demo.running import DEMO_SECONDS, RunningDemo, check_picture, check_table, check_walk, path
from tests.harness import ROOT, SCRIPTS, shared, wait_for

STAGES = {
    "start": "starting bass-ros and rosAFE-ros",
    "setup": "loading the setup",
    "recording": "recording 7 ports",
}


def wav(path: Path, sample_rate: int = 16000, seconds: float = 3.0) -> Path:
    """Write a file of noise."""
    samples = np.random.default_rng(0).normal(0, 0.1, (round(seconds * sample_rate), 2))
    soundfile.write(path, samples, sample_rate, subtype="PCM_16")
    return path


@pytest.fixture
def sound(tmp_path: Path, learn: Learn) -> Path:
    """Return a file of sound at a low sample rate, which takes little computation."""
    learn(16000)
    return wav(tmp_path / "noise.wav", 16000, 12.0)


# --- the sound ---


def test_scenes_files_and_devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    scene = DemoSound.of("scene:")
    assert scene[:2] == ("scene:", 44100)
    assert scene.setup.sound is not None and scene.setup.sound.explicit == {"device": "scene:"}
    file = wav(tmp_path / "my sound.wav", 8000, 2.2)
    file.with_suffix("").symlink_to(file)
    for argument in ("my sound.wav", "./my sound.wav", str(file), "my sound"):
        sound = DemoSound.of(argument)
        assert sound.sample_rate == 8000 and sound.device.startswith(f"file:{tmp_path}/my sound")
    explicit = {one.kind: one.explicit for one in read(write(sound.setup)).processors}
    assert explicit["gammatone"] == {"fb_highFreqHz": 3600.0} and explicit["input"] == {"nFramesPerBlock": 800}
    for name in ("hw:1,0", "plughw:CARD=PCH,DEV=0", "default", "pulse", "plug:'dmix:0'"):
        assert DemoSound.of(name) == (name, 44100, None)


def test_truth_of_several_sources() -> None:
    azimuths = [(30.0, 150.0), (-179.0,), ()]
    np.testing.assert_array_equal(nearest(azimuths, np.array([170.0, np.nan, 0.0])), [150.0, -179.0, np.nan])


# --- complete runs ---


@pytest.mark.exploration
def test_speech(tmp_path: Path, learn: Learn) -> None:
    """The shared speech is on the right until its end. Another ROS graph of the user has no effect."""
    learn(16000)
    speech = tmp_path / "it's speech.wav"
    shutil.copy(shared("audio", "speech_anechoic_16k.wav"), speech)
    with RunningDemo(
        speech, "--out", "new/folder", cwd=tmp_path, LC_ALL="C", ROS_MASTER_URI="http://192.0.2.1:1"
    ) as demo:
        demo.assert_ends(0)
    check_table(demo.out, 16000, 1600, 2.6)
    assert "it's speech.wav has ended\n" in demo.out
    assert (np.array(path(demo.out))[:, 1] < -15).all()
    check_picture(tmp_path / "new" / "folder" / "rosafe-demo.png")


@pytest.mark.exploration
def test_a_room(tmp_path: Path, learn: Learn) -> None:
    """The directions in the table are right in a room with a reverberation time of 0.4 s, too."""
    learn(SCENE_RATE)
    with RunningDemo("scene:?rt60=0.4", cwd=tmp_path) as demo:
        demo.assert_ends(0)
    check_walk(demo.out)
    check_picture(tmp_path / "rosafe-demo" / "rosafe-demo.png")


@pytest.mark.exploration
def test_an_unplugged_device(pulse: PulseServer, tmp_path: Path, learn: Learn) -> None:
    learn(SCENE_RATE)
    cache = model_cache.folder()
    env = {**pulse.env, "XDG_CACHE_HOME": str(cache.parent if cache else "")}
    with (
        pulse.play(wav(tmp_path / "noise.wav", SCENE_RATE, DEMO_SECONDS)),
        RunningDemo("pulse", "--seconds", "600", cwd=tmp_path, **env) as demo,
    ):
        demo.wait_for_output(STAGES["recording"])
        pulse.kill()
        demo.assert_ends(1, "rosafe demo: pulse: ")
    assert not (tmp_path / "rosafe-demo").exists()


# --- errors and ends ---


@pytest.mark.parametrize(
    "arguments, reason, code",
    [
        (["missing.wav"], "missing.wav: No such file", 1),
        (["no/such/x"], "No such file", 1),
        (["short.wav"], "short.wav: expected at least 1 s of sound, got 0.1 s", 1),
        (["scene:?speed=3"], "unknown option 'speed'", 1),
        (["--out", "short.wav"], "cannot write to short.wav", 1),
        (["hw:77,7"], "::bass::e_device: hw:77,7", 1),
        (["--seconds", "nan"], "expected a number of seconds from 2 to 600, got 'nan'", 2),
    ],
)
def test_errors_are_one_line(arguments: list[str], reason: str, code: int, tmp_path: Path) -> None:
    wav(tmp_path / "short.wav", seconds=0.1)
    before = sorted(tmp_path.rglob("*"))
    with RunningDemo(*arguments, cwd=tmp_path) as demo:
        demo.assert_ends(code, "rosafe demo: ")
        assert reason in demo.err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    "stage, number",
    [
        ("start", signal.SIGHUP),
        ("setup", signal.SIGTERM),
        pytest.param("recording", signal.SIGINT, marks=pytest.mark.exploration),
    ],
)
def test_signal(stage: str, number: signal.Signals, tmp_path: Path, sound: Path) -> None:
    """A terminal sends it repeatedly to the whole process group, until the end."""
    with RunningDemo(sound, cwd=tmp_path) as demo:
        demo.wait_for_output(STAGES[stage])
        demo.signal_until_end(number, os.killpg)
        demo.assert_ends(128 + number)
    assert stage == "recording" or STAGES["recording"] not in demo.out
    assert not (tmp_path / "rosafe-demo").exists()


def test_sigkill_also_ends_the_children(tmp_path: Path, sound: Path) -> None:
    with RunningDemo(sound, cwd=tmp_path, TMPDIR=str(tmp_path)) as demo:
        demo.wait_for_output(STAGES["setup"])
        demo.stop(signal.SIGKILL)
        wait_for(lambda: not demo.processes())


@pytest.mark.parametrize(
    "node, stage",
    [("bass-ros", "setup"), pytest.param("rosAFE-ros", "recording", marks=pytest.mark.exploration)],
)
def test_the_crash_of_a_node_ends_the_demo(node: str, stage: str, tmp_path: Path, sound: Path) -> None:
    with RunningDemo(sound, cwd=tmp_path) as demo:
        demo.wait_for_output(STAGES[stage])
        os.kill(next(pid for pid, command in demo.processes().items() if command.endswith(f"/{node} ")), signal.SIGKILL)
        demo.assert_ends(1, f"rosafe demo: {node} has ended: killed by signal 9")
    assert not (tmp_path / "rosafe-demo").exists()


def test_a_killed_node_is_named_although_its_connections_end_first(monkeypatch: pytest.MonkeyPatch) -> None:
    states: Iterator[list[Any]] = iter([[], [], []])  # processes that have ended, after the start and after the error

    class Launcher:
        async def start_node(self, *_: Any) -> object:
            return object()

        @property
        def ended(self) -> list[Any]:
            return next(states, [SimpleNamespace(name="bass", detail="killed by signal 9")])

    async def load(*_: Any, **__: Any) -> None:
        raise ComponentError("::genom::mwerr", what="/bass/getAcquisition: not a ROS node")

    monkeypatch.setattr(demo, "open_graph", contextlib.nullcontext)
    monkeypatch.setattr(whole_trees, "load", load)
    launcher: Any = Launcher()
    with pytest.raises(CommandError, match=r"^bass-ros has ended: killed by signal 9$"):
        asyncio.run(demo._run(launcher, DemoSound("scene:", 16000), 1.0, {}))


# --- the installation ---


def checkout_with_install(tmp_path: Path, install: str, name: str = "demo") -> Path:
    """Create a checkout with another scripts/install and return its script `name`."""
    (tmp_path / "scripts").mkdir(parents=True)
    (tmp_path / "rosafe").symlink_to(ROOT / "rosafe")
    for file in (name, "checkout.sh", "rosafe"):
        shutil.copy(SCRIPTS / file, tmp_path / "scripts")
    script = tmp_path / "scripts" / "install"
    script.write_text(f"#!/bin/bash\n{install}\n")
    script.chmod(0o755)
    return tmp_path / "scripts" / name


def test_ctrl_c_during_the_installation(tmp_path: Path) -> None:
    script = checkout_with_install(tmp_path, "echo installing; sleep 100; echo never")
    with RunningDemo(script=script, cwd=tmp_path) as demo:
        demo.wait_for_output("installing")
        wait_for(lambda: any(command.startswith("sleep") for command in demo.processes().values()))
        os.killpg(demo.pid, signal.SIGINT)
        demo.assert_ends(130)
        assert demo.out == "installing\n"


def test_a_failed_installation_ends_the_demo(tmp_path: Path) -> None:
    script = checkout_with_install(tmp_path, "echo 'scripts/install: no network' >&2; exit 1")
    with RunningDemo(script=script, cwd=tmp_path) as demo:
        demo.assert_ends(1, "scripts/install: no network")


@pytest.mark.parametrize(
    ("script", "arguments", "shown"),
    [
        ("demo", ["-h"], "scripts/demo speech.wav"),
        ("demo", ["--help"], "[--seconds N] [--out DIR]"),
        ("test", ["--help"], "scripts/test tests/web/genomix -k"),
        ("test", ["--fast", "-h"], "usage: scripts/test"),
    ],
)
def test_help_installs_nothing(script: str, arguments: list[str], shown: str, tmp_path: Path) -> None:
    copy = checkout_with_install(tmp_path, "echo installing; exit 1", script)
    done = subprocess.run([copy, *arguments], check=True, capture_output=True, text=True)
    assert shown in done.stdout and "installing" not in done.stdout and done.stderr == ""


def test_the_help_of_the_tests_lists_their_folders() -> None:
    listed = subprocess.run([SCRIPTS / "test", "-h"], check=True, capture_output=True, text=True).stdout.split()
    assert {path.parent.name for path in (ROOT / "tests").glob("*/test_*.py")} - set(listed) == set()
    assert len(" ".join(listed)) < 1500, "one screen"
