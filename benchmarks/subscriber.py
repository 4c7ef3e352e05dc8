"""A subscriber in a separate process, which records the messages on some topics with their times.

``subscriber.py RESULT TOPIC...`` subscribes with the zero-copy classes, prints "ready" after the first message on every
topic, and runs until SIGTERM. Then it writes RESULT: for each topic a list of [lastFrameIndex, time of arrival], for
bass's topic also the time of acquisition, in seconds of the monotonic clock.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import rospy
import rostopic

from rosafe.ros import array_msg


def main(result: str, *names: str) -> int:
    """Subscribe, wait and write."""
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    rospy.init_node(f"subscriber_{os.getpid()}", disable_signals=True)
    received: dict[str, list[Any]] = {name: [] for name in names}

    def receive(message: Any, name: str) -> None:
        now = time.monotonic()
        entry = [message.lastFrameIndex, now]
        if hasattr(message, "stamp"):
            entry.append(message.stamp.sec + message.stamp.nsec / 1e9 - time.time() + now)
        received[name].append(entry)

    for name in names:
        data_class = rostopic.get_topic_class(name, blocking=True)[0]
        rospy.Subscriber(name, array_msg(data_class), receive, callback_args=name, buff_size=2**22, tcp_nodelay=True)
    gc.freeze()  # as docs/subscribers.md says
    while not all(received.values()) and not ended.wait(0.02):
        continue
    print("ready", flush=True)
    ended.wait()
    Path(result).write_text(json.dumps(received))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
