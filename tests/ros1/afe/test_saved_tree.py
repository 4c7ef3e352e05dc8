"""`rosAFE-ros --keep FILE`: the tree of a killed node is restored as soon as there is sound.

ROSAFE_KILLS=20 in the environment kills twenty times.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import rospy
import yaml
from diagnostic_updater import DiagnosticStatusWrapper

from rosafe.interface import ComponentError
from rosafe.ros1.afe.audio_input import AudioInput
from rosafe.ros1.afe.saved_tree import SavedTree
from rosafe.ros1.transport import registration
from rosafe.tree.setups import Setup, read
from rosafe.tree.tree_builder import Planner
from tests.harness import PATIENCE, Graph, MasterProcess, wait_for
from tests.ros1.afe.session import Microphone, Session, noise, own_node

KILLS = int(os.environ.get("ROSAFE_KILLS", "3"))
REQUESTS = ("PreProc", "GammatoneProc", "IhcProc", "IldProc", "RatemapProc")
NAME = "kept"


@contextmanager
def playing(microphone: Microphone) -> Iterator[None]:
    """Publish audio continuously."""
    over = threading.Event()

    def play() -> None:
        while not over.wait(0.02):
            microphone.play(noise(400))

    thread = threading.Thread(target=play, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(PATIENCE)


def tree(node: Session) -> list[Any]:
    return list(node.ok("getProcessors").processors)


def is_restored(node: Session, before: list[Any]) -> bool:
    """Return whether the tree is restored."""
    wait_for(lambda: len(tree(node)) >= len(before), what=lambda: f"{before}, there is {tree(node)}")
    return tree(node) == before


def test_killed_repeatedly_under_load(graph: Graph, tmp_path: Path) -> None:
    microphone = Microphone(graph)
    file = tmp_path / "tree.yaml"
    with playing(microphone):
        with own_node(graph, "--keep", str(file), name=NAME) as node:
            node.ok("connect_port", local="Audio", remote=microphone.topic)
            node.microphone = microphone
            node.build(*REQUESTS, fb_nChannels=6, in_doNormalize=False, pp_cutoffHzDC=21.123456789012345)
            node.ok("GammatoneProc", name="listed", fb_cfHz=[100.1, 333.3333333333333])
            node.ok("modifyParameter", nameProc="preProc", nameParam="pp_coefPreEmphasis", newValue="0")
            node.ok("modifyParameter", nameProc="input", nameParam="in_normalizeValue", newValue="12345678901")
            node.ok("removeProcessor", name="ratemap")
            node.microphone = None
            before = tree(node)
            node.process.stop(signal.SIGKILL)
        for number in range(KILLS):
            with own_node(graph, "--keep", str(file), name=NAME) as node:
                assert is_restored(node, before), number
                value = 0.006 + 0.001 * (number % 3) + 1e-17 * number
                node.ok("modifyParameter", nameProc="ild", nameParam="ild_hSizeSec", newValue=repr(value))
                before = tree(node)
                index = node.read("ihc").lastFrameIndex
                wait_for(lambda: node.read("ihc").lastFrameIndex > index, what="sound goes on")  # noqa: B023
                node.process.stop(signal.SIGKILL)
    microphone.close()


def test_the_tree_survives_a_clean_end_but_not_stop_or_a_new_input(graph: Graph, tmp_path: Path) -> None:
    microphone = Microphone(graph)
    file = tmp_path / "tree.yaml"
    file.write_text("sound: {device: 'scene:'}\n")
    rospy.set_param(f"/{NAME}/keep", str(file))
    try:
        with own_node(graph, name=NAME) as node:  # the ROS parameter suffices
            node.ok("connect_port", local="Audio", remote=microphone.topic)
            microphone.play(noise(400))
            node.ok("InputProc")
            node.ok("PreProc")
            before = tree(node)
            node.process.stop(signal.SIGTERM)
        assert [one.name for one in read(file.read_text()).processors] == ["input", "preProc"]
        assert read(file.read_text()).sound is not None  # not used by the node, and preserved
        microphone.close()
        with own_node(graph, name=NAME) as node:  # no audio
            assert node.health(lambda entries: "waiting for sound" in entries["message"], "keep")["level"] == "1"
            assert tree(node) == []
            node.process.stop(signal.SIGKILL)
        again = Microphone(graph, topic=microphone.topic)
        with own_node(graph, name=NAME) as node:
            again.play(noise(400))
            assert is_restored(node, before)
            node.ok("Stop")
            node.process.stop(signal.SIGKILL)
        assert read(file.read_text()).processors == ()
        with own_node(graph, name=NAME) as node:
            again.play(noise(400))
            node.ok("InputProc", name="mine")
            node.ok("PreProc", upperDepName="mine")
            node.ok("InputProc", name="other")
            assert [p.upperDepName for p in tree(node)] == ["", "other"]
            node.process.stop(signal.SIGKILL)
        assert [one.name for one in read(file.read_text()).processors] == ["other", "preProc"]
        again.close()
    finally:
        rospy.delete_param(f"/{NAME}/keep")


@pytest.mark.parametrize("master", ["answers", "away", "hangs"])
def test_a_tree_that_cannot_be_restored_stays_in_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, master: str
) -> None:
    """It is refused although the check before accepted it, as if the memory were used meanwhile."""
    ended = threading.Event()

    def set_param(name: str, value: object) -> None:
        if master == "away":
            raise ConnectionRefusedError
        if master == "hangs":
            ended.wait()

    monkeypatch.setattr(rospy, "set_param", set_param)
    file = tmp_path / "tree.yaml"
    file.write_text("processors:\n  input: {kind: input}\n  preProc: {kind: preProc, parent: input}\n")
    planned: list[list[str]] = []

    def build(planner: Planner) -> None:
        planned.append(planner([]).created)
        raise ComponentError("::rosAFE::e_memory")

    monkeypatch.setattr(registration, "_registrar", SimpleNamespace(parameters={}))
    saved = SavedTree(
        file,
        cast(AudioInput, SimpleNamespace(topic="", ring=SimpleNamespace(sample_rate=44100))),
        Setup,
        build,
        lambda: False,
    )
    finished = threading.Event()
    saved.restore(finished)
    try:
        wait_for(lambda: "e_memory" in saved.report(DiagnosticStatusWrapper()).message)
        assert planned == [["input", "preProc"]]
        saved.save()
        assert [one.name for one in read(file.read_text()).processors] == ["input", "preProc"]
    finally:
        finished.set()
        ended.set()


def test_the_parameter_can_only_name_setups(graph: Graph, tmp_path: Path) -> None:
    """Any client can set it: it must not overwrite a start-up file of the user's shell, for example."""
    file = tmp_path / ".bash_profile"
    rospy.set_param(f"/{NAME}/keep", str(file))
    try:
        done = graph.run("rosAFE-ros", "-i", NAME, check=False)
    finally:
        rospy.delete_param(f"/{NAME}/keep")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert f"ROS parameter /{NAME}/keep: expected FILE.yaml, got '{file}'" in done.stderr
    assert not file.exists()


def test_an_unreadable_file_is_reported_and_not_changed(graph: Graph, tmp_path: Path) -> None:
    file = tmp_path / "tree.yaml"
    for text, what in (("processors:\n  a: {nothing: x}\n", "line 2"), ("\x00", "not YAML")):
        file.write_text(text)
        done = graph.run("rosAFE-ros", "--keep", str(file), "-i", NAME, check=False)
        assert done.returncode == 1
        assert what in done.stderr
        assert str(file) in done.stderr
        assert file.read_text() == text
        assert "Traceback" not in done.stderr


def test_a_failure_to_write_is_reported_and_the_node_continues(graph: Graph, tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    with own_node(graph, "--keep", str(folder / "tree.yaml"), name=NAME) as node:
        folder.rmdir()
        microphone = node.listen()
        microphone.play(noise(400))
        node.ok("InputProc")
        assert "does not exist" in node.health(lambda entries: entries["level"] == "1", "keep")["message"]
        folder.mkdir()
        node.ok("PreProc")
        assert len(read((folder / "tree.yaml").read_text()).processors) == 2
        assert node.health(lambda entries: entries["level"] == "0", "keep")["message"] == "the tree is kept"


def test_a_new_master_gets_the_names_of_the_restored_processors(
    private_graph: tuple[Graph, MasterProcess], tmp_path: Path
) -> None:
    """Clients such as the localizer recognize their processors by them."""
    graph, master = private_graph
    tree = tmp_path / "tree.yaml"
    tree.write_text("processors:\n  input: {kind: input}\n  mine: {kind: preProc}\n")

    def stored() -> list[str]:
        done = graph.run("rosparam", "get", "/rosAFE/restored", check=False)
        return list(yaml.safe_load(done.stdout)) if done.returncode == 0 else []

    with graph.node("rosAFE-ros", "--keep", str(tree)) as node:
        before = stored()
        assert before[1:] == ["input", "mine"] and before[0].startswith("http://127.0.0.1:")
        master.kill()
        wait_for(lambda: "no answer from the ROS master" in node.err, what=lambda: str(node))
        master.start(graph.env)
        wait_for(lambda: stored() == before, what=lambda: f"{before} in {stored()}: {node}")
