"""Connects subscribers to the publishers that the master lists, with a small number of threads.

rospy starts a thread for each publisher in each list. The thread retries forever, even if the publisher no longer
exists, and waits up to a minute for each answer. Any client can send such lists. Here a few threads contact the
publishers in the newest list of a topic, the one that is due first, and retry with increasing pauses.
"""

from __future__ import annotations

import threading
import time
from typing import Any

import rospy
from rospy.impl.registration import RegManager, get_topic_manager

from rosafe.ros1.transport import master

MAX_PUBLISHERS = 100  # connections of one topic
MAX_THREADS = 4
FIRST_PAUSE, MAX_PAUSE = 0.5, 30.0  # seconds before a publisher that did not answer is contacted again


class Connector:
    """Replacement for the part of rospy's RegManager that handles the master's lists of publishers."""

    def __init__(self, manager: RegManager) -> None:
        self._handler = manager.handler
        self._changed = threading.Condition()
        self._requested: dict[tuple[str, str], tuple[float, float]] = {}  # (topic, address) -> (due time, next pause)
        self._in_progress: set[tuple[str, str]] = set()
        self._threads = 0
        manager.publisher_update = self.update

    def update(self, topic: str, addresses: list[str]) -> None:
        """Connect to the publishers of a topic at these XML-RPC addresses, and stop retrying others of the topic."""
        listed = dict.fromkeys(addresses[:MAX_PUBLISHERS])
        with self._changed:
            for key in [key for key in self._requested if key[0] == topic and key[1] not in listed]:
                del self._requested[key]
            if get_topic_manager().has_subscription(topic):
                for address in listed:
                    self._requested.setdefault((topic, address), (time.monotonic(), FIRST_PAUSE))
            while self._threads < min(MAX_THREADS, len(self._requested)):
                threading.Thread(target=self._run, name="connector", daemon=True).start()
                self._threads += 1
            self._changed.notify_all()

    def _run(self) -> None:
        """Contact publishers until no connection is missing."""
        while True:
            with self._changed:
                due = {key: when for key, (when, _) in self._requested.items() if key not in self._in_progress}
                if not due or rospy.is_shutdown():
                    self._threads -= 1
                    return
                key = min(due, key=due.__getitem__)
                if due[key] > time.monotonic():
                    self._changed.wait(due[key] - time.monotonic())
                    continue
                self._in_progress.add(key)
            try:
                self._connect(*key)
                finished = True
            except Exception as problem:  # retry later
                rospy.logdebug(f"{key[0]}: publisher {key[1]} cannot be called: {problem}")
                finished = isinstance(problem, ConnectionRefusedError)  # it no longer exists
            with self._changed:
                self._in_progress.remove(key)
                if finished:
                    self._requested.pop(key, None)
                elif key in self._requested:
                    _, pause = self._requested[key]
                    self._requested[key] = time.monotonic() + pause, min(2 * pause, MAX_PAUSE)

    def _connect(self, topic: str, address: str) -> None:
        """Connect to a publisher, unless that is no longer necessary; raises an exception if it does not answer."""
        subscription = get_topic_manager().get_subscriber_impl(topic)
        if (
            subscription is None
            or subscription.has_connection(address)
            or subscription.get_num_connections() >= MAX_PUBLISHERS
        ):
            return
        (transports,) = self._handler.protocol_handlers
        with master.proxy(address) as publisher:
            answer: Any = publisher.requestTopic(rospy.get_name(), topic, transports.get_supported())
        code, _, protocol = answer
        if code == 1:
            transports.create_transport(topic, address, protocol)
