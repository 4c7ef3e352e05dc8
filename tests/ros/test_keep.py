"""`rosAFE-ros --keep FILE`: a node that was killed comes back as it was, once there is sound.

ROSAFE_KILLS=20 in the environment kills twenty times.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rospy

from rosafe.setups import read
from tests.harness import PATIENCE, Graph, wait_for
from tests.ros.session import Microphone, Session, noise, own_node

KILLS = int(os.environ.get("ROSAFE_KILLS", "3"))
REQUESTS = ("PreProc", "GammatoneProc", "IhcProc", "IldProc", "RatemapProc")
NAME = "kept"


@contextmanager
def playing(microphone: Microphone) -> Iterator[None]:
    """Sound that goes on."""
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


def back(node: Session, before: list[Any]) -> bool:
    """Whether all is as it was."""
    wait_for(lambda: len(tree(node)) >= len(before), what=lambda: f"{before}, there is {tree(node)}")
    return tree(node) == before


def test_killed_under_load_again_and_again(graph: Graph, tmp_path: Path) -> None:
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
                assert back(node, before), number
                value = 0.006 + 0.001 * (number % 3) + 1e-17 * number
                node.ok("modifyParameter", nameProc="ild", nameParam="ild_hSizeSec", newValue=repr(value))
                before = tree(node)
                index = node.read("ihc").lastFrameIndex
                wait_for(lambda: node.read("ihc").lastFrameIndex > index, what="sound goes on")  # noqa: B023
                node.process.stop(signal.SIGKILL)
    microphone.close()


def test_a_clean_end_keeps_a_stop_does_not_and_whoever_asks_for_an_input_begins_anew(
    graph: Graph, tmp_path: Path
) -> None:
    microphone = Microphone(graph)
    file = tmp_path / "tree.yaml"
    file.write_text("sound: {device: 'scene:'}\n")
    rospy.set_param(f"/{NAME}/keep", str(file))
    try:
        with own_node(graph, name=NAME) as node:  # the ROS parameter will do
            node.ok("connect_port", local="Audio", remote=microphone.topic)
            microphone.play(noise(400))
            node.ok("InputProc")
            node.ok("PreProc")
            before = tree(node)
            node.process.stop(signal.SIGTERM)
        assert [one.name for one in read(file.read_text()).processors] == ["input", "preProc"]
        assert read(file.read_text()).sound is not None  # not the node's, and so left alone
        microphone.close()
        with own_node(graph, name=NAME) as node:  # there is no sound
            assert node.health(lambda entries: "waiting for sound" in entries["message"], "keep")["level"] == "1"
            assert tree(node) == []
            node.process.stop(signal.SIGKILL)
        again = Microphone(graph, topic=microphone.topic)
        with own_node(graph, name=NAME) as node:
            again.play(noise(400))
            assert back(node, before)
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


def test_the_parameter_names_setups_only(graph: Graph, tmp_path: Path) -> None:
    """Others can set it: it must not make a start-up file of the user's shell, say."""
    file = tmp_path / ".bash_profile"
    rospy.set_param(f"/{NAME}/keep", str(file))
    try:
        done = graph.run("rosAFE-ros", "-i", NAME, check=False)
    finally:
        rospy.delete_param(f"/{NAME}/keep")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert f"ROS parameter /{NAME}/keep: expected FILE.yaml, got '{file}'" in done.stderr
    assert not file.exists()


def test_what_cannot_be_read_is_told_and_left_alone(graph: Graph, tmp_path: Path) -> None:
    file = tmp_path / "tree.yaml"
    for text, what in (("processors:\n  a: {nothing: x}\n", "line 2"), ("\x00", "not YAML")):
        file.write_text(text)
        done = graph.run("rosAFE-ros", "--keep", str(file), "-i", NAME, check=False)
        assert done.returncode == 1
        assert what in done.stderr
        assert str(file) in done.stderr
        assert file.read_text() == text
        assert "Traceback" not in done.stderr


def test_what_cannot_be_written_is_told_and_the_node_goes_on(graph: Graph, tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    with own_node(graph, "--keep", str(folder / "tree.yaml"), name=NAME) as node:
        folder.rmdir()
        microphone = node.listen()
        microphone.play(noise(400))
        node.ok("InputProc")
        assert "no folder" in node.health(lambda entries: entries["level"] == "1", "keep")["message"]
        folder.mkdir()
        node.ok("PreProc")
        assert len(read((folder / "tree.yaml").read_text()).processors) == 2
        assert node.health(lambda entries: entries["level"] == "0", "keep")["message"] == "the tree is kept"
