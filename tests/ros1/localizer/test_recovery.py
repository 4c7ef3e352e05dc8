"""The localizer when something is missing, ends, starts again, or changes. Each test has its own localizer."""

from __future__ import annotations

import itertools
import re
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rospy
import yaml

from rosafe.localization import cues
from rosafe.localization.head import Head
from tests.harness import Graph, Process, private_graph, wait_for
from tests.localization.conftest import RATE, modulated
from tests.ros1.afe.session import Microphone
from tests.ros1.localizer.session import (
    acquire,
    names_of,
    present,
    running_localizer,
    scene_file,
    watched,
    watcher,
)


@pytest.fixture
def empty(graph: Graph, afe: Process) -> Iterator[None]:
    """Leave rosAFE without processors."""
    yield
    graph.call("/rosAFE/Stop")
    assert not names_of(graph)


def test_only_its_own_processors_are_removed(
    graph: Graph, afe: Process, empty: None, device: str, sphere_model: Path
) -> None:
    acquire(graph, device)
    parameters = ", ".join(f"{name}: {str(value).lower()}" for name, value in cues.PARAMETERS.items())
    parameters += ", nFramesPerBlock: 1600"
    request = graph.call("/rosAFE/request", representation="ild", parameters=parameters, connect="")
    before = names_of(graph)
    assert set(request.dependencies) == before
    with running_localizer(graph, "--head", str(sphere_model)) as localizer:
        localizer.wait_present(40)
        topics = {topic for topic, node in graph.readers() if node == "/localizer"}
        assert request.topic in topics, "a processor with the right parameters is used"
        created = names_of(graph) - before
        assert len(created) == 4, created  # correlation, itd, ic, ratemap
        correlation = next(name for name in created if name.startswith("crosscorrelation"))
        other = graph.call("/rosAFE/ItdProc", name="mine", upperDepName=correlation)
        assert other.genom_success
        assert localizer.process.stop(2) == 0  # SIGINT
    assert names_of(graph) == {*before, correlation, "mine"}, "one has a child of another client"


def test_a_successor_removes_the_processors(
    graph: Graph, afe: Process, empty: None, device: str, sphere_model: Path
) -> None:
    acquire(graph, device)
    with running_localizer(graph, "--head", str(sphere_model)) as first:
        first.wait_present(40)
        created = names_of(graph)
        with running_localizer(graph, "--head", str(sphere_model)) as second:
            assert first.process.wait() == 0, "of two nodes with one name the newer one continues"
            second.log("localizing with")
            second.wait_present(40)
            assert names_of(graph) == created
            assert second.process.stop() == 0
    assert [name for name in names_of(graph) if not name.startswith("input")] == []


def test_stop_holds_until_there_is_an_input(
    graph: Graph, afe: Process, empty: None, device: str, sphere_model: Path
) -> None:
    acquire(graph, device)
    with running_localizer(graph, "--head", str(sphere_model)) as localizer, localizer.collect() as messages:
        localizer.wait_present(40)
        graph.call("/rosAFE/Stop")
        state = localizer.state(lambda entries: "rosAFE was stopped" in entries["message"])
        assert state["level"] == "1"
        count = len(messages)
        wait_for(lambda: len(messages) > count + 30)
        assert not names_of(graph) and not present(messages[-1])
        assert graph.call("/rosAFE/InputProc", name="mine", nFramesPerBlock=800).genom_success
        localizer.wait_present(40)
        assert localizer.process.stop() == 0
    assert names_of(graph) == {"mine"}


def test_processors_of_a_replaced_input_are_forgotten(
    graph: Graph, afe: Process, empty: None, device: str, sphere_model: Path, tmp_path: Path
) -> None:
    """Another sample rate needs another model, until the first one returns.

    Others may create processors with the names of those that the localizer has removed.
    """
    (tmp_path / "fast").mkdir()
    fast = scene_file(tmp_path / "fast", "sample_rate: 22050\nsources:\n  - {signal: noise, azimuth: 40}\n")
    options = ("--head", str(sphere_model), "--connect", "bass/Audio")
    with running_localizer(graph, *options) as localizer:
        for _ in range(2):
            acquire(graph, device)
            localizer.wait_present(40)
            name = next(name for name in names_of(graph) if name.startswith("ild"))
            acquire(graph, fast)
            state = localizer.state(lambda entries: "for which the model was learned" in entries["message"])
            assert state["level"] == "1" and "16000 Hz" in state["message"] and "22050" in state["message"]
            localizer.wait_silent()
        (root,) = names_of(graph)
        assert graph.call("/rosAFE/PreProc", name=name, upperDepName=root).genom_success
        assert localizer.process.stop() == 0
    assert names_of(graph) == {root, name}
    with running_localizer(graph, *options) as localizer:
        localizer.state(lambda entries: "for which the model was learned" in entries["message"])
        assert localizer.process.stop() == 0
    assert names_of(graph) == {root, name}, "the processor of another client"


class Talker(threading.Thread):
    """A microphone with a talker at 40 degrees, in real time until `close`."""

    def __init__(self, microphone: Microphone) -> None:
        super().__init__(daemon=True)
        sound = Head.sphere().render(modulated(3.0, 5), microphone.sample_rate, azimuth=40.0)
        self._samples = np.round(sound * 2**30).astype(np.int32)
        self._microphone = microphone
        self._jump: int | None = None
        self._closing = threading.Event()
        self.start()

    def jump(self, frames: int) -> None:
        """Add to the frame index; return when that is done."""
        self._jump = frames
        wait_for(lambda: self._jump is None or not self.is_alive())

    def run(self) -> None:
        """Play."""
        chunk, due = self._microphone.chunk, time.monotonic()
        for begin in itertools.cycle(range(0, self._samples.shape[1] - chunk, chunk)):
            due += chunk / self._microphone.sample_rate
            if self._closing.wait(max(0.0, due - time.monotonic())):
                return
            if self._jump is not None:
                self._microphone.index = max(0, self._microphone.index + self._jump)
                self._jump = None
            self._microphone.play(self._samples[:, begin : begin + chunk])

    def close(self) -> None:
        """End."""
        self._closing.set()
        self.join()
        self._microphone.close()


def test_gaps_and_new_streams(graph: Graph, afe: Process, empty: None, sphere_model: Path) -> None:
    microphone = Microphone(graph, RATE, chunk=800, chunks=20)
    with running_localizer(graph, "--head", str(sphere_model), "--connect", microphone.topic) as localizer:
        localizer.log(f"waiting for sound on {microphone.topic}")
        talker = Talker(microphone)
        with localizer.collect() as messages:
            try:
                localizer.wait_present(40)
                for frames, logged in (
                    (4 * RATE, ("frames of rosAFE were lost", "the time jumped by")),
                    (-(10**9), ("a new stream of sound: the frame index fell",)),
                    (1000 * RATE, ()),  # a very long loss; losses are logged once in some seconds
                ):
                    before = max(source.id for message in list(messages) for source in message.sources)
                    talker.jump(frames)
                    wait_for(
                        lambda: not logged or any(text in localizer.process.err for text in logged),  # noqa: B023
                        what=lambda: f"{logged} in {localizer.process}",  # noqa: B023
                    )
                    wait_for(lambda: any(s.id > before for s in messages[-1].sources), what=lambda: str(messages[-1]))  # noqa: B023
                localizer.wait_present(40)
            finally:
                talker.close()
            localizer.wait_silent()
            localizer.state(lambda entries: "waiting for sound" in entries["message"])
    assert "Traceback" not in localizer.process.err


def test_restarts_of_bass_and_rosafe(graph: Graph, device: str, sphere_model: Path) -> None:
    """The localizer starts first, and continues when the others start again."""
    names = {"bass-ros": "ears", "rosAFE-ros": "hearing"}
    options = ("--head", str(sphere_model), "--rosafe", "hearing", "--connect", "ears/Audio", "--name", "tracker")
    with running_localizer(graph, *options, name="tracker") as localizer:
        localizer.log("waiting for rosAFE")
        with graph.node("bass-ros", "-i", names["bass-ros"]):
            with graph.node("rosAFE-ros", "-i", names["rosAFE-ros"]) as hearing:
                localizer.log("waiting for sound on /ears/Audio")
                response = graph.call(
                    "/ears/Acquire", device=device, sampleRate=0, nFramesPerChunk=800, nChunksOnPort=20
                )
                assert response.genom_success
                localizer.wait_present(40)
                assert hearing.stop(9) == -9
            localizer.wait_silent()
            state = localizer.state(lambda entries: "waiting for rosAFE" in entries["message"])
            assert state["level"] == "1"
            with graph.node("rosAFE-ros", "-i", names["rosAFE-ros"]):
                localizer.wait_present(40)
                with graph.node("bass-ros", "-i", "ears"):  # replaces the other one
                    localizer.state(lambda entries: "waiting for sound" in entries["message"])
                    graph.call("/ears/Acquire", device=device, sampleRate=0, nFramesPerChunk=800, nChunksOnPort=20)
                    localizer.wait_present(40)
                    states = re.findall(r"\]: (waiting .*)", localizer.process.err)
                    assert all(one != other for one, other in itertools.pairwise(states)), "a state is logged once"
                    assert localizer.process.stop() == 0
                assert len(names_of(graph, "hearing")) == 1, "the input cannot be removed"


def stored_list(graph: Graph) -> str:
    """Return the ROS parameter with rosAFE and the processors that the localizer has created; "" if there is none."""
    return graph.run("rosparam", "get", "/localizer/created", check=False).stdout


def test_a_master_that_is_away(tmp_path: Path, device: str, sphere_model: Path) -> None:
    with (
        private_graph(tmp_path / "home") as (graph, master),
        graph.node("bass-ros"),
        graph.node("rosAFE-ros"),
        running_localizer(graph, "--head", str(sphere_model)) as localizer,
        watcher(graph) as seen,
    ):
        graph.run("rosservice", "call", "/bass/Acquire", f"{{device: '{device}', nFramesPerChunk: 800}}")
        wait_for(lambda: any(len(line) > 1 for line in watched(seen)))
        stored = stored_list(graph)
        assert "ild_0" in stored
        master.kill()
        localizer.log("no answer from the ROS master")
        count = len(watched(seen))
        wait_for(lambda: len(watched(seen)) > count + 20)
        assert any(len(line) > 1 for line in watched(seen)[-10:])
        master.start(graph.env)
        localizer.log("the ROS master answers again")
        wait_for(lambda: "/localizer/sources" in graph.topics())
        count = len(watched(seen))
        wait_for(lambda: len(watched(seen)) > count + 20)
        assert any(len(line) > 1 for line in watched(seen)[-10:])
        wait_for(lambda: stored_list(graph) == stored)
        localizer.process.stop(signal.SIGKILL)
        with running_localizer(graph, "--head", str(sphere_model)) as successor:
            successor.log("localizing with")
            assert stored_list(graph) == stored
            assert successor.process.stop() == 0
        left = graph.run("rosservice", "call", "/rosAFE/getProcessors").stdout
        assert "input_0" in left and not any(name in left for name in yaml.safe_load(stored)[1:])


@pytest.mark.exploration
def test_recorded_sound_in_a_loop(graph: Graph, bass: Process, device: str, sphere_model: Path, tmp_path: Path) -> None:
    """`rosbag play --clock` jumps back in time, with its sound."""
    acquire(graph, device)
    graph.message("/bass/Audio", accept=lambda message: message.lastFrameIndex > RATE)
    bag = tmp_path / "sound.bag"
    graph.run("rosbag", "record", "--duration=3", "-O", str(bag), "/bass/Audio")
    graph.call("/bass/Stop")
    recorded = time.time()
    with private_graph(tmp_path / "home") as (replay, _):
        replay.run("rosparam", "set", "/use_sim_time", "true")
        with (
            replay.node("rosAFE-ros"),
            running_localizer(replay, "--head", str(sphere_model)) as localizer,
            watcher(replay) as seen,
            replay.start("rosbag", "play", "--clock", "-q", "-l", str(bag)),
        ):
            localizer.log("a new stream of sound")
            count = len(watched(seen))
            wait_for(lambda: any(len(line) > 1 for line in watched(seen)[count:]), what=lambda: str(localizer.process))
            found = [line for line in watched(seen) if len(line) > 1]
            assert all(line[0] < recorded for line in found), "ROS time, that of the recording"
            assert all(abs(line[1] - 40) < 15 for line in found)
            assert "Traceback" not in localizer.process.err


def test_wrong_command_lines(graph: Graph, tmp_path: Path, sphere_model: Path) -> None:
    def refused(*options: str) -> str:
        done = graph.run("rosafe", "localize", *options, check=False)
        assert done.returncode != 0 and "Traceback" not in done.stderr
        return done.stderr

    assert "--yaw: expected a sound file" in refused("--yaw", "x.csv")
    assert "expected a learned model, got a missing file" in refused("--head", str(tmp_path / "none"))
    assert "x.sofa" in refused("--head", str(tmp_path / "x.sofa"))
    assert "world_frame: expected another frame than head_frame" in refused("--world-frame", "head")
    assert "rosafe: expected a ROS name" in refused("--rosafe", "a b")
    graph.client()
    rospy.set_param("/localizer/seconds", -1)
    try:
        assert "seconds: expected a number from 0.01 to 60, got -1" in refused()
    finally:
        rospy.delete_param("/localizer/seconds")
