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

from rosafe.interface import COMPONENTS, CORE_REPRESENTATIONS, KINDS, ROSAFE  # noqa: E402
from rosafe.ros1.component import generate  # noqa: E402
from rosafe.ros1.transport.master import PrivateMaster  # noqa: E402
from rosafe.ros1.transport.paths import program  # noqa: E402
from rosafe.system.processes import Child, ProcessGroup  # noqa: E402

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


class Session:
    """A private master with both nodes; this process is a node, too. `close` ends all of them."""

    def __init__(self, folder: str) -> None:
        for name in [name for name in os.environ if name.startswith("ROS_")]:
            del os.environ[name]
        os.environ.update(ROS_IP="127.0.0.1", ROS_LOG_DIR=folder, ROS_HOME=folder, **generate.environment())
        os.environ["PATH"] = f"{HERE.parent / 'scripts'}:{os.environ['PATH']}"
        generate.ensure_messages()
        self._master = PrivateMaster()
        os.environ["ROS_MASTER_URI"] = self._master.uri
        self._children = ProcessGroup(os.environ)
        self._nodes = [self._children.start(program(script)) for script in ("bass-ros", "rosAFE-ros")]
        import rosgraph
        import rospy

        master = rosgraph.Master("/benchmark")
        expected = {f"/{part.name}/{service.name}" for part in COMPONENTS.values() for service in part.on_graph}
        self.wait(lambda: expected <= {name for name, _ in master.getSystemState()[2]}, "the nodes do not start")
        rospy.init_node("benchmark", argv=["benchmark"], disable_signals=True, log_level=rospy.FATAL)

    def wait(self, condition: Callable[[], bool], problem: str, seconds: float = 30.0) -> None:
        """Wait for a condition; raise RuntimeError after `seconds`, or if a node ends."""
        end = time.monotonic() + seconds
        while not condition():
            ended = [node for node in self._nodes if node.has_ended()]
            if ended or time.monotonic() > end:
                raise RuntimeError(f"{problem}: {[node.err for node in ended]}")
            time.sleep(0.02)

    def close(self) -> None:
        """End all processes."""
        import rospy

        self._children.close()
        rospy.signal_shutdown("the benchmark is over")
        self._master.close()


class Bench:
    """The running nodes; created by `bench`."""

    def __init__(self, session: Session, children: ProcessGroup, folder: str) -> None:
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
                self.call(f"/rosAFE/{kind.request}", name=kind.name, upperDepName=KINDS[kind.parent].name)

    def subscribe(self, topics: Iterable[str]) -> Subscriber:
        """Subscribe from another process; return after the first message on every topic."""
        subscriber = Subscriber(self._children, self._folder, topics)
        self.session.wait(
            lambda: "ready" in subscriber.child.out, "the subscriber received no message on some topic", UP_SECONDS
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
    with (
        tempfile.TemporaryDirectory() as folder,
        closing(Session(folder)) as session,
        closing(ProcessGroup(os.environ)) as children,
    ):
        yield Bench(session, children, folder)
