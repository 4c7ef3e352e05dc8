"""Real ROS graphs for tests: a private master, real nodes and commands as processes, waiting on conditions.

    def test_scene(graph):
        with graph.node("bass-ros"):
            assert graph.call("/bass/Acquire", device="scene:").genom_success
            audio = graph.message("/bass/Audio", accept=lambda m: m.lastFrameIndex > 0)

`graph` (fixture of conftest.py) is one master per test process, shared by all its tests; `private_graph` has a master
of its own in a process of its own, for tests that kill it. Everything started dies with the test.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO, Any, TypeVar

import pytest

from rosafe import interface
from rosafe.component import generate
from rosafe.transport.master import PrivateMaster

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = ROOT / "scripts"
PYTHON = "/usr/bin/python3"
PATIENCE = 60.0  # s; for whatever must happen, on a machine with much other work: no test asserts how long it takes
END_SECONDS = 5.0  # s; the contract's: within them, a server that is told to has ended
GRACE = 20.0  # s; from the wish that a process may end until it is killed

T = TypeVar("T")


def shared(*parts: str) -> Path:
    """A file or folder of the shared material beside the checkout; the test is skipped where it is not there."""
    path = ROOT.parent.joinpath("shared", *parts)
    if not path.exists():
        pytest.skip(f"no {'/'.join(('../shared', *parts))} beside this checkout")
    return path


def proc(*parts: object) -> Path:
    """A file or folder of /proc, which knows all processes; the test is skipped where a bare chroot lacks it."""
    if not Path("/proc/self").exists():
        pytest.skip("/proc is not mounted here")
    return Path("/proc", *map(str, parts))


def let_children_have_default_signals() -> None:
    """Whatever this process starts from now on has the system's default signals, also those that it ignores itself.

    Under `nohup`, and in a script behind `&`, a process ignores SIGHUP or SIGINT, and so would all that it starts: what
    is ignored is inherited. What is handled is not, so here a handler ignores it.
    """
    for number in signal.valid_signals() - {signal.SIGPIPE, signal.SIGXFSZ}:  # these two subprocess restores itself
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda number, frame: None)


def wait_for(condition: Callable[[], T], timeout: float = PATIENCE, what: str | Callable[[], str] = "") -> T:
    """The first true value of `condition()`, asked at first every 5 ms; AssertionError after `timeout` seconds."""
    end = time.monotonic() + timeout
    pause = 0.005
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() > end:
            told = what() if callable(what) else what
            raise AssertionError(f"not within {timeout:g} s: {told or condition}")
        time.sleep(pause)
        pause = min(1.1 * pause, 0.05)  # what takes long is not to take longer because it is asked for


def free_port() -> int:
    """A TCP port of the loopback interface that nobody uses at the moment.

    It is below those that Linux gives to connections, of which there are many meanwhile.
    """
    while True:
        port = random.SystemRandom().randrange(12_000, 32_000)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


class Process:
    """A child process with its own process group; what it prints goes to files, so that it never waits for a reader."""

    def __init__(self, command: list[str], env: dict[str, str], cwd: Path | None = None) -> None:
        self.command = command
        self._out: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  # open as long as the process is of interest
        self._err: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        # setpriv: the kernel ends the child should this process be killed before it can clean up
        self._popen = subprocess.Popen(
            ["setpriv", "--pdeathsig", "KILL", "--", *command],
            env=env,
            cwd=cwd,
            stdin=subprocess.DEVNULL,
            stdout=self._out,
            stderr=self._err,
            start_new_session=True,
        )
        self.pid = self._popen.pid

    @property
    def out(self) -> str:
        """What it has printed on stdout so far."""
        return _contents(self._out)

    @property
    def err(self) -> str:
        """What it has printed on stderr so far."""
        return _contents(self._err)

    @property
    def complaints(self) -> str:
        """`err` without the line in which a node tells that it is ready."""
        return re.sub(r"^\w+-ros: ready as .*\n", "", self.err, flags=re.MULTILINE)

    @property
    def alive(self) -> bool:
        """Whether it has not ended yet."""
        return self._popen.poll() is None

    def wait(self, timeout: float = PATIENCE) -> int:
        """Its exit code, negative for a signal; AssertionError where it does not end in time."""
        wait_for(lambda: not self.alive, timeout, lambda: f"end of {self}")
        return self._popen.returncode

    def stop(self, number: int = signal.SIGTERM, timeout: float = PATIENCE) -> int:
        """Send a signal and return the exit code."""
        if self.alive:
            self._popen.send_signal(number)
        return self.wait(timeout)

    def close(self) -> None:
        """End it and all its children, gently if they let themselves."""
        if self.alive:
            self._signal_group(signal.SIGTERM)
            try:
                self._popen.wait(GRACE)
            except subprocess.TimeoutExpired:
                self._signal_group(signal.SIGKILL)
                self._popen.wait()
        self._signal_group(signal.SIGKILL)  # children that outlived it

    def _signal_group(self, number: int) -> None:
        try:
            os.killpg(self.pid, number)
        except ProcessLookupError:
            return

    def __repr__(self) -> str:
        return f"{' '.join(self.command)} (pid {self.pid})\n--- stdout\n{self.out}\n--- stderr\n{self.err}"

    def __enter__(self) -> Process:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        if error is not None:
            print(self)  # pytest shows it with the failure


def _contents(stream: IO[bytes]) -> str:
    return os.pread(stream.fileno(), 10_000_000, 0).decode("utf-8", "replace")


class Graph:
    """One ROS graph: a master, the environment of its processes, and ways to look into it.

    `call`, `message` and `collect` use rospy in this process, which knows one master only: they are for the shared
    graph. Commands and nodes work on any.
    """

    def __init__(self, uri: str, home: Path) -> None:
        self.uri = uri
        self.home = home
        self.env = {k: v for k, v in os.environ.items() if not k.startswith("ROS_")}
        self.env.update(
            generate.environment(),
            PATH=f"{SCRIPTS}:/usr/local/bin:/usr/bin:/bin",  # not the tester's: the commands run Debian's python3
            HOME=str(home),
            ROS_HOME=str(home / ".ros"),
            ROS_IP="127.0.0.1",
            ROS_MASTER_URI=uri,
        )

    # --- processes ---

    def start(self, *command: str, cwd: Path | None = None, **env: str) -> Process:
        """Start a command in this graph; close it, or use it in a `with`."""
        return Process(list(command), {**self.env, **env}, cwd)

    @contextmanager
    def node(self, script: str, *arguments: str, cwd: Path | None = None, **env: str) -> Iterator[Process]:
        """A node of scripts/ (``bass-ros``, ``rosAFE-ros``) that is up: all its services are there."""
        component = interface.COMPONENTS[Path(script).name.removesuffix("-ros")]
        name = component.name
        for option, value in itertools.pairwise(arguments):
            if option in ("-i", "--name", "--instance"):
                name = value
        self._forget(f"/{name}")
        with self.start(str(SCRIPTS / script), *arguments, cwd=cwd, **env) as process:
            wait_for(lambda: self._is_up(name, component, process), what=lambda: f"start of {process}")
            yield process
        self._forget(f"/{name}")

    def run(
        self, *command: str, timeout: float = PATIENCE, check: bool = True, stdin: str = "", **env: str
    ) -> subprocess.CompletedProcess[str]:
        """Run a command to its end; AssertionError where it fails (unless told not to check) or takes too long."""
        done = subprocess.run(
            ["timeout", "-k", "2", str(timeout), *command],
            env={**self.env, **env},
            input=stdin,
            text=True,
            capture_output=True,
            check=False,
        )
        if done.returncode == 124:
            raise AssertionError(f"{' '.join(command)}: not done after {timeout:g} s\n{done.stdout}\n{done.stderr}")
        if check and done.returncode != 0:
            raise AssertionError(f"{' '.join(command)}: exit {done.returncode}\n{done.stdout}\n{done.stderr}")
        return done

    # --- the master's view ---

    def services(self) -> set[str]:
        """All services that the master knows."""
        return {name for name, _ in self._state()[2]}

    def topics(self) -> set[str]:
        """All topics that somebody publishes."""
        return {name for name, _ in self._state()[0]}

    def readers(self) -> set[tuple[str, str]]:
        """Which node subscribes to which topic: (topic, node)."""
        return {(topic, node) for topic, nodes in self._state()[1] for node in nodes}

    def nodes(self) -> set[str]:
        """All nodes that publish, subscribe or serve anything."""
        return {node for kind in self._state() for _, nodes in kind for node in nodes}

    def _state(self) -> Any:
        import rosgraph

        return rosgraph.Master("/harness", master_uri=self.uri).getSystemState()

    def _is_up(self, name: str, component: interface.ComponentSpec, process: Process) -> bool:
        if not process.alive:
            raise AssertionError(f"ended at once: {process}")
        _, subscribed, served = ({entry for entry, _ in kind} for kind in self._state())
        return {f"/{name}/{s.name}" for s in component.on_graph} <= served and {
            f"/{name}/{s.name}/cancel" for s in component.activities
        } <= subscribed

    def _forget(self, name: str) -> None:
        """Unregister what a killed node of that name has left behind, as ``rosnode cleanup`` does."""
        import rosgraph

        try:
            if name not in self.nodes():
                return
        except OSError:  # the test has killed the master, and it knows nothing when it comes back
            return
        master = rosgraph.Master(name, master_uri=self.uri)
        publishers, subscribers, services = master.getSystemState()
        address = master.lookupNode(name)
        for topic, nodes in publishers:
            if name in nodes:
                master.unregisterPublisher(topic, address)
        for topic, nodes in subscribers:
            if name in nodes:
                master.unregisterSubscriber(topic, address)
        for service, nodes in services:
            if name in nodes:
                master.unregisterService(service, master.lookupService(service))

    # --- rospy in this process ---

    def call(self, service: str, **fields: Any) -> Any:
        """Call a service and return its response, through rospy in this process (a millisecond).

        `service` is a name like ``/bass/Acquire``; the types are those of the package that its node was made from.
        """
        import rospy
        import rosservice

        self.client()
        return rospy.ServiceProxy(service, rosservice.get_service_class_by_name(service))(**fields)

    def message(
        self,
        topic: str,
        message_class: Any = None,
        accept: Callable[[Any], bool] = lambda message: True,
        timeout: float = PATIENCE,
    ) -> Any:
        """The first message on `topic` that `accept` takes (the latched one counts)."""
        with self.collect(topic, message_class) as messages:
            return wait_for(
                lambda: next((m for m in list(messages) if accept(m)), None),
                timeout,
                lambda: f"message on {topic} ({len(messages)} came, last: {str(messages[-1:])[:500]})",
            )

    @contextmanager
    def collect(self, topic: str, message_class: Any = None) -> Iterator[list[Any]]:
        """The list of all messages that come on `topic`, growing until the end of the ``with`` block."""
        import rospy
        import rostopic

        self.client()
        if message_class is None:
            message_class = wait_for(lambda: rostopic.get_topic_class(topic)[0], what=f"publisher of {topic}")
        messages: list[Any] = []
        subscriber = rospy.Subscriber(topic, message_class, messages.append, buff_size=2**22, tcp_nodelay=True)
        try:
            yield messages
        finally:
            subscriber.unregister()

    def client(self) -> None:
        """Make this process a node of the graph, once."""
        import rospy

        if os.environ.get("ROS_MASTER_URI") != self.uri:
            raise RuntimeError("rospy in this process belongs to the shared graph")
        if not rospy.core.is_initialized():
            rospy.init_node(f"test_{os.getpid()}", disable_signals=True)


def python_path(graph: Graph) -> str:
    """PYTHONPATH for programs of a test's own: this checkout, and the messages."""
    return f"{ROOT}:{graph.env['PYTHONPATH']}"


@contextmanager
def shared_graph(home: Path) -> Iterator[Graph]:
    """The graph of this test process: its master runs in it, and rospy here talks to that."""
    with PrivateMaster() as master:
        os.environ.update(ROS_MASTER_URI=master.uri, ROS_IP="127.0.0.1", ROS_HOME=str(home / ".ros"))
        yield Graph(master.uri, home)
        if "rospy" in sys.modules:
            sys.modules["rospy"].signal_shutdown("end of the tests")  # while the master still listens


class PortTakenError(Exception):
    """A port that was free a moment ago is not any more."""


class MasterProcess:
    """A master in a process of its own, which can be killed and started again at the same address."""

    def __init__(self) -> None:
        self.port = free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self.process: Process | None = None

    def start(self, env: dict[str, str]) -> None:
        """Start it and wait until it answers."""
        from rosafe.transport.master import MasterError, check_master

        def answers() -> bool:
            assert self.process is not None
            if "already in use" in self.process.out:
                self.kill()
                raise PortTakenError(self.uri)
            try:
                check_master(self.uri)
            except MasterError:
                return False
            return True

        self.process = Process(["rosmaster", "--core", "-p", str(self.port)], env)
        wait_for(answers, what=lambda: f"master {self.process}")

    def kill(self) -> None:
        """Kill it as a crash would."""
        if self.process is not None:
            self.process.stop(signal.SIGKILL)
            self.process.close()
            self.process = None


@contextmanager
def private_graph(home: Path) -> Iterator[tuple[Graph, MasterProcess]]:
    """A graph with a master process of its own."""
    for attempts_left in reversed(range(5)):
        master = MasterProcess()
        graph = Graph(master.uri, home)
        try:
            master.start(graph.env)
            break
        except PortTakenError:  # somebody else was quicker
            if not attempts_left:
                raise
    try:
        yield graph, master
    finally:
        master.kill()


def run_together(count: int, work: Callable[[int], T]) -> list[T]:
    """The results of `work(0)` to `work(count - 1)`, started at the same time in threads."""
    gate = threading.Barrier(count)
    results: dict[int, T] = {}
    errors: list[BaseException] = []

    def go(index: int) -> None:
        gate.wait()
        try:
            results[index] = work(index)
        except BaseException as error:  # handed to the test below
            errors.append(error)

    threads = [threading.Thread(target=go, args=(index,)) for index in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    return [results[index] for index in range(count)]
