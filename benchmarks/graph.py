"""A ROS graph for benchmarks: a private master, both nodes, the default tree, and subscribers in other processes."""

from __future__ import annotations

import json
import multiprocessing
import os
import queue
import sys
import tempfile
import time
import xmlrpc.client
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
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
    """Return the topic of the default processor of a kind."""
    port = ROSAFE.port(KINDS[kind].port)
    return f"/rosAFE/{port.name}" + (f"/{KINDS[kind].name}" if port.multiple else "")


class Subscriber:
    """A process that subscribes to some topics with the zero-copy classes; `close` returns the received messages."""

    def __init__(self, children: ProcessGroup, folder: str, topics: Iterable[str]) -> None:
        self._result = Path(tempfile.mkdtemp(dir=folder)) / "result.json"
        self.child: Child = children.start(PYTHON, str(HERE / "subscriber.py"), str(self._result), *topics)

    def close(self) -> dict[str, Any]:
        """End the process; return a list of [lastFrameIndex, monotonic seconds, ...] for each topic."""
        self.child.process.terminate()
        if self.child.process.wait(UP_SECONDS) != 0:
            raise RuntimeError(f"the subscriber failed: {self.child.err}")
        return json.loads(self._result.read_text())


class Bench:
    """The running nodes; created by `bench`."""

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

    def start_sound(self, chunk: int, device: str = "scene:") -> None:
        """Start the sound in chunks of `chunk` frames and connect rosAFE to it."""
        self.call("/rosAFE/connect_port", local="Audio", remote=AUDIO)
        self.call("/bass/Acquire", device=device, sampleRate=RATE, nFramesPerChunk=chunk, nChunksOnPort=20)

    def build(self, block: int, port_seconds: float, chunk: int, device: str = "scene:") -> None:
        """Start the sound in chunks of `chunk` frames, and all seven processors on blocks of `block` frames."""
        self.start_sound(chunk, device)
        self.call("/rosAFE/InputProc", nFramesPerBlock=block, bufferSize_s_port=port_seconds)
        for kind in CORE_REPRESENTATIONS.values():
            if kind.parent:
                self.call(f"/rosAFE/{kind.request}", name=NAMES[kind.kind], upperDepName=NAMES[kind.parent])

    def subscribe(self, topics: Iterable[str]) -> Subscriber:
        """Subscribe from another process; return after the first message on every topic."""
        subscriber = Subscriber(self._children, self._folder, topics)
        self.session.wait(
            lambda: "ready" in subscriber.child.out, UP_SECONDS, "the subscriber received no message on some topic"
        )
        return subscriber

    def start(self, *command: str) -> Child:
        """Start a command in the graph."""
        return self._children.start(*command)

    def health(self) -> str:
        """Return the status of the node's audio on /diagnostics."""
        import rospy
        from diagnostic_msgs.msg import DiagnosticArray

        received: queue.SimpleQueue[Any] = queue.SimpleQueue()
        subscriber = rospy.Subscriber("/diagnostics", DiagnosticArray, received.put)
        end = time.monotonic() + UP_SECONDS
        try:
            while time.monotonic() < end:
                for status in received.get(timeout=UP_SECONDS).status:  # of any node
                    if "rosAFE" in status.name and status.name.endswith("audio"):
                        return str(status.message)
        except queue.Empty:
            pass
        finally:
            subscriber.unregister()
        raise RuntimeError("no status of the audio on /diagnostics")

    def pid(self, node: str) -> int:
        """Return the process id of a node, such as `/rosAFE`."""
        import rosgraph

        address = rosgraph.Master("/benchmark").lookupNode(node)
        return int(xmlrpc.client.ServerProxy(address).getPid("/benchmark")[2])


def resident(pid: int) -> float:
    """Return the resident memory of a process in MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def in_child(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a process of its own, because rospy joins one graph per process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


@contextmanager
def bench() -> Iterator[Bench]:
    """Run both nodes with a private master; all processes end with the context."""
    with tempfile.TemporaryDirectory() as folder, closing(DemoSession(folder, lambda: None)) as session:
        session.start_nodes()
        session.join()
        with closing(ProcessGroup(os.environ)) as children:
            yield Bench(session, children, folder)
