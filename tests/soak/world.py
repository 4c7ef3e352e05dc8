"""The nodes that are soaked, the sound that they hear, and what must hold whatever is done to them."""

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

from rosafe.component import serialization
from rosafe.interface import BASS, CORE_REPRESENTATIONS, ROSAFE
from rosafe.interface.arguments import check_parameters
from rosafe.offline.chain import Chain
from rosafe.transport import registration
from rosafe.tree.sliding_window import SlidingWindow, frames_in
from tests import harness
from tests.genomix.world import Http, genomixd
from tests.harness import free_port, proc, run_together, wait_for
from tests.ros.session import Session, assert_holds

NAMES = {kind: ROSAFE.service(entry.request).parameter("name").default for kind, entry in CORE_REPRESENTATIONS.items()}
TREE = {kind: [name] for kind, name in NAMES.items()}
CHUNKS = 20  # on bass' port, as by default
DRIFT = 0.15  # seconds that bass' frames may be off the clock: a chunk more or less, and a busy machine
SLOWER = 3.0  # or so many times what it took before, where the machine has much other work
PEAK_MEMORY = 160 * 2**20  # bytes that a process may take for a moment, for what others say is to come
MORE_MEMORY = 64 * 2**20  # bytes that a process may have more once all is over
MORE_THREADS, MORE_FILES = 8, 16  # and threads and files: clients that are just leaving
T = TypeVar("T")


@dataclass(frozen=True)
class Size:
    """How much is asked of the machine."""

    rate: int
    chunk: int
    block: int
    channels: int  # 0: as by default
    crowd: int  # processors at once, besides the tree
    cycles: int  # of creation and removal in a round
    connections: int  # of those who mean ill, to one port
    mixed_seconds: float  # of all of it at once
    answer_seconds: float  # for a fresh client to be answered, whatever others do


DEFAULT = Size(44100, 2205, 12000, 0, 200, 100, 2100, 60.0, 2.0)
LIGHT = Size(20000, 800, 4000, 3, 48, 10, 300, 3.0, 6.0)  # beside other tests


@dataclass
class Use:
    """What one process takes of the machine."""

    threads: int
    files: int
    memory: int  # resident bytes

    @classmethod
    def of(cls, pid: int) -> Use:
        status = dict(line.split(":", 1) for line in proc(pid, "status").read_text().splitlines())
        return cls(int(status["Threads"]), len(list(proc(pid, "fd").iterdir())), int(status["VmRSS"].split()[0]) * 1024)

    def exceeds(self, other: Use) -> str:
        """What is more than in `other`, if it is much."""
        if self.memory > other.memory + MORE_MEMORY:
            return "memory"
        if self.threads > other.threads + MORE_THREADS:
            return "threads"
        return "files" if self.files > other.files + MORE_FILES else ""

    def __str__(self) -> str:
        return f"{self.threads} threads, {self.files} files, {self.memory / 2**20:.0f} MiB"


class World:
    """A master, bass, rosAFE and genomixd. bass plays noise in a loop, so that a frame's number tells its samples."""

    def __init__(self, size: Size, graph: harness.Graph, master: harness.MasterProcess, stack: ExitStack) -> None:
        self.size = size
        self.graph = graph
        self.master = master
        self.refused = 0  # messages that were garbage
        self.slowest = (0.0, "")  # of the answers to fresh clients
        self._turn = False
        self._usual: dict[str, float] = {}  # seconds that such an answer took at first
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

    @staticmethod
    def _noise(frames: int) -> np.ndarray:
        """Binaural int32 noise, (2, frames), without zeros: a zero on a port is a lost frame."""
        chance = np.random.default_rng(1)
        return (chance.integers(2**10, 2**30, (2, frames)) * chance.choice([-1, 1], (2, frames))).astype(np.int32)

    def frames(self, first: int, count: int) -> np.ndarray:
        """What bass plays from frame number `first` (the first one is 1) on, (2, count)."""
        return self.sound[:, (np.arange(first - 1, first - 1 + count)) % self.sound.shape[1]]

    @property
    def window_seconds(self) -> float:
        """How long bass' window is."""
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
        """Let bass begin anew with frame 1."""
        answer = self.graph.call(
            "/bass/Acquire",
            device=f"file:{self._file}?loop=1",
            nFramesPerChunk=self.size.chunk,
            nChunksOnPort=CHUNKS,
        )
        assert answer.genom_success, answer.genom_exdetail

    def audio(self) -> tuple[int, float]:
        """Index and time of bass' newest frame."""
        message = self.graph.message("/bass/Audio", accept=lambda m: m.lastFrameIndex > 0)
        return message.lastFrameIndex, message.stamp.sec + message.stamp.nsec / 1e9

    # --- the tree ---

    @contextmanager
    def stream(self) -> Iterator[None]:
        """The whole tree on a stream that begins with frame 1; at its end, all that came of it is looked at.

        Nothing may be lost in it, and bass must keep time.
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
        for what in ("lost", "breaks"):
            assert after[what] == before[what], f"{what}: {after[what] - before[what]} more; {after['last loss']}"
        assert after["refused"] == self.refused, f"{after['refused']} messages refused, {self.refused} were garbage"

    def verify(self) -> None:
        """All ports hold, bit for bit, what `rosafe.process` makes of the same frames, by their absolute numbers."""
        end = self.graph.message("/bass/Audio").lastFrameIndex // self.size.block * self.size.block
        truth = {}

        def keep(kind: str, branch: int, block: Any) -> None:
            if kind not in truth:
                truth[kind] = SlidingWindow(block.data.shape[:-1], frames_in(1.0, block.rate))
            truth[kind].append(block.data)

        parameters = check_parameters({"fb_nChannels": self.size.channels} if self.size.channels else {})
        blocks = (self.frames(first, self.size.block) for first in range(1, end, self.size.block))
        with Chain(
            blocks, self.size.rate, {"in_doNormalize": True, **parameters}, list(CORE_REPRESENTATIONS), keep
        ) as chain:
            chain.run()
        for kind in CORE_REPRESENTATIONS:
            assert_holds(self.afe.read(kind, end + 1), kind, truth[kind].view().array())

    def counters(self) -> dict[str, Any]:
        """What rosAFE counts of the audio, from /diagnostics."""
        entries = self.afe.health(lambda _: True, "audio")
        return {key: int(value) if value.isdigit() else value for key, value in entries.items()}

    def alive(self) -> None:
        """All processes are, and none has stumbled."""
        for process in (self.afe.process, self.bass, self.genomixd):
            assert process.alive, f"it has ended: {process}"
            assert "Traceback" not in process.err, process
        assert self.http.call("rosAFE/getParameters")["parameters"]["input"][0]["name"] == "input"

    def use(self) -> dict[str, Use]:
        """What the processes take."""
        processes = {"rosAFE": self.afe.process, "bass": self.bass, "genomixd": self.genomixd}
        return {name: Use.of(process.pid) for name, process in processes.items()}

    # --- attacks ---

    def unharmed(self, when: str = "") -> None:
        """Whoever comes anew is answered in time: rosservice by one node, rostopic by the other, in turn, and HTTP."""
        services = [("/rosAFE/getDependencies", "{nameProc: input}"), ("/bass/abort_activity", "{activity: 0}")]
        topics = ["/bass/Audio", self.afe.topic("ild")]
        service, topic = services[0], topics[0]
        if self._turn:
            service, topic = services[1], topics[1]
        self._turn = not self._turn
        commands = [("rosservice", "call", *service), ("rostopic", "echo", "-n", "1", "--noarr", topic)]

        def run(number: int) -> str:
            return self.quick(commands[number][0], lambda: self.graph.run(*commands[number]).stdout)

        called, heard = run_together(len(commands), run)
        assert "genom_success: True" in called or "no_such_activity" in called, f"{when}: {called}"
        assert "lastFrameIndex" in heard, f"{when}: {heard}"
        for node in ("rosAFE", "bass"):  # connections of a client that does not have to start first
            answer = self.quick("a new client", lambda: self.graph.call(f"/{node}/abort_activity", activity=0))  # noqa: B023
            assert "no_such_activity" in answer.genom_exdetail, f"{when}: {answer}"
        answer = self.quick("HTTP", lambda: self.http.call("rosAFE/getDependencies", ["input"]))
        assert answer == {"dependencies": ["input"]}, f"{when}: {answer}"
        assert self.quick("HTTP", lambda: self.http.call("bass/genom_state"))["genom_state"], when

    def quick(self, what: str, work: Callable[[], T]) -> T:
        """The result of what takes no longer than it may; how long is kept in `slowest`."""
        begin = time.monotonic()
        result = work()
        took = time.monotonic() - begin
        self.slowest = max(self.slowest, (took, what))
        limit = max(self.size.answer_seconds, SLOWER * self._usual.setdefault(what, took))
        assert took <= limit, f"{what} took {took:.2f} s, {limit:.2f} go"
        return result

    def recovers(self, before: dict[str, Use]) -> None:
        """Memory, threads and descriptors come back to what they were."""

        def more() -> list[str]:
            return [
                f"{name}: {use}, before {before[name]}" for name, use in self.use().items() if use.exceeds(before[name])
            ]

        wait_for(lambda: not more(), what=lambda: f"an end of what was taken; {more()}")

    @contextmanager
    def bounded_memory(self) -> Iterator[None]:
        """No process takes much memory meanwhile, not for a moment."""
        before = self.use()
        processes = (self.afe.process, self.bass, self.genomixd)
        for process in processes:
            proc(process.pid, "clear_refs").write_text("5")  # what it had at most is what it has
        yield
        for process, (name, use) in zip(processes, before.items(), strict=True):
            status = dict(line.split(":", 1) for line in proc(process.pid, "status").read_text().splitlines())
            peak = int(status["VmHWM"].split()[0]) * 1024
            assert peak < use.memory + PEAK_MEMORY, f"{name}: {peak / 2**20:.0f} MiB at most, before {use}"

    def refuses(self, device: str) -> None:
        """bass does not take a device, says so by name, and what it plays goes on."""
        answer = self.graph.call("/bass/Acquire", device=device)
        assert not answer.genom_success and "::bass::e_device" in answer.genom_exdetail, (device, answer)

    def bring_master(self) -> None:
        """A master comes at the address of the one that was killed, and is told of everything that is there."""
        self.master.start(self.graph.env)
        wanted = {f"/{component.name}/{service.name}" for component in (ROSAFE, BASS) for service in component.services}
        wait_for(lambda: wanted <= self.graph.services(), what=lambda: str(wanted - self.graph.services()))
        wait_for(lambda: {self.afe.topic("ild"), "/bass/Audio"} <= self.graph.topics())

    @contextmanager
    def held(self, process: harness.Process) -> Iterator[None]:
        """Stop a process for as long as the `with` lasts."""
        os.kill(process.pid, signal.SIGSTOP)
        try:
            yield
        finally:
            os.kill(process.pid, signal.SIGCONT)


class Follower:
    """Looks at every message of the input's port: each frame is the one that its number tells, or lost and zero."""

    def __init__(self, world: World) -> None:
        self.lost = 0
        self.begun = 0  # streams
        self.index = 2**64  # of the next frame
        self.wrong = ""
        self._world = world
        self._lock = threading.Lock()

    def append(self, message: Any) -> None:
        """Take one message."""
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

    def goes_on(self) -> None:
        """Wait for another block."""
        wait_for(lambda: self.begun)
        index = self.index
        wait_for(lambda: self.index > index, what="another block")


@contextmanager
def following(world: World) -> Iterator[Follower]:
    """A follower of the input's port, from the next block on."""
    follower = Follower(world)
    message_class = serialization.message_class("rosAFE", ROSAFE.port("inputProcPort").idl)
    subscriber = rospy.Subscriber(world.afe.topic("input"), message_class, follower.append, buff_size=2**22)
    try:
        yield follower
    finally:
        subscriber.unregister()


@contextmanager
def world(size: Size, home: Path) -> Iterator[World]:
    """A world that is up. rospy in this process belongs to it."""
    with harness.private_graph(home) as (graph, master), ExitStack() as stack:
        os.environ.update(ROS_MASTER_URI=graph.uri, ROS_IP="127.0.0.1", ROS_HOME=str(home / ".ros"))
        registrar = registration.init_node("soak", ["soak"])  # which finds its way to a master that was restarted
        genpy.Message.longest_sequence = 2**26  # here, what the nodes send is no attack, however long
        stack.callback(registrar.end)
        yield World(size, graph, master, stack)


def recorded(world: World, path: Path) -> int:
    """How many frames a recording has, each of which is the one that follows in what bass plays."""
    samples = soundfile.read(path, dtype="int32")[0].T
    begin = np.flatnonzero((world.sound == samples[:, :1]).all(axis=0))
    assert len(begin) == 1, f"{path} begins with {samples[:, :1]}"
    np.testing.assert_array_equal(samples, world.frames(int(begin[0]) + 1, samples.shape[1]))
    return int(samples.shape[1])


def later(seconds: float) -> Callable[[], bool]:
    """Whether so much time has gone by since this was called."""
    over = threading.Event()
    timer = threading.Timer(seconds, over.set)
    timer.daemon = True
    timer.start()
    return over.is_set


def wait_out(seconds: float) -> None:
    """Let so much time go by."""
    wait_for(later(seconds), seconds + 10)
