"""The topic `trace` of the node: events of the processors while it has a subscriber, for `rosafe trace`."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable

import rospy
from std_msgs.msg import String

from rosafe.tree.processor import Observer
from rosafe.tree.trace import Event, Tracer

PERIOD = 0.1  # seconds between two messages


class TracePort(rospy.SubscribeListener):
    """Publishes the events of a tree as JSON while the topic has subscribers.

    Parameters
    ----------
    topic : str
    observe : callable
        `Tree.observe`.
    """

    def __init__(self, topic: str, observe: Callable[[Observer], Callable[[], None]]) -> None:
        self._observe = observe
        self._lock = threading.Lock()
        self._running = False
        self._publisher = rospy.Publisher(topic, String, self, queue_size=100, tcp_nodelay=True)

    def peer_subscribe(self, *_: object) -> None:
        """Start tracing with the first subscriber."""
        with self._lock:
            if not self._running:
                self._running = True
                threading.Thread(target=self._run, name="trace", daemon=True).start()

    def _run(self) -> None:
        tracer = Tracer()
        stop = self._observe(tracer)
        try:
            while self._has_subscribers():
                self._publisher.publish(String(json.dumps(tracer.take())))
                threading.Event().wait(PERIOD)
        finally:
            stop()

    def _has_subscribers(self) -> bool:
        with self._lock:
            self._running = not rospy.is_shutdown() and self._publisher.get_num_connections() > 0
            return self._running


def read(message: String) -> list[Event]:
    """Return the events in a message."""
    return [Event(*event) for event in json.loads(message.data)]
