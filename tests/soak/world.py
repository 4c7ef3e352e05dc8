"""The nodes of the soak, their audio, and the checks that must pass during and after every fault."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import genpy
import numpy as np
import rospy
import soundfile

from rosafe.interface import BASS, CORE_REPRESENTATIONS, ROSAFE
from rosafe.interface.arguments import check_parameters
from rosafe.processing.chain import Chain
from rosafe.ros1.component import serialization, state_publisher
from rosafe.ros1.transport import registration
from rosafe.tree.history import SlidingWindow, frames_in
from tests import harness
from tests.harness import free_port, freeze, proc, run_together, wait_for
from tests.ros1.afe.session import Session, assert_holds
from tests.soak.robot import Robot
from tests.web.genomix.world import Http, genomixd

NAMES = {kind: ROSAFE.service(entry.request).parameter("name").default for kind, entry in CORE_REPRESENTATIONS.items()}
TREE = {kind: [name] for kind, name in NAMES.items()}
CHUNKS = 20  # on bass' port, as by default
DRIFT = 0.15  # s, maximum deviation of bass' frames from the clock: one chunk, and a busy machine
SLOWER = 3.0  # an answer may take this many times the first one's time, if the machine is busy
MORE_MEMORY = 64 * 2**20  # bytes, maximum increase after an attack
TRIM_SECONDS = 1.1 * state_publisher.TRIM_ROUNDS * state_publisher.DIAGNOSTICS_PERIOD
MORE_THREADS, MORE_FILES = 8, 16  # likewise: clients that are disconnecting
T = TypeVar("T")


@dataclass(frozen=True)
class Size:
    """The load of a soak."""

    rate: int
    chunk: int
    block: int
    channels: int  # 0: the default
    crowd: int  # processors that are added together
    cycles: int  # of creation and removal in a round
    connections: int  # of an attack on one port
    mixed_seconds: float  # of all attacks together
    answer_seconds: float  # maximum time until a new client is answered


DEFAULT = Size(44100, 2205, 12000, 0, 200, 100, 2100, 60.0, 2.0)
LIGHT = Size(20000, 800, 4000, 3, 48, 10, 300, 3.0, 6.0)  # while other tests run


@dataclass
class ResourceUse:
    """The resources of a process."""

    threads: int
    files: int
    memory: int  # resident bytes

    @classmethod
    def of(cls, pid: int) -> ResourceUse:
        status = dict(line.split(":", 1) for line in proc(pid, "status").read_text().splitlines())
        return cls(int(status["Threads"]), len(list(proc(pid, "fd").iterdir())), int(status["VmRSS"].split()[0]) * 1024)

    def exceeds(self, other: ResourceUse) -> str:
        """Return the resource that exceeds `other` by more than the limit, or an empty string."""
        if self.memory > other.memory + MORE_MEMORY:
            return "memory"
        if self.threads > other.threads + MORE_THREADS:
            return "threads"
        return "files" if self.files > other.files + MORE_FILES else ""

    def __str__(self) -> str:
        return f"{self.threads} threads, {self.files} files, {self.memory / 2**20:.0f} MiB"


class World:
    """A master, bass, rosAFE and genomixd, and the rest of a robot.

    bass plays noise in a loop, so that a frame's number determines it.
    """

    def __init__(self, size: Size, graph: harness.Graph, master: harness.MasterProcess, stack: ExitStack) -> None:
        self.size = size
        self.graph = graph
        self.master = master
        self.refused = 0  # messages that were garbage
        self.slowest = (0.0, "")  # answer to a new client: seconds, request
        self._second_service = False
        self._first_seconds: dict[str, float] = {}  # time of the first answer, by request
        self._bass = ExitStack()
        self.sound = self._noise(int(7.3 * size.rate))
        self._file = graph.home / "noise.wav"
        soundfile.write(self._file, self.sound.T, size.rate, subtype="PCM_32")
        stack.callback(self._bass.close)
        self.start_bass()
        self.afe = Session(graph, stack.enter_context(graph.node("rosAFE-ros")))
        stack.callback(self.afe.close)
        self.genomixd, port = stack.enter_context(genomixd(graph))
        self.http = Http(port)
        self.http_address = "127.0.0.1", port
        self.acquire()
        self.afe.ok("connect_port", local="Audio", remote="bass/Audio")
        self._stack = stack
        self._robot: Robot | None = None

    @property
    def robot(self) -> Robot:
        """The localizer, the live page and the ROS 2 node, which are started when they are used first."""
        if self._robot is None:
            self._robot = Robot(self.graph, self._stack)
        return self._robot

    def processes(self) -> dict[str, harness.Process]:
        """Return all processes that run."""
        own = {"rosAFE": self.afe.process, "bass": self.bass, "genomixd": self.genomixd}
        return own | (self._robot.processes if self._robot is not None else {})

    @staticmethod
    def _noise(frames: int) -> np.ndarray:
        """Binaural int32 noise, (2, frames), without zeros: a zero on a port is a lost frame."""
        chance = np.random.default_rng(1)
        return (chance.integers(2**10, 2**30, (2, frames)) * chance.choice([-1, 1], (2, frames))).astype(np.int32)

    def frames(self, first: int, count: int) -> np.ndarray:
        """Return `count` frames that bass plays from number `first` on (the first one is 1), (2, count)."""
        return self.sound[:, (np.arange(first - 1, first - 1 + count)) % self.sound.shape[1]]

    @property
    def window_seconds(self) -> float:
        """Length of bass' window."""
        return CHUNKS * self.size.chunk / self.size.rate

    # --- bass ---

    def start_bass(self) -> None:
        """Start bass-ros, for the first time or after it was killed."""
        self._bass.close()
        self.bass = self._bass.enter_context(self.graph.node("bass-ros"))
        self.socket_address = "127.0.0.1", free_port()
        rospy.set_param("/bass/socket_port", self.socket_address[1])
        assert self.graph.call("/bass/DedicatedSocket").genom_success

    def acquire(self) -> None:
        """Restart the stream of bass with frame 1."""
        answer = self.graph.call(
            "/bass/Acquire",
            device=f"file:{self._file}?loop=1",
            nFramesPerChunk=self.size.chunk,
            nChunksOnPort=CHUNKS,
        )
        assert answer.genom_success, answer.genom_exdetail

    def audio(self) -> tuple[int, float]:
        """Return index and time of bass' newest frame."""
        message = self.graph.message("/bass/Audio", accept=lambda m: m.lastFrameIndex > 0)
        return message.lastFrameIndex, message.stamp.sec + message.stamp.nsec / 1e9

    # --- the tree ---

    @contextmanager
    def stream(self) -> Iterator[None]:
        """Build the whole tree on a stream that begins with frame 1, and check all its output at the end.

        No frame may be lost, and bass must keep time.
        """
        assert self.graph.call("/bass/Stop").genom_success
        self.afe.ok("Stop")
        self.afe.ok("InputProc", nFramesPerBlock=self.size.block)
        for kind in list(CORE_REPRESENTATIONS.values())[1:]:
            few = {"fb_nChannels": self.size.channels} if kind.kind == "gammatone" else {}
            self.afe.ok(kind.request, **few)
        before = self.counters()
        self.acquire()
        first_index, first_time = self.audio()
        yield
        index, time = self.audio()
        drift = (index - first_index) / self.size.rate - (time - first_time)
        assert abs(drift) < DRIFT, f"bass is {drift:.3f} s off the clock after {time - first_time:.1f} s"
        assert self.afe.processors() == TREE, f"the tree is {self.afe.processors()}"
        assert self.graph.call("/bass/Stop").genom_success
        self.verify()
        after = self.counters()
        for name in ("lost", "breaks"):
            assert after[name] == before[name], f"{name}: {after[name] - before[name]} more; {after['last loss']}"
        assert after["refused"] == self.refused, f"{after['refused']} messages refused, {self.refused} were garbage"

    def verify(self) -> None:
        """Check that all ports contain exactly the output of `rosafe.process` for the same frames."""
        end = self.graph.message("/bass/Audio").lastFrameIndex // self.size.block * self.size.block
        expected = {}

        def keep(kind: str, branch: int, block: Any) -> None:
            if kind not in expected:
                expected[kind] = SlidingWindow(block.data.shape[:-1], frames_in(1.0, block.rate))
            expected[kind].append(block.data)

        parameters = check_parameters({"fb_nChannels": self.size.channels} if self.size.channels else {})
        blocks = (self.frames(first, self.size.block) for first in range(1, end, self.size.block))
        with Chain(
            blocks, self.size.rate, {"in_doNormalize": True, **parameters}, list(CORE_REPRESENTATIONS), keep
        ) as chain:
            chain.run()
        for kind in CORE_REPRESENTATIONS:
            assert_holds(self.afe.read(kind, end + 1), kind, expected[kind].padded_view(expected[kind].frames).array())

    def counters(self) -> dict[str, Any]:
        """Return the counters of the audio, from /diagnostics."""
        entries = self.afe.health(lambda _: True, "audio")
        return {key: int(value) if value.isdigit() else value for key, value in entries.items()}

    def check_alive(self) -> None:
        """Check that all processes are running, and that none has logged a traceback."""
        for process in self.processes().values():
            assert process.alive, f"it has ended: {process}"
            assert "Traceback" not in process.err, process
        assert self.http.call("rosAFE/getParameters")["parameters"]["input"][0]["name"] == "input"

    def use(self) -> dict[str, ResourceUse]:
        """Return the resources of the processes."""
        return {name: ResourceUse.of(process.pid) for name, process in self.processes().items()}

    def use_without_tree(self) -> dict[str, ResourceUse]:
        """Remove all processors, and return the resources of the processes after unused memory was returned.

        The memory of a tree in use varies by more than 200 MiB, with the messages that wait for subscribers.
        """
        assert self.graph.call("/bass/Stop").genom_success
        self.afe.ok("Stop")
        wait_out(TRIM_SECONDS)
        return self.use()

    # --- attacks ---

    def check_responsive(self, when: str = "") -> None:
        """Check that new clients are answered in time: rosservice and rostopic by the nodes in turn, and HTTP."""
        services = [("/rosAFE/getDependencies", "{nameProc: input}"), ("/bass/abort_activity", "{activity: 0}")]
        topics = ["/bass/Audio", self.afe.topic("ild")]
        service, topic = services[0], topics[0]
        if self._second_service:
            service, topic = services[1], topics[1]
        self._second_service = not self._second_service
        commands = [("rosservice", "call", *service), ("rostopic", "echo", "-n", "1", "--noarr", topic)]

        def run(number: int) -> str:
            return self.quick(commands[number][0], lambda: self.graph.run(*commands[number]).stdout)

        called, echoed = run_together(len(commands), run)
        assert "genom_success: True" in called or "no_such_activity" in called, f"{when}: {called}"
        assert "lastFrameIndex" in echoed, f"{when}: {echoed}"
        for node in ("rosAFE", "bass"):  # clients in this process, without the time to start one
            answer = self.quick("a new client", lambda: self.graph.call(f"/{node}/abort_activity", activity=0))  # noqa: B023
            assert "no_such_activity" in answer.genom_exdetail, f"{when}: {answer}"
        answer = self.quick("HTTP", lambda: self.http.call("rosAFE/getDependencies", ["input"]))
        assert answer == {"dependencies": ["input"]}, f"{when}: {answer}"
        assert self.quick("HTTP", lambda: self.http.call("bass/genom_state"))["genom_state"], when

    def quick(self, request: str, work: Callable[[], T]) -> T:
        """Return the result of `work`, and check its time, which is recorded in `slowest`."""
        begin = time.monotonic()
        result = work()
        seconds = time.monotonic() - begin
        self.slowest = max(self.slowest, (seconds, request))
        limit = max(self.size.answer_seconds, SLOWER * self._first_seconds.setdefault(request, seconds))
        assert seconds <= limit, f"{request} took {seconds:.2f} s, the limit is {limit:.2f}"
        return result

    def recovers(self, before: dict[str, ResourceUse]) -> None:
        """Wait until memory, threads and descriptors are down to the previous values."""

        def more() -> list[str]:
            return [
                f"{name}: {use}, before {before[name]}" for name, use in self.use().items() if use.exceeds(before[name])
            ]

        wait_for(lambda: not more(), what=lambda: f"resources are freed; {more()}")

    def bring_master(self) -> None:
        """Start a master at the address of the one that was killed, and wait until all nodes are registered there."""
        self.master.start(self.graph.env)
        expected = {
            f"/{component.name}/{service.name}" for component in (ROSAFE, BASS) for service in component.services
        }
        wait_for(lambda: expected <= self.graph.services(), what=lambda: str(expected - self.graph.services()))
        wait_for(lambda: {self.afe.topic("ild"), "/bass/Audio"} <= self.graph.topics())

    @contextmanager
    def held(self, process: harness.Process) -> Iterator[None]:
        """Stop a process inside the `with` block."""
        freeze(process.pid)
        try:
            yield
        finally:
            os.kill(process.pid, signal.SIGCONT)


class Follower:
    """Checks every message of the input's port: each frame is the one with its number, or it is lost and zero."""

    def __init__(self, world: World) -> None:
        self.lost = 0
        self.begun = 0  # streams
        self.index = 2**64  # of the next frame
        self.wrong = ""
        self._world = world
        self._lock = threading.Lock()

    def append(self, message: Any) -> None:
        """Check a message."""
        with self._lock:
            if message.lastFrameIndex < self.index:
                self.begun, self.index = self.begun + 1, 1
            fresh = min(message.lastFrameIndex - self.index, message.framesOnPort)
            self.index = message.lastFrameIndex
            if fresh > 0:
                truth = self._world.frames(message.lastFrameIndex - fresh, fresh) / (2**31 - 1)
                held = np.stack((message.left[-fresh:], message.right[-fresh:]))
                lost = (held == 0).all(axis=0)
                self.lost += int(lost.sum())
                if not self.wrong and not np.array_equal(held[:, ~lost], truth[:, ~lost]):
                    self.wrong = f"wrong samples before index {message.lastFrameIndex}"

    def wait_for_block(self) -> None:
        """Wait for another block."""
        wait_for(lambda: self.begun)
        index = self.index
        wait_for(lambda: self.index > index, what="another block")


@contextmanager
def following(world: World) -> Iterator[Follower]:
    """Follow the input's port from the next block on."""
    follower = Follower(world)
    message_class = serialization.message_class("rosAFE", ROSAFE.port("inputProcPort").idl)
    subscriber = rospy.Subscriber(world.afe.topic("input"), message_class, follower.append, buff_size=2**22)
    try:
        yield follower
    finally:
        subscriber.unregister()


@contextmanager
def world(size: Size, home: Path) -> Iterator[World]:
    """Start a world. rospy in this process is part of it."""
    with harness.private_graph(home) as (graph, master), ExitStack() as stack:
        os.environ.update(ROS_MASTER_URI=graph.uri, ROS_IP="127.0.0.1", ROS_HOME=str(home / ".ros"))
        registrar = registration.init_node("soak", ["soak"])  # it registers at a restarted master too
        genpy.Message.longest_sequence = 2**26  # in this process, long messages of the nodes are accepted
        stack.callback(registrar.end)
        yield World(size, graph, master, stack)


def later(seconds: float) -> Callable[[], bool]:
    """Return a function that returns whether `seconds` have elapsed since this call."""
    elapsed = threading.Event()
    timer = threading.Timer(seconds, elapsed.set)
    timer.daemon = True
    timer.start()
    return elapsed.is_set


def wait_out(seconds: float) -> None:
    """Wait for `seconds`."""
    wait_for(later(seconds), seconds + 10)
