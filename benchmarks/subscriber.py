"""A subscriber in a process of its own: what came on some topics, and when.

``subscriber.py RESULT TOPIC...`` subscribes with the zero-copy classes, prints "ready" when something has come on every
topic, and goes on until it is told to end (SIGTERM). Then it writes RESULT: for each topic a list of [lastFrameIndex,
when it came], for bass's with [when it was acquired] besides, in seconds of the monotonic clock.
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
    """Subscribe, wait, write."""
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    rospy.init_node(f"subscriber_{os.getpid()}", disable_signals=True)
    came: dict[str, list[Any]] = {name: [] for name in names}

    def take(message: Any, name: str) -> None:
        now = time.monotonic()
        entry = [message.lastFrameIndex, now]
        if hasattr(message, "stamp"):
            entry.append(message.stamp.sec + message.stamp.nsec / 1e9 - time.time() + now)
        came[name].append(entry)

    for name in names:
        data_class = rostopic.get_topic_class(name, blocking=True)[0]
        rospy.Subscriber(name, array_msg(data_class), take, callback_args=name, buff_size=2**22, tcp_nodelay=True)
    gc.freeze()  # as docs/subscribers.md says
    while not all(came.values()) and not ended.wait(0.02):
        continue
    print("ready", flush=True)
    ended.wait()
    Path(result).write_text(json.dumps(came))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
