"""Action servers of a node, and one thread that publishes the status of all of them periodically."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any

import actionlib
import rospy
from actionlib_msgs.msg import GoalStatusArray

from rosafe.ros1.transport.buffer_list import BufferList
from rosafe.ros1.transport.publisher import Publisher

DEFAULT_FREQUENCY = 5.0  # Hz, as of every action server
MAX_FREQUENCY = 100.0  # Hz


class ActionServer(actionlib.ActionServer):
    """actionlib's server without a timer of its own: `StatusPublisher` publishes its status.

    Parameters
    ----------
    in_use : threading.Event
        Set when the server gets a goal, or its status a subscriber.
    """

    frequency: Any = DEFAULT_FREQUENCY  # the value of the ROS parameter

    def __init__(self, in_use: threading.Event, *arguments: Any) -> None:
        self._in_use = in_use
        super().__init__(*arguments, auto_start=False)

    @property
    def status_frequency(self) -> float:
        """0, for which actionlib starts no timer; the value of the parameter goes to `frequency`."""
        return 0.0

    @status_frequency.setter
    def status_frequency(self, value: Any) -> None:
        self.frequency = value

    def initialize(self) -> None:
        """Create publishers and subscribers."""
        status = Publisher(f"{rospy.remap_name(self.ns)}/status", GoalStatusArray)  # actionlib's will be the same topic
        status.impl.on_connection = self._in_use.set
        super().initialize()

    def publish_status(self) -> None:
        """Publish the status of all goals now."""
        super().publish_status()
        if self.status_list:
            self._in_use.set()

    def publish_again(self, idle: BufferList) -> bool:
        """Publish the status; `idle` is that of a server without goals. Return whether the server is in use."""
        if self.status_list:
            self.publish_status()
            return True
        return bool(self.status_pub.impl.send(idle))


class StatusPublisher:
    """Publishes the status of all action servers of a node periodically, on one thread.

    Clients discover a server by its status, and treat a server that does not publish it as lost. Servers without goals
    and subscribers need no computing time; a new subscriber gets the last status immediately.

    Parameters
    ----------
    finished : threading.Event
        Ends it.
    """

    def __init__(self, finished: threading.Event) -> None:
        self._servers: list[ActionServer] = []
        self._finished = finished
        self._in_use = threading.Event()

    def add(self, name: str, action: Any, accept: Callable[[Any], None], cancel: Callable[[Any], None]) -> ActionServer:
        """Start the server of an action."""
        server = ActionServer(self._in_use, name, action, accept, cancel)
        server.start()
        self._servers.append(server)
        return server

    def run(self) -> None:
        """Publish at the frequency of the ROS parameter until the node ends."""
        frequency = _frequency(self._servers[0].frequency)
        message = GoalStatusArray()
        while frequency and not self._finished.wait(min(1 / frequency, threading.TIMEOUT_MAX)):
            self._in_use.wait()
            self._in_use.clear()
            message.header.seq += 1
            message.header.stamp = rospy.Time.now()
            idle = BufferList()
            message.serialize(idle)
            if sum(server.publish_again(idle) for server in self._servers):  # each of them publishes
                self._in_use.set()


def _frequency(value: Any) -> float:
    """Return the frequency in Hz for the parameter's `value`; 0 if the status is not published periodically."""
    number = float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan
    if number <= 0:
        return 0.0
    if not number <= MAX_FREQUENCY:
        rospy.logwarn(
            f"actionlib_status_frequency: expected a number up to {MAX_FREQUENCY:g}, got {value!r:.80}; "
            f"{DEFAULT_FREQUENCY:g} Hz are used"
        )
        return DEFAULT_FREQUENCY
    return number
