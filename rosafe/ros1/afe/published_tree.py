"""The processor tree of the node: each processor is an activity, has a port, and is part of the diagnostics.

A port is a latched topic with a window that advances by one block at a time.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import rospy

from rosafe.audio.stream.frame_clock import LinearClock
from rosafe.interface import KINDS, LAYOUTS, ROSAFE, ComponentError
from rosafe.ros1.afe.choice_fallbacks import ChoiceFallbacks
from rosafe.ros1.afe.messages import signal_fields
from rosafe.ros1.component import serialization
from rosafe.ros1.component.activities import Activity
from rosafe.ros1.component.component import ComponentNode
from rosafe.ros1.transport.publisher import NewestMessage, Publisher
from rosafe.tree.block import Block
from rosafe.tree.health import ProcessorHealth
from rosafe.tree.processor import Processor
from rosafe.tree.tree import Failure, Tree

MAX_TIME = 2**32 - 1.0  # s since 1970, of a ROS time


class _OutputPort(NamedTuple):
    """The topic of a processor, and the function that publishes the newest window of its output."""

    publisher: Publisher
    publish: Callable[[], None]


def _message_builder(processor: Processor) -> Callable[[], Any]:
    """Return a function that returns the message of a port.

    It refers to the history alone, so that removed processors are freed at once, and the message to released blocks,
    which never change: they are serialized without a copy.
    """
    kind, history = processor.kind, processor.history
    message_class = serialization.message_class("rosAFE", LAYOUTS[kind].idl)

    def build() -> Any:
        views, next_index, signal = history.port_window()
        return message_class(**signal_fields(kind, views, next_index, signal.rate))

    return build


class PublishedTree:
    """A tree whose events open ports, publish blocks and end activities.

    Parameters
    ----------
    node : ComponentNode
    workers : int
        Number of threads.
    choices : ChoiceFallbacks
    captured : callable
        Returns the time at which an audio frame was captured; None if it is unknown.

    Attributes
    ----------
    tree : Tree
    health : ProcessorHealth
    """

    def __init__(
        self,
        node: ComponentNode,
        workers: int,
        choices: ChoiceFallbacks,
        captured: Callable[[int], LinearClock | None],
    ) -> None:
        self._node = node
        self._choices = choices
        self._captured = captured
        self._ports: dict[Processor, _OutputPort] = {}
        self._awaiting = threading.Lock()  # held while `Processor.awaited` is set
        self._activities: dict[Processor, Activity] = {}
        self._time_class = serialization.message_class("rosAFE", "::rosAFE::frameTime")
        self._frame_time = node.advertise("frameTime", self._time_class)
        self._frame_time.impl.on_change = self._await_subscribed
        self._input_port = self._advertise("input")
        self._newest_time = NewestMessage(self._build_time)
        self._newest_frame = (0, LinearClock(0.0, 0.0, 1.0))  # of `_newest_time`
        self._meters = {kind: node.meters[ROSAFE.service(r.request).task] for kind, r in KINDS.items()}
        self.tree = Tree(self, workers, real_time=True)
        self.health = ProcessorHealth(self.tree, rospy.logwarn, rospy.logerr, lambda: choices.lines)
        self.on_executed = self.health.executed

    def run(self, activity: Activity, processor: Processor, save: Callable[[], None]) -> None:
        """Run the `activity` of a processor: both end together. `save` is called after each change of the tree."""
        self._activities[processor] = activity
        if processor not in self.tree.processors:  # it may have ended before its activity was registered
            activity.interrupt("")
        self._node.settle()
        save()  # before the client is notified that it runs
        activity.running()
        activity.stop_requested.wait()
        self._activities.pop(processor, None)
        self.tree.end(processor)
        self._choices.forget(processor)
        save()
        self._node.settle()
        if processor.error is not None:
            raise ComponentError("::genom::unkex", what=str(Failure.of(processor)))

    def _await_subscribed(self) -> None:
        """Let the tree await the outputs with subscribers; for subscribers of frameTime alone, each block."""
        with self._awaiting:
            ports = tuple(self._ports.items())
            subscribed = {processor for processor, port in ports if port.publisher.has_subscribers}
            if not subscribed and self._frame_time.has_subscribers:
                subscribed = {processor for processor, _ in ports if processor.parent is None}
            for processor, _ in ports:
                processor.awaited = processor in subscribed

    # --- events of the tree, on its threads ---

    def on_added(self, processor: Processor) -> None:
        """Open the processor's port and publish zeros."""
        kind = processor.kind
        publisher = self._input_port if kind == "input" else self._advertise(kind, processor.name)
        newest = NewestMessage(_message_builder(processor))  # is built when there is a subscriber
        port = _OutputPort(publisher, functools.partial(publisher.publish_newest, newest))
        self._ports[processor] = port
        self._await_subscribed()
        self.health.added(processor, self._meters[kind])
        port.publish()

    def on_released(self, processor: Processor, block: Block) -> None:
        """Publish the processor's window; for the input also the capture time of its newest frame."""
        self._ports[processor].publish()
        if processor.parent is None:
            self._publish_frame_time(block.next_index - 1)

    def _publish_frame_time(self, frame: int) -> None:
        line = self._captured(frame)
        if line is not None and 0 <= line.time < MAX_TIME:  # a publisher of audio can send any stamp
            self._newest_frame = (frame, line)
            self._frame_time.publish_newest(self._newest_time)

    def _build_time(self) -> Any:
        frame, line = self._newest_frame
        seconds, nanoseconds = divmod(round(line.time * 1e9), 1_000_000_000)
        return self._time_class(stamp={"sec": seconds, "nsec": nanoseconds}, frameIndex=frame, sampleRate=line.rate)

    def on_removed(self, processor: Processor) -> None:
        """Close the port and end the activity."""
        self.health.ended(processor)
        port = self._ports.pop(processor, None)
        if port is not None and port.publisher is not self._input_port:  # None if it could not be opened
            port.publisher.unregister()
        activity = self._activities.get(processor)
        if activity is not None:
            activity.interrupt("")

    def _advertise(self, kind: str, name: str = "") -> Publisher:
        message_class = serialization.message_class("rosAFE", LAYOUTS[kind].idl)
        publisher = self._node.advertise(KINDS[kind].port, message_class, name)
        publisher.impl.on_change = self._await_subscribed
        return publisher
