"""scripts/demo: its sound, runs with files and devices, errors, signals, crashes. test_readme.py runs the scene."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
import soundfile
import yaml

from rosafe.commands.demo import DemoSound, choose, command_line, nearest_source, requests, true_azimuths
from rosafe.localization import model_cache
from rosafe.localization.scene import Truth
from tests.audio.pulseaudio import PulseServer
from tests.demo.conftest import SCENE_RATE, Learn
from tests.demo.running import DEMO_SECONDS, Demo, check_picture, check_table, check_walk, path
from tests.harness import ROOT, SCRIPTS, shared, wait_for

STAGES = {
    "start": "starting bass-ros and rosAFE-ros",
    "requests": "rosservice call /rosAFE/GammatoneProc",
    "recording": "recording 7 ports",
}


def wav(path: Path, sample_rate: int = 16000, seconds: float = 3.0, channels: int = 2) -> Path:
    """Write a file of noise."""
    samples = np.random.default_rng(0).normal(0, 0.1, (round(seconds * sample_rate), channels))
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
    scene = choose("scene:", 10.0)
    assert (scene.device, scene.sample_rate, scene.seconds, scene.block) == ("scene:", 44100, 10.0, 12000)
    assert [scene.source.truth(time).azimuths for time in (0.0, 5.0, 10.0)] == [(90.0,), (0.0,), (-90.0,)]
    assert choose("scene:?rt60=0.4", 10.0).title == "A source moves from left to right in a room"
    two = "{sample_rate: 16000, duration: 3, sources: [{name: a, signal: noise, azimuth: 30, end: 2}]}"
    Path("two.yaml").write_text(two)
    scene = choose("scene:two.yaml", 10.0)
    assert (scene.sample_rate, scene.seconds, scene.title) == (16000, 3.0, "two.yaml")
    path = wav(tmp_path / "my sound.wav", 8000, 2.2)
    path.with_suffix("").symlink_to(path)
    for argument in ("my sound.wav", "./my sound.wav", str(path), "my sound"):
        file = choose(argument, 10.0)
        assert (file.sample_rate, file.seconds, file.block) == (8000, 2.0, 2000)
        assert file.device.startswith(f"file:{tmp_path}/my sound")
    assert dict(step[1:] for step in requests(file))["GammatoneProc"]["fb_highFreqHz"] == 3600
    for name in ("hw:1,0", "plughw:CARD=PCH,DEV=0", "default", "pulse", "plug:'dmix:0'"):
        assert choose(name, 10.0) == DemoSound(name, name, 44100, 10.0)


def test_commands_can_be_copied_to_a_shell() -> None:
    """Names with quotes and spaces reach rosservice unchanged."""
    for device in ("scene:", "file:/tmp/it's a file.wav", 'file:/a "b" $c `d` \\e!.wav', "file:/ü/{x}, y: z"):
        for node, service, arguments in requests(DemoSound(device, "x", 44100, 10.0)):
            *command, text = shlex.split(command_line(node, service, arguments))
            assert command == ["rosservice", "call", f"/{node}/{service}"] and yaml.safe_load(text) == arguments


def test_truth_of_several_sources() -> None:
    def truth(time: float) -> Truth:
        return Truth(0.0, *((("a", "b"), (30.0, 150.0)) if time < 1 else (("b",), (-179.0,))))

    series = true_azimuths(truth, np.array([0.0, 1.0]), folded=False)
    np.testing.assert_array_equal([series["a"], series["b"]], [[30.0, np.nan], [150.0, -179.0]])
    np.testing.assert_array_equal(true_azimuths(truth, np.array([0.0, 1.0]), folded=True)["b"], [30.0, -1.0])
    names, azimuths = nearest_source(np.array([170.0, 170.0]), series)
    assert names.tolist() == ["b", "b"] and azimuths.tolist() == [150.0, -179.0]
    assert nearest_source(np.array([40.0, np.nan]), series)[0].tolist() == ["a", "b"]


# --- complete runs ---


@pytest.mark.exploration
def test_speech(tmp_path: Path, learn: Learn) -> None:
    """The shared speech is on the right until its end. Another ROS graph of the user has no effect."""
    learn(16000)
    speech = tmp_path / "it's speech.wav"
    shutil.copy(shared("audio", "speech_anechoic_16k.wav"), speech)
    with Demo(speech, "--out", "new/folder", cwd=tmp_path, LC_ALL="C", ROS_MASTER_URI="http://192.0.2.1:1") as demo:
        demo.assert_ends(0)
    check_table(demo.out, 16000, 4000, 2.5)
    assert "the last 0.14 s are shorter than a block of 4000 frames and are omitted\n" in demo.out
    assert (np.array(path(demo.out))[:, 1] < -15).all()
    check_picture(tmp_path / "new" / "folder" / "rosafe-demo.png")


@pytest.mark.exploration
def test_a_room(tmp_path: Path, learn: Learn) -> None:
    """The directions in the table are right in a room with a reverberation time of 0.4 s, too."""
    learn(SCENE_RATE)
    with Demo("scene:?rt60=0.4", cwd=tmp_path) as demo:
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
        Demo("pulse", "--seconds", "600", cwd=tmp_path, **env) as demo,
    ):
        demo.wait_for_output("dB\n")
        pulse.kill()
        demo.assert_ends(1, "rosafe demo: pulse: ")
    assert "from the beginning" not in demo.out and not (tmp_path / "rosafe-demo").exists()


# --- errors and ends ---


@pytest.mark.parametrize(
    "arguments, reason, code",
    [
        (["missing.wav"], "missing.wav: No such file", 1),
        (["no/such/x"], "No such file", 1),
        (["short.wav"], "too short", 1),
        (["mono.wav"], "2 channels, got 1", 1),
        (["scene:?speed=3"], "unknown option 'speed'", 1),
        (["--out", "short.wav"], "cannot write to short.wav", 1),
        (["hw:77,7"], "/bass/Acquire failed: ::bass::e_device: hw:77,7", 1),
        ([""], "got an empty text", 2),
        (["--seconds", "nan"], "expected a number of seconds from 2 to 600, got 'nan'", 2),
        (["--sceonds", "3"], "unrecognized arguments", 2),
    ],
)
def test_errors_are_one_line(arguments: list[str], reason: str, code: int, tmp_path: Path) -> None:
    wav(tmp_path / "short.wav", seconds=0.1)
    wav(tmp_path / "mono.wav", channels=1)
    before = sorted(tmp_path.rglob("*"))
    with Demo(*arguments, cwd=tmp_path) as demo:
        demo.assert_ends(code, "rosafe demo: ")
        assert reason in demo.err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    "stage, number",
    [
        ("start", signal.SIGHUP),
        ("requests", signal.SIGTERM),
        pytest.param("recording", signal.SIGINT, marks=pytest.mark.exploration),
    ],
)
def test_signal(stage: str, number: signal.Signals, tmp_path: Path, sound: Path) -> None:
    """A terminal sends it repeatedly to the whole process group."""
    with Demo(sound, cwd=tmp_path) as demo:
        demo.wait_for_output(STAGES[stage])
        for _ in range(20):
            os.killpg(demo.pid, number)
        demo.assert_ends(128 + number)
    assert not (tmp_path / "rosafe-demo").exists()


def test_sigkill_also_ends_the_children(tmp_path: Path, sound: Path) -> None:
    with Demo(sound, cwd=tmp_path, TMPDIR=str(tmp_path)) as demo:
        demo.wait_for_output(STAGES["requests"])
        demo.stop(signal.SIGKILL)
        wait_for(lambda: not demo.processes())


@pytest.mark.parametrize(
    "node, stage",
    [("bass-ros", "requests"), pytest.param("rosAFE-ros", "recording", marks=pytest.mark.exploration)],
)
def test_the_crash_of_a_node_ends_the_demo(node: str, stage: str, tmp_path: Path, sound: Path) -> None:
    with Demo(sound, cwd=tmp_path) as demo:
        demo.wait_for_output(STAGES[stage])
        os.kill(next(pid for pid, command in demo.processes().items() if command.endswith(f"/{node} ")), signal.SIGKILL)
        demo.assert_ends(1, f"rosafe demo: {node} has ended: killed by signal 9")
    assert not (tmp_path / "rosafe-demo").exists()


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
    with Demo(script=script, cwd=tmp_path) as demo:
        demo.wait_for_output("installing")
        wait_for(lambda: any(command.startswith("sleep") for command in demo.processes().values()))
        os.killpg(demo.pid, signal.SIGINT)
        demo.assert_ends(130)
        assert demo.out == "installing\n"


def test_a_failed_installation_ends_the_demo(tmp_path: Path) -> None:
    script = checkout_with_install(tmp_path, "echo 'scripts/install: no network' >&2; exit 1")
    with Demo(script=script, cwd=tmp_path) as demo:
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
