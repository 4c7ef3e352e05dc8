"""scripts/demo leaves no processes and files after signals at any stage, SIGKILL, or the crash of a node."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from tests.demo.conftest import Learn
from tests.demo.running import Demo, demo
from tests.demo.test_sound import wav
from tests.harness import ROOT, wait_for

STAGES = {
    "start": "starting bass-ros and rosAFE-ros",
    "requests": "rosservice call /rosAFE/GammatoneProc",
    "recording": "recording 7 ports",
}


@pytest.fixture
def sound(tmp_path: Path, learn: Learn) -> Path:
    """Return a file of sound at a low sample rate, which takes little computation."""
    learn(16000)
    return wav(tmp_path / "noise.wav", 16000, 12.0)


@pytest.mark.parametrize(
    "stage, number",
    [
        ("start", signal.SIGHUP),
        ("start", signal.SIGTERM),
        pytest.param("requests", signal.SIGTERM, marks=pytest.mark.exploration),
        pytest.param("recording", signal.SIGINT, marks=pytest.mark.exploration),
    ],
)
def test_signal(stage: str, number: signal.Signals, tmp_path: Path, sound: Path) -> None:
    """SIGINT during the requests is below; a later stage is in test_demo.py."""
    with demo(sound, "--out", tmp_path / "out") as running:
        running.wait_for_output(STAGES[stage])
        assert running.stop(number) == 128 + number
        assert running.err == ""
        running.assert_gone()
    assert not (tmp_path / "out").exists()


@pytest.mark.exploration
def test_repeated_ctrl_c_does_not_interrupt_the_clean_up(tmp_path: Path, sound: Path) -> None:
    """A terminal sends it repeatedly to the whole process group."""
    with demo(sound, "--out", tmp_path / "out") as running:
        running.wait_for_output(STAGES["requests"])
        for _ in range(50):
            os.killpg(running.pid, signal.SIGINT)
        assert running.wait() == 130
        assert running.err == ""
        running.assert_gone()


@pytest.mark.parametrize("stage", [pytest.param("start", marks=pytest.mark.exploration), "requests"])
def test_sigkill_also_ends_the_children(stage: str, tmp_path: Path, sound: Path) -> None:
    with demo(sound, "--out", tmp_path / "out", TMPDIR=str(tmp_path)) as running:
        running.wait_for_output(STAGES[stage])
        running.stop(signal.SIGKILL)
        running.assert_gone()


@pytest.mark.parametrize(
    "node, stage",
    [("bass-ros", "requests"), pytest.param("rosAFE-ros", "recording", marks=pytest.mark.exploration)],
)
def test_the_crash_of_a_node_ends_the_demo(node: str, stage: str, tmp_path: Path, sound: Path) -> None:
    with demo(sound, "--out", tmp_path / "out") as running:
        running.wait_for_output(STAGES[stage])
        victim = next(pid for pid, command in running.processes().items() if command.endswith(f"/{node} "))
        os.kill(victim, signal.SIGKILL)
        assert running.wait() == 1
        assert running.err.startswith(f"demo: {node} was killed by signal 9")
        running.assert_gone()
    assert not (tmp_path / "out").exists()


def checkout_with_install(tmp_path: Path, install: str, name: str = "demo") -> Path:
    """Create a checkout with another scripts/install and return its script `name`."""
    (tmp_path / "scripts").mkdir(parents=True)
    (tmp_path / "rosafe").symlink_to(ROOT / "rosafe")
    for file in (name, "checkout.sh"):
        shutil.copy(ROOT / "scripts" / file, tmp_path / "scripts")
    script = tmp_path / "scripts" / "install"
    script.write_text(f"#!/bin/bash\n{install}\n")
    script.chmod(0o755)
    return tmp_path / "scripts" / name


def test_ctrl_c_during_the_installation(tmp_path: Path) -> None:
    script = checkout_with_install(tmp_path, "echo installing; sleep 100; echo never")
    with Demo(script=script, cwd=tmp_path) as running:
        running.wait_for_output("installing")
        wait_for(lambda: any(command.startswith("sleep") for command in running.processes().values()))
        os.killpg(running.pid, signal.SIGINT)
        assert running.wait() == 130
        assert running.out == "installing\n"
        running.assert_gone()


def test_a_failed_installation_ends_the_demo(tmp_path: Path) -> None:
    script = checkout_with_install(tmp_path, "echo 'scripts/install: no network' >&2; exit 1")
    with Demo(script=script, cwd=tmp_path) as running:
        assert running.wait() == 1
        assert (running.out, running.err) == ("", "scripts/install: no network\n")


def test_help_installs_nothing(tmp_path: Path) -> None:
    for script, argument, example in (
        ("demo", "-h", "scripts/demo speech.wav"),
        ("demo", "--help", "scripts/demo speech.wav"),
        ("test", "--help", "scripts/test tests/web/genomix -k"),
    ):
        copy = checkout_with_install(tmp_path / script / argument, "echo installing; exit 1", script)
        done = subprocess.run([copy, argument], check=True, capture_output=True, text=True)
        assert example in done.stdout and "installing" not in done.stdout and done.stderr == ""
    assert len(done.stdout.splitlines()) <= 15, "one screen: seven options, the folders, two examples of scripts/test"


@pytest.mark.parametrize("arguments", [("--fast", "-h"), ("tests/dsp", "--help")])
def test_help_of_the_tests_with_other_options_installs_nothing(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    copy = checkout_with_install(tmp_path, "echo installing; exit 1", "test")
    done = subprocess.run([copy, *arguments], check=True, capture_output=True, text=True)
    assert done.stdout.startswith("usage: scripts/test") and done.stderr == ""


def test_the_help_of_the_tests_lists_their_folders() -> None:
    listed = subprocess.run(
        [ROOT / "scripts" / "test", "-h"], check=True, capture_output=True, text=True
    ).stdout.split()
    assert {path.parent.name for path in (ROOT / "tests").glob("*/test_*.py")} - set(listed) == set()
