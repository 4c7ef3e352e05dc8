"""Hostile messages, parameters and files: the localizer names them, continues, and finds the talker again."""

from __future__ import annotations

import importlib
import os
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rospy
from std_msgs.msg import Bool

from rosafe.ros import array_msg
from rosafe.ros1.localizer.settings import read_settings
from tests.harness import PATIENCE, Graph, Process, freeze, wait_for
from tests.ros1.localizer.session import Localizer, acquire, names_of, running_localizer


@pytest.fixture
def talking(graph: Graph, localizer: Localizer, device: str) -> Iterator[Localizer]:
    """Provide a localizer that has found a talker, and check that it finds it again after the attack."""
    acquire(graph, device)
    localizer.wait_present(40)
    lines = localizer.process.err.count("\n")
    yield localizer
    localizer.wait_present(40)
    localizer.state(lambda entries: entries["level"] == "0")
    err = localizer.process.err
    assert "Traceback" not in err and "RuntimeWarning" not in err, err
    assert "unexpected errors" not in localizer.state(lambda entries: True)
    assert err.count("\n") - lines < 40, err[-5000:]


def flood(
    topic: str, message_class: Any, create: Callable[[int, Any], Any], until: Callable[[int], object], what: str
) -> None:
    """Publish messages on a topic of rosAFE until a condition for their number holds.

    `create` gets the number of the message and the newest message of rosAFE.
    """
    latest = [message_class()]
    sent: list[int] = []
    ending = threading.Event()
    publisher = rospy.Publisher(topic, message_class, queue_size=100)
    subscriber = rospy.Subscriber(topic, message_class, latest.append, queue_size=1)

    def run() -> None:
        while not ending.wait(0.02):
            publisher.publish(create(len(sent), latest[-1]))
            sent.append(1)

    thread = threading.Thread(target=run)
    try:
        wait_for(lambda: "/localizer" in str(publisher.impl.get_stats_info() if publisher.impl else ""))
        thread.start()
        wait_for(lambda: until(len(sent)), what=what)
    finally:
        ending.set()
        if thread.ident:
            thread.join(PATIENCE)
        subscriber.unregister()
        publisher.unregister()


def port_of(graph: Graph, kind: str) -> str:
    """Return the topic of a representation that the localizer reads."""
    return next(topic for topic, node in graph.readers() if node == "/localizer" and f"/{kind}Port/" in topic)


NAN, HUGE = float("nan"), 1e308


def test_malformed_frames(graph: Graph, talking: Localizer) -> None:
    """Messages with the frame indices of others, of the wrong shape; and indices out of range."""
    malformed = (
        ((3, 10), 10, 0),
        ((31, 10), 11, 0),
        ((31, 10), 2**63, 0),
        ((31, 0), 0, 0),
        ((31, 100), 100, 2**64 - 1),
    )
    problems = ("expected 31 channels", "is out of range")
    message_class = array_msg(importlib.import_module("rosAFE.msg").rosAFE_TimeFrequencySignalPortStruct)

    def create(number: int, newest: Any) -> Any:
        left, frames, index = malformed[number % len(malformed)]
        return message_class(
            sampleRate=100,
            lastFrameIndex=index or max(1, newest.lastFrameIndex),
            framesOnPort=frames,
            numberOfChannels=left[0],
            left=np.zeros(left),
            right=np.zeros((0,)),
        )

    def done(count: int) -> bool:
        return count > 6 * len(malformed) and all(problem in talking.process.err for problem in problems)

    flood(port_of(graph, "itd"), message_class, create, done, f"{problems}: {talking.process}")


@pytest.mark.parametrize(("kind", "step"), [("ild", 0), ("ratemap", 0), ("ild", 10**9), ("itd", -(10**4))])
def test_frames_with_strange_values_and_indices(graph: Graph, talking: Localizer, kind: str, step: int) -> None:
    """Each message has one of several values."""
    values = (NAN, HUGE, -HUGE, 1e99)
    message_class = array_msg(importlib.import_module("rosAFE.msg").rosAFE_TimeFrequencySignalPortStruct)

    def create(number: int, newest: Any) -> Any:
        value = values[number // 4 % len(values)]
        return message_class(
            sampleRate=100,
            lastFrameIndex=max(1, int(newest.lastFrameIndex) + step),
            framesOnPort=100,
            numberOfChannels=31,
            left=np.full((31, 100), value),
            right=np.full((31, 100), value) if kind == "ratemap" else np.zeros((0,)),
        )

    flood(port_of(graph, kind), message_class, create, lambda count: count > 64, "messages")


@pytest.mark.parametrize(
    "times",
    [
        [(None, 0.0, 0.0), (None, NAN, 0.0), (None, 1.0, 0.0), (None, 1e6, 0.0)],
        [(2**64 - 1, 16000.0, 0.0), (1, 16000.0, 0.0)],
        [(None, 16000.0, -1e6), (None, 16000.0, 1e6), (None, 16000.0, 4e9)],
    ],
    ids=["rates", "indices", "stamps"],
)
def test_hostile_times(graph: Graph, talking: Localizer, times: list[tuple[int | None, float, float]]) -> None:
    """Frame index (None: a possible one), rate, and seconds that are added to the stamp."""
    message_class = importlib.import_module("rosAFE.msg").rosAFE_frameTime

    def create(number: int, newest: Any) -> Any:
        frame, rate, seconds = times[number // 4 % len(times)]
        moment = min(max(0.0, newest.stamp.to_sec() + seconds), 2.0**32 - 1)
        index = newest.frameIndex + 1 if frame is None else frame
        return message_class(stamp=rospy.Time.from_sec(moment), frameIndex=min(index, 2**64 - 1), sampleRate=rate)

    flood("/rosAFE/frameTime", message_class, create, lambda count: count > 64, "messages")


def test_a_flood_of_mute(talking: Localizer) -> None:
    publisher = rospy.Publisher("/localizer/mute", Bool, queue_size=1000)
    wait_for(publisher.get_num_connections)
    for number in range(3000):
        publisher.publish(number % 2 == 0)
    talking.state(lambda entries: entries["muted"] == "no")
    publisher.unregister()


@pytest.mark.parametrize(
    "kinds",
    [
        ("itd", "crosscorrelation", "time"),
        pytest.param(("ic", "ratemap", "ild", "innerhaircell", "filterbank"), marks=pytest.mark.exploration),
    ],
)
def test_each_processor_is_removed(graph: Graph, talking: Localizer, kinds: tuple[str, ...]) -> None:
    """Also those with children, which are removed with it."""
    for kind in kinds:
        name = next(name for name in names_of(graph) if name.startswith(kind))
        count = talking.process.err.count("of rosAFE was removed; it is requested again")
        assert graph.call("/rosAFE/removeProcessor", name=name).genom_success
        wait_for(lambda: talking.process.err.count("of rosAFE was removed; it is requested again") > count)  # noqa: B023
        wait_for(lambda: any(name.startswith(kind) for name in names_of(graph)))  # noqa: B023
        talking.wait_present(40)


def test_the_number_of_channels_changes(graph: Graph, talking: Localizer) -> None:
    bank = next(name for name in names_of(graph) if name.startswith("filterbank"))
    for parameter, value in (("fb_highFreqHz", "7000"), ("fb_nChannels", "7")):
        changed = graph.call("/rosAFE/modifyParameter", nameProc=bank, nameParam=parameter, newValue=value)
        assert changed.genom_success, changed.genom_exdetail
    talking.log(f"of the processor {bank} of rosAFE was changed")
    assert "fb_highFreqHz" in talking.process.err
    wait_for(lambda: any(name.startswith("filterbank") and name != bank for name in names_of(graph)))
    talking.wait_present(40)


def test_two_localizers(graph: Graph, talking: Localizer, sphere_model: Path) -> None:
    """The other one uses the same processors; it ends first."""
    before = names_of(graph)
    with running_localizer(graph, "--head", str(sphere_model), name="second") as other:
        other.wait_present(40)
        assert names_of(graph) == before
        assert other.process.stop() == 0
    assert names_of(graph) == before


def test_rosafe_hangs_and_is_killed(graph: Graph, bass: Process, device: str, sphere_model: Path) -> None:
    acquire(graph, device)
    with running_localizer(graph, "--head", str(sphere_model), "--rosafe", "victim", name="third") as localizer:
        with graph.node("rosAFE-ros", "-i", "victim") as victim:
            wait_for(lambda: names_of(graph, "victim"))  # in the middle of the requests
            freeze(victim.pid)
            localizer.wait_silent()
            victim.stop(9)
        localizer.state(lambda entries: entries["level"] == "1" and "waiting for rosAFE" in entries["message"])
        with graph.node("rosAFE-ros", "-i", "victim"):
            localizer.wait_present(40)
            assert localizer.process.stop() == 0
            assert len(names_of(graph, "victim")) == 1
        assert "Traceback" not in localizer.process.err, localizer.process.err


def test_no_times(graph: Graph, bass: Process, device: str, sphere_model: Path) -> None:
    """frameTime does not arrive, all other ports do: the localizer says so, and has no sources."""
    acquire(graph, device)
    options = ("--head", str(sphere_model), "--rosafe", "timeless")
    with (
        graph.node("rosAFE-ros", "-i", "timeless", "/timeless/frameTime:=/other/frameTime"),
        running_localizer(graph, *options, name="fourth") as localizer,
        localizer.collect() as messages,
    ):
        localizer.state(lambda entries: "waiting for /timeless/frameTime" in entries["message"])
        count = len(messages)
        wait_for(lambda: len(messages) > count + 10)
        assert not any(message.sources for message in messages)
        assert localizer.process.stop() == 0
    assert "Traceback" not in localizer.process.err, localizer.process.err


@pytest.mark.parametrize(
    ("parameter", "value", "problem"),
    [
        ("head", 5, "head: expected a text, got 5"),
        ("seconds", "abc", "seconds: expected a number from 0.01 to 60, got 'abc'"),
        ("seconds", True, "seconds: expected a number from 0.01 to 60, got True"),
        ("seconds", NAN, "seconds: expected a number from 0.01 to 60, got nan"),
        ("audio_delay", [1], "audio_delay: expected a number from -5 to 5, got [1]"),
        ("noise", {"a": 1}, "noise: expected a text, got"),
        ("world_frame", 3.5, "world_frame: expected a text, got 3.5"),
        ("connect", "a//b c", "connect: expected a ROS name"),
    ],
)
def test_unsuitable_parameters(graph: Graph, parameter: str, value: Any, problem: str) -> None:
    graph.client()
    rospy.set_param(f"/strange/{parameter}", value)
    try:
        with pytest.raises(ValueError, match=re.escape(problem)):
            read_settings({}, "/strange/")
    finally:
        rospy.delete_param(f"/strange/{parameter}")


def test_files_that_are_none(graph: Graph, tmp_path: Path) -> None:
    """A FIFO without a writer, for both files; a device without an end; a folder."""
    os.mkfifo(tmp_path / "fifo")
    fifo = str(tmp_path / "fifo")
    for option, file in (("--noise", fifo), ("--head", fifo), ("--head", "/dev/zero"), ("--noise", "/")):
        done = graph.run("rosafe", "localize", "--name", "strange", option, file, check=False)
        assert done.returncode != 0 and f"{file}: expected a" in done.stderr, done.stderr
        assert "Traceback" not in done.stderr, done.stderr


def test_a_noise_level_that_cannot_be_written(graph: Graph, talking: Localizer, sphere_model: Path) -> None:
    """The command says so; the processors that the localizer uses remain."""
    before = names_of(graph)
    special = ["/proc/noise.json"] if Path("/proc/self").exists() else []  # in a bare chroot it is a usual folder
    for path in (*special, "/dev/full"):
        command = ("rosafe", "localize", "--calibrate-noise", "0.5", "--noise", path, "--head", str(sphere_model))
        done = graph.run(*command, check=False)
        assert done.returncode != 0 and path in done.stderr and "Traceback" not in done.stderr, done.stderr
        assert names_of(graph) == before
