"""Connects our subscribers to the publishers that the master names, a few at a time.

rospy has a thread for each publisher of each list that comes, which asks for ever, also where the publisher is long
gone, and waits a minute for each answer. Anybody can send such lists. Here a few threads ask all that are on the newest
list of a topic, again and again with growing pauses, and first those that were asked longest ago.
"""

from __future__ import annotations

import threading
import time
from typing import Any

import rospy
from rospy.impl.registration import RegManager, get_topic_manager

from rosafe.transport import master

PUBLISHERS = 100  # of one topic that are connected to
ASKING = 4  # threads at most
FIRST_PAUSE, LONGEST_PAUSE = 0.5, 30.0  # seconds before a publisher that did not answer is asked again


class Connector:
    """Does what rospy's RegManager did with the master's lists of publishers."""

    def __init__(self, manager: RegManager) -> None:
        self._handler = manager.handler
        self._turn = threading.Condition()
        self._wanted: dict[tuple[str, str], tuple[float, float]] = {}  # (topic, address) -> (when, pause after that)
        self._asking: set[tuple[str, str]] = set()
        self._threads = 0
        manager.publisher_update = self.update

    def update(self, topic: str, addresses: list[str]) -> None:
        """Have connections to the publishers of a topic at these XML-RPC addresses, and seek no others any more."""
        listed = dict.fromkeys(addresses[:PUBLISHERS])
        with self._turn:
            for key in [key for key in self._wanted if key[0] == topic and key[1] not in listed]:
                del self._wanted[key]
            if get_topic_manager().has_subscription(topic):
                for address in listed:
                    self._wanted.setdefault((topic, address), (time.monotonic(), FIRST_PAUSE))
            while self._threads < min(ASKING, len(self._wanted)):
                threading.Thread(target=self._run, name="connector", daemon=True).start()
                self._threads += 1
            self._turn.notify_all()

    def _run(self) -> None:
        """Ask for as long as anybody is wanted."""
        while True:
            with self._turn:
                free = {key: when for key, (when, _) in self._wanted.items() if key not in self._asking}
                if not free or rospy.is_shutdown():
                    self._threads -= 1
                    return
                key = min(free, key=free.__getitem__)
                if free[key] > time.monotonic():
                    self._turn.wait(free[key] - time.monotonic())
                    continue
                self._asking.add(key)
            try:
                settled = self._connect(*key)
            except Exception as problem:  # the next one may be better
                rospy.logdebug(f"{key[0]}: {key[1]} cannot be asked: {problem}")
                settled = isinstance(problem, ConnectionRefusedError)  # it is gone
            with self._turn:
                self._asking.remove(key)
                if settled:
                    self._wanted.pop(key, None)
                elif key in self._wanted:
                    _, pause = self._wanted[key]
                    self._wanted[key] = time.monotonic() + pause, min(2 * pause, LONGEST_PAUSE)

    def _connect(self, topic: str, address: str) -> bool:
        """Whether a publisher need not be asked again."""
        subscription = get_topic_manager().get_subscriber_impl(topic)
        if subscription is None or subscription.has_connection(address):
            return True
        if subscription.get_num_connections() >= PUBLISHERS:
            return True
        (transports,) = self._handler.protocol_handlers
        with master.proxy(address) as publisher:
            answer: Any = publisher.requestTopic(rospy.get_name(), topic, transports.get_supported())
        code, _, where = answer
        if code == 1:
            transports.create_transport(topic, address, where)
        return True
