"""`rosafe up`: one command starts all processes, and Ctrl-C ends exactly these; roslaunch and systemd."""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest
import yaml

from rosafe.commands import up
from rosafe.ros1.transport.master import MasterError, check_master
from rosafe.tree.setups import Setup
from tests import models
from tests.harness import ROOT, SCRIPTS, Graph, MasterProcess, Process, free_port, run_program, wait_for
from tests.terminal import Terminal

SETUP = """
sound: {device: "scene:"}
processors:
  input: {kind: input, nFramesPerBlock: 4410}
  preProc: {kind: preProc, parent: input}
"""


@pytest.fixture
def alone(tmp_path: Path) -> Graph:
    """A ROS graph without a running master."""
    return Graph(f"http://127.0.0.1:{free_port()}", tmp_path)


def answers(uri: str) -> bool:
    try:
        check_master(uri)
    except MasterError:
        return False
    return True


def wait_until(process: Process, text: str) -> None:
    wait_for(lambda: re.search(text, process.out) or not process.alive, what=lambda: f"{text!r} of {process}")
    assert re.search(text, process.out), process


def test_start_and_end_of_all_processes(alone: Graph, tmp_path: Path) -> None:
    file = tmp_path / "tree.yaml"
    file.write_text(SETUP)
    keep = tmp_path / "kept.yaml"
    for again in (False, True):
        port = free_port()
        command = ("rosafe", "up", str(file), "--port", str(port), "--keep", str(keep))
        with alone.start(*command) as running:
            wait_until(running, "Press Ctrl-C")
            wait_until(running, f"setup +loaded +{file}: {0 if again else 2} created")
            wait_until(running, "rosAFE +runs +2 processors")  # restored from the saved tree the second time
            wait_until(running, "bass +runs +acquires from scene:")
            assert f"http://127.0.0.1:{port}" in running.out
            assert {"/bass", "/rosAFE"} <= alone.nodes()
            if again:
                os.kill(running.pid, signal.SIGKILL)
                running.wait()
            else:
                assert running.signal_until_end(signal.SIGINT) == 0 and not answers(alone.uri), running
            wait_for(lambda: not answers(alone.uri), what="the end of the master")


def test_running_processes_are_kept(tmp_path: Path) -> None:
    master = MasterProcess()
    graph = Graph(master.uri, tmp_path)
    file = tmp_path / "tree.yaml"
    file.write_text(SETUP.replace("scene:", "file:/nowhere.wav"))
    try:
        master.start(graph.env)
        with (
            graph.node("bass-ros") as bass,
            graph.start("rosafe", "up", str(file), "--port", str(free_port())) as running,
        ):
            wait_until(running, "roscore +runs .*was there")
            wait_until(running, "bass +runs .*was there")
            wait_until(running, "setup +refused +::bass::e_device")
            assert running.stop(signal.SIGINT) == 1
            assert bass.alive
            assert "/rosAFE/Stop" not in graph.services()
            assert graph.run("rosservice", "call", "/bass/Stop", "{}").stdout.startswith("genom_success: True")
    finally:
        master.kill()


@pytest.mark.exploration
def test_the_localizer_of_a_setup(alone: Graph, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    """It gets the settings of the setup, and uses its input. The device and the file for the head are also options."""
    head = tmp_path / "robot.head"
    models.learn(tmp_path_factory, 44100.0).save(head)
    file = tmp_path / "robot.yaml"
    file.write_text(SETUP.partition("  preProc")[0] + "localizer: {seconds: 0.25, head_frame: ears, head: no.head}\n")
    command = (
        "rosafe",
        "up",
        str(file),
        "--port",
        str(free_port()),
        "--device",
        "scene:?seconds=3",
        "--head",
        str(head),
    )
    with alone.start(*command) as running:
        wait_until(running, "localizer +runs +head: .*robot")
        wait_until(running, r"bass +runs +acquires from scene:\?seconds=3")
        wait_until(running, "rosAFE +runs +[2-9] processors")  # also those of the localizer
        assert {"/bass", "/rosAFE", "/localizer"} <= alone.nodes()
        parameters = yaml.safe_load(alone.run("rosparam", "get", "/localizer").stdout)
        assert {name: value for name, value in parameters.items() if name != "created"} == {
            "head": str(head),
            "head_frame": "ears",
            "seconds": 0.25,
        }
        assert running.stop(signal.SIGINT) == 0, running


@pytest.mark.parametrize(
    ("arguments", "settings"),
    [
        ([], None),
        (["--localize"], {}),
        (["--head", "robot.head"], {"head": os.path.abspath("robot.head")}),
        (["--head", "a.sofa", "--no-mirror"], {"head": os.path.abspath("a.sofa"), "mirror": False}),
        (["--mirror"], {"mirror": True}),
    ],
)
def test_the_localizer_without_a_setup(arguments: list[str], settings: dict[str, Any] | None) -> None:
    parser = argparse.ArgumentParser()
    up.configure(parser)
    options = parser.parse_args(arguments)
    assert up._localizer_settings(options, None) == settings
    of_setup = {"head": "b.sofa", "mirror": True, "seconds": 0.25}
    kept = {"seconds": 0.25} if options.head else of_setup  # the mirror of a setup is that of its head
    assert up._localizer_settings(options, Setup(localizer=of_setup)) == {**kept, **(settings or {})}


def test_a_faulty_setup_starts_no_process(alone: Graph, tmp_path: Path) -> None:
    file = tmp_path / "tree.yaml"
    file.write_text("processors:\n  a: {kind: nothing}\n")
    done = alone.run("rosafe", "up", str(file), check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert f"{file}, line 2: " in done.stderr
    assert not answers(alone.uri)
    far = alone.run("rosafe", "up", check=False, ROS_MASTER_URI="http://192.0.2.1:11311")
    assert far.returncode == 1
    assert "start roscore on that machine" in far.stderr


@pytest.mark.exploration
def test_a_killed_process_is_reported(alone: Graph) -> None:
    """On a terminal, which shows one screen. The URL of the page is complete, although it is wider than the screen."""
    command = ["rosafe", "up", "--live", "--no-browser", "--port", str(free_port()), "--live-port", str(free_port())]
    with Terminal(command, alone.env, columns=80) as running:
        running.expect("Press Ctrl-C")
        assert re.search(r"\?token=[\w-]{43}\r?\n", running.sent), running.sent
        done = alone.run("rosnode", "info", "/bass")
        os.kill(int(re.findall(r"Pid: (\d+)", done.stdout)[0]), signal.SIGKILL)
        running.expect("killed by signal 9\n")
        running.press("\x03", "ending the processes")
        assert running.end() == 1
        *_, before, last = re.split(r"\x1b\[(?=\d+F)", running.sent)
        lines = before.partition("\x1b[J")[2].replace("\r", "").replace("^C", "").splitlines()
        assert len(lines) == 6 and f"{len(lines) + 1}F" == last.partition("\x1b")[0], (
            running.sent
        )  # the URL takes two lines


def test_roslaunch_starts_the_localizer(alone: Graph) -> None:
    arguments = ("rosAFE", "rosafe.launch", "localize:=true", "head:=/tmp/robot.head", "seconds:=1")
    assert "localize --wait __name:=localizer" in alone.run("roslaunch", "--args", "/localizer", *arguments).stdout
    parameters = yaml.safe_load(alone.run("roslaunch", "--dump-params", *arguments).stdout)
    assert {name: value for name, value in parameters.items() if name.startswith("/localizer/")} == {
        "/localizer/head": "/tmp/robot.head",
        "/localizer/mirror": "",
        "/localizer/seconds": 1.0,
        "/localizer/world_frame": "",
    }
    mirrored = alone.run("roslaunch", "--dump-params", *arguments, "mirror:=false").stdout
    assert yaml.safe_load(mirrored)["/localizer/mirror"] is False


@pytest.mark.parametrize("live", ["true", "false"])
def test_roslaunch_starts_all_processes(alone: Graph, live: str) -> None:
    arguments = ("rosAFE", "rosafe.launch", "setup:=/tmp/tree.yaml", "keep:=/tmp/kept.yaml", f"live:={live}", "port:=9")
    nodes = alone.run("roslaunch", "--nodes", *arguments).stdout.split()
    assert sorted(nodes) == sorted(
        ["/bass", "/rosAFE", "/genomixd", "/rosafe_setup", *(["/rosafe_live"] if live == "true" else [])]
    )


def test_roslaunch_loads_the_setup(alone: Graph) -> None:
    arguments = ("rosAFE", "rosafe.launch", "setup:=/tmp/tree.yaml", "keep:=/tmp/kept.yaml", "port:=9")
    line = alone.run("roslaunch", "--args", "/rosafe_setup", *arguments).stdout
    assert "setup load --wait 60 --keep /tmp/kept.yaml -- /tmp/tree.yaml __name:=rosafe_setup" in line
    assert str(SCRIPTS) in str(Path(line.split()[0]).resolve())
    assert alone.run("rosafe", "--version", "__name:=x", "__log:=/tmp/y").stdout.startswith("rosafe ")


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze here")
@pytest.mark.parametrize("kind", ["system", "user"])
def test_systemd_accepts_the_units(kind: str, tmp_path: Path) -> None:
    units = []
    for path in sorted((ROOT / "systemd" / kind).iterdir()):
        unit = tmp_path / path.name
        unit.write_text(path.read_text("utf-8").replace("/opt/rosafe/", f"{ROOT}/"))
        units.append(str(unit))
    assert len(units) == 7
    done = run_program(
        ["systemd-analyze", "verify", "--man=no", *(["--user"] if kind == "user" else []), *units],
        env={**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)},
    )
    ours = [line for line in done.stderr.splitlines() if "rosafe" in line]
    assert not ours, done.stderr
    assert done.returncode == 0, done.stderr
    for name in units:
        text = Path(name).read_text("utf-8")
        if "Type=notify" in text:
            assert "WatchdogSec=" in text
            assert "Restart=always" in text
            assert "MemoryMax=" in text
