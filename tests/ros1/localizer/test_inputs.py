"""Messages of ports that are repeated, and a clock that stands: no frames are used twice, and the log stays short."""

from __future__ import annotations

import importlib
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import rospy

from rosafe.localization import cues
from rosafe.localization.live import FrameFormat, StreamRestartedError
from rosafe.ros import FrameClock, array_msg
from rosafe.ros1.localizer import inputs
from rosafe.ros1.localizer.inputs import PortSource
from tests.harness import Graph, private_graph, wait_for
from tests.ros1.localizer.session import running_localizer, watched, watcher

HOP, CHANNELS = 100, 3


def test_repeated_messages_have_no_new_frames(graph: Graph) -> None:
    message_class = array_msg(importlib.import_module("rosAFE.msg").rosAFE_TimeFrequencySignalPortStruct)
    topics = {kind: f"/repeated/{kind}" for kind in cues.KINDS}
    clock = SimpleNamespace(
        covers=lambda frame, within: True, problem="", time=lambda frame: SimpleNamespace(ros=rospy.Time(1))
    )
    graph.client()
    format_ = FrameFormat(16000.0, CHANNELS, 2 * HOP, HOP, 5 * HOP)
    source = PortSource(topics, format_, cast(FrameClock, clock), lambda: None)
    publishers = [rospy.Publisher(topic, message_class, queue_size=10) for topic in topics.values()]

    def publish(index: int) -> Any:
        samples = np.arange(10.0 * CHANNELS).reshape(CHANNELS, 10) + index
        for publisher in publishers:
            publisher.publish(
                message_class(100, index, 10, CHANNELS, samples, samples if publisher.name.endswith("map") else [])
            )
        wait_for(lambda: all(index in port.messages for port in source._ports))
        return source.take()

    try:
        wait_for(lambda: all(publisher.get_num_connections() for publisher in publishers))
        assert publish(10 * HOP) is None  # frames are counted from here
        assert len(publish(15 * HOP).middles) == 5
        for _ in range(3):
            assert publish(15 * HOP) is None
        again = publish(20 * HOP)
        assert (len(again.middles), again.lost) == (5, 0)
        with pytest.raises(StreamRestartedError, match="the frame index fell from 2000 to 500"):
            publish(5 * HOP)
    finally:
        source.close()
        for publisher in publishers:
            publisher.unregister()


def test_messages_of_an_earlier_stream_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    receive: list[Any] = []
    monkeypatch.setattr(rospy, "Subscriber", lambda topic, kind, callback, **_: receive.append(callback))
    source: Any = SimpleNamespace(lock=threading.Lock(), is_ready=lambda: False)
    port = inputs._Port("/rosAFE/ildPort/ild", "ild", FrameFormat(16000, 4, 320, 160, 1000), source)

    def send(index: int) -> None:
        receive[0](SimpleNamespace(problem="", lastFrameIndex=index, framesOnPort=10, left=np.zeros((4, 10))))

    for index in (1000, 2000, 3000):
        send(index)
    assert [*port.messages] == [1000, 2000, 3000]
    send(500)  # the sound has begun again
    send(1500)
    assert [*port.messages] == [500, 1500]


@pytest.mark.exploration
def test_a_clock_that_stands_is_logged_rarely(tmp_path: Path, device: str, sphere_model: Path) -> None:
    with private_graph(tmp_path / "home") as (graph, _):
        graph.run("rosparam", "set", "/use_sim_time", "true")
        with (
            graph.node("bass-ros"),
            graph.node("rosAFE-ros"),
            graph.start("rostopic", "pub", "-r", "10", "/clock", "rosgraph_msgs/Clock", "clock: {secs: 1000}"),
            running_localizer(graph, "--head", str(sphere_model)) as localizer,
            watcher(graph) as seen,
        ):
            graph.run("rosservice", "call", "/bass/Acquire", f"{{device: '{device}'}}")
            wait_for(lambda: "the time jumped by" in localizer.process.err, what=lambda: str(localizer.process))
            count = len(watched(seen))
            wait_for(lambda: len(watched(seen)) > count + 50, what=lambda: str(localizer.process))
            lines = [line for line in localizer.process.err.splitlines() if "the time jumped by" in line]
            assert len(lines) < 6 and "check /clock" in lines[0], lines
