"""A real graph for benchmarks: a private master, both nodes, the default tree, and subscribers in other processes."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
import xmlrpc.client
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from rosafe.demo.processes import Child, ProcessGroup  # noqa: E402
from rosafe.demo.session import NAMES, DemoSession  # noqa: E402
from rosafe.interface import CORE_REPRESENTATIONS, KINDS, ROSAFE  # noqa: E402

PYTHON = "/usr/bin/python3"
AUDIO = "/bass/Audio"
RATE = 44100
UP_SECONDS = 20.0


def topic(kind: str) -> str:
    """The topic of the default tree's processor of a kind."""
    port = ROSAFE.port(KINDS[kind].port)
    return f"/rosAFE/{port.name}" + (f"/{KINDS[kind].name}" if port.multiple else "")


class Subscriber:
    """A process that subscribes to some topics with the zero-copy classes; `close` tells what came."""

    def __init__(self, children: ProcessGroup, folder: str, topics: Iterable[str]) -> None:
        self._result = Path(tempfile.mkdtemp(dir=folder)) / "result.json"
        self.child: Child = children.start(PYTHON, str(HERE / "subscriber.py"), str(self._result), *topics)

    def close(self) -> dict[str, Any]:
        """End it; what came, by topic: a list of [lastFrameIndex, monotonic seconds, ...]."""
        self.child.process.terminate()
        if self.child.process.wait(UP_SECONDS) != 0:
            raise RuntimeError(f"the subscriber has failed: {self.child.err}")
        return json.loads(self._result.read_text())


class Bench:
    """The running nodes; `bench` makes one."""

    def __init__(self, session: DemoSession, children: ProcessGroup, folder: str) -> None:
        self.session = session
        self._children = children
        self._folder = folder

    def call(self, service: str, **fields: Any) -> None:
        """Make one request that must succeed."""
        import rospy
        import rosservice

        answer = rospy.ServiceProxy(service, rosservice.get_service_class_by_name(service))(**fields)
        if not answer.genom_success:
            raise RuntimeError(f"{service}: {answer.genom_exdetail}")

    def build(self, block: int, port_seconds: float, chunk: int, device: str = "scene:") -> None:
        """Start the sound, in chunks of so many frames, and all seven processors on blocks of so many."""
        self.call("/rosAFE/connect_port", local="Audio", remote=AUDIO)
        self.call("/bass/Acquire", device=device, sampleRate=RATE, nFramesPerChunk=chunk, nChunksOnPort=20)
        self.call("/rosAFE/InputProc", nFramesPerBlock=block, bufferSize_s_port=port_seconds)
        for kind in CORE_REPRESENTATIONS.values():
            if kind.parent:
                self.call(f"/rosAFE/{kind.request}", name=NAMES[kind.kind], upperDepName=NAMES[kind.parent])

    def subscribe(self, topics: Iterable[str]) -> Subscriber:
        """Subscribe from another process; something has come on every topic when this returns."""
        subscriber = Subscriber(self._children, self._folder, topics)
        self.session.wait(lambda: "ready" in subscriber.child.out, UP_SECONDS, "the subscriber hears nothing")
        return subscriber

    def health(self) -> str:
        """What the node says of its sound on /diagnostics."""
        import rospy
        from diagnostic_msgs.msg import DiagnosticArray

        end = time.monotonic() + UP_SECONDS
        while time.monotonic() < end:
            for status in rospy.wait_for_message("/diagnostics", DiagnosticArray, UP_SECONDS).status:
                if "rosAFE" in status.name and status.name.endswith("audio"):
                    return str(status.message)
        raise RuntimeError("the node tells nothing on /diagnostics")

    @property
    def node(self) -> int:
        """Process id of the rosAFE node."""
        import rosgraph

        address = rosgraph.Master("/benchmark").lookupNode("/rosAFE")
        return int(xmlrpc.client.ServerProxy(address).getPid("/benchmark")[2])


def resident(pid: int) -> float:
    """Resident memory of a process in MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@contextmanager
def bench() -> Iterator[Bench]:
    """Both nodes on a private master; everything ends with it."""
    with tempfile.TemporaryDirectory() as folder, DemoSession(folder, lambda: None) as session:
        session.start_nodes()
        session.join()
        with ProcessGroup(os.environ) as children:
            yield Bench(session, children, folder)
