"""A subscriber in a process of its own: what came on some topics, when, and how much memory it took.

``subscriber.py RESULT TOPIC...`` subscribes with the zero-copy classes until it is told to end (SIGTERM), and then
writes RESULT: for each topic a list of [lastFrameIndex, when it came], for bass's with [when it was acquired] besides,
in seconds of the monotonic clock; and the memory in MB by the second.
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


def resident(pid: int | str = "self") -> float:
    """Resident memory of a process in MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


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
    memory = []
    while not ended.wait(1.0):
        memory.append(resident())
    Path(result).write_text(json.dumps({"came": came, "memory": memory}))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
