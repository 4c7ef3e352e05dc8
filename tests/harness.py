"""Real ROS graphs for tests: a private master, nodes and commands as processes, and waiting for conditions.

    def test_scene(graph):
        with graph.node("bass-ros"):
            assert graph.call("/bass/Acquire", device="scene:").genom_success
            audio = graph.message("/bass/Audio", accept=lambda m: m.lastFrameIndex > 0)

The fixture `graph` (conftest.py) has one master per test process, shared by its tests. `private_graph` has a separate
master process, for tests that kill it. All processes that a test starts end with the test.
"""

from __future__ import annotations

import asyncio
import contextlib
import inspect
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
import weakref
import xmlrpc.client
from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractAsyncContextManager, contextmanager
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import IO, Any, TypeVar
from urllib.parse import urlsplit

import pytest

from rosafe import interface
from rosafe.ros1.component import generate
from rosafe.ros1.transport.master import PrivateMaster
from tests import fork_server

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = ROOT / "scripts"
PYTHON = "/usr/bin/python3"
PATIENCE = 60.0  # s; time limit for any event, also on a busy machine: tests do not check durations
GRACE = 20.0  # s; from the request to end until a process is killed

forks = False  # tests/conftest.py sets it: programs are started as forks if possible, except in tests of the start

T = TypeVar("T")


def shared(*parts: str) -> Path:
    """Return a path in the shared material beside the checkout; skip the test if it does not exist."""
    path = ROOT.parent.joinpath("shared", *parts)
    if not path.exists():
        pytest.skip(f"no {'/'.join(('../shared', *parts))} beside this checkout")
    return path


def proc(*parts: object) -> Path:
    """Return a path in /proc; skip the test if /proc is not mounted, as in a bare chroot."""
    if not Path("/proc/self").exists():
        pytest.skip("/proc is not mounted here")
    return Path("/proc", *map(str, parts))


def folder_of_run(factory: pytest.TempPathFactory) -> Path:
    """Return the temporary folder that all processes of one run of the tests share."""
    folder = factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


def let_children_have_default_signals() -> None:
    """Give all child processes the default signal handlers, also for signals that this process ignores.

    Under `nohup`, or in a script with `&`, a process ignores SIGHUP or SIGINT. Children inherit ignored signals, but
    not handlers. Therefore ignored signals get a handler that does nothing.
    """
    for number in signal.valid_signals() - {signal.SIGPIPE, signal.SIGXFSZ}:  # subprocess restores these two
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda number, frame: None)


def wait_for(condition: Callable[[], T], timeout: float = PATIENCE, what: str | Callable[[], str] = "") -> T:
    """Poll `condition()` every 5 to 50 ms and return its first true value; AssertionError after `timeout` s."""
    end = time.monotonic() + timeout
    pause = 0.005
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() > end:
            description = what() if callable(what) else what
            raise AssertionError(f"not within {timeout:g} s: {description or condition}")
        time.sleep(pause)
        pause = min(1.1 * pause, 0.05)  # long waits poll less often, to leave processor time for the rest


def freeze(pid: int) -> None:
    """Stop a process by SIGSTOP, and wait until all its threads have stopped: on a busy machine that takes a while.

    Without /proc this cannot be waited for.
    """
    os.kill(pid, signal.SIGSTOP)
    threads = Path("/proc", str(pid), "task")
    if threads.exists():
        wait_for(lambda: all(_state(thread) == "T" for thread in threads.iterdir()), what=f"the stop of process {pid}")


def _state(thread: Path) -> str:
    try:
        return (thread / "stat").read_text().rpartition(")")[2].split()[0]
    except OSError:  # it has ended meanwhile
        return ""


def free_port() -> int:
    """Return an unused TCP port of the loopback interface.

    It is below the ports that Linux assigns to outgoing connections.
    """
    while True:
        port = random.SystemRandom().randrange(12_000, 32_000)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


def can_fork(command: list[str], env: dict[str, str]) -> bool:
    """Return whether a program is started by the server of forks (tests/fork_server.py)."""
    return forks and fork_server.can_fork(command, env, generate.environment()["PYTHONPATH"])


def run_program(command: Sequence[str | Path], **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a program to its end, and return its output as text. `options` are those of `subprocess.run`."""
    usual = {"capture_output": True, "text": True, "timeout": 5 * PATIENCE, "check": False}
    return subprocess.run(command, **{**usual, **options})


def in_loop(context: Callable[..., AbstractAsyncContextManager[Any]], *arguments: Any) -> Callable[[Any], Any]:
    """Decorate a test that is a coroutine. `context(*arguments)` yields its positional-only arguments."""

    def decorate(test: Callable[..., Awaitable[None]]) -> Callable[..., None]:
        async def limited(fixtures: dict[str, Any]) -> None:
            async with asyncio.timeout(PATIENCE), context(*arguments) as given:
                await test(*(given if isinstance(given, tuple) else (given,)), **fixtures)

        def run(**fixtures: Any) -> None:
            asyncio.run(limited(fixtures))

        signature = inspect.signature(test)
        of_pytest = [one for one in signature.parameters.values() if one.kind is not one.POSITIONAL_ONLY]
        run.__signature__ = signature.replace(parameters=of_pytest)  # type: ignore[attr-defined]
        run.__doc__, run.__module__ = test.__doc__, test.__module__
        return run

    return decorate


class Process:
    """A child process with its own process group. Its output goes to files, so that it never blocks on a pipe.

    It is a fork of a process that has imported its modules, unless `fork` is false or `can_fork` is.
    """

    def __init__(self, command: list[str], env: dict[str, str], cwd: Path | None = None, fork: bool = True) -> None:
        self.command = command
        self._out: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  # open as long as this object
        self._err: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        weakref.finalize(self, _close, self._out, self._err)  # readable as long as this object
        self._popen = self._start(command, env, cwd, fork and can_fork(command, env))
        self.pid = self._popen.pid

    def _start(
        self, command: list[str], env: dict[str, str], cwd: Path | None, fork: bool
    ) -> subprocess.Popen[bytes] | fork_server.ForkedProcess:
        if fork:
            with open(os.devnull) as nothing:
                streams = [nothing.fileno(), self._out.fileno(), self._err.fileno()]
                return fork_server.shared().start(command, env, cwd, streams)
        # setpriv: the kernel kills the child if this process is killed before it can clean up
        return subprocess.Popen(
            ["setpriv", "--pdeathsig", "KILL", "--", *command],
            env=env,
            cwd=cwd,
            stdin=subprocess.DEVNULL,
            stdout=self._out,
            stderr=self._err,
            start_new_session=True,
        )

    @property
    def out(self) -> str:
        """The standard output so far."""
        return _contents(self._out)

    @property
    def err(self) -> str:
        """The standard error so far."""
        return _contents(self._err)

    @property
    def complaints(self) -> str:
        """`err` without the line of a node that is ready."""
        return re.sub(r"^\w+-ros: ready as .*\n", "", self.err, flags=re.MULTILINE)

    @property
    def alive(self) -> bool:
        """Whether the process is running."""
        return self._popen.poll() is None

    def wait(self, timeout: float = PATIENCE) -> int:
        """Return the exit code, negative for a signal; AssertionError if the process does not end in time."""
        wait_for(lambda: not self.alive, timeout, lambda: f"end of {self}")
        return self._popen.wait()

    def stop(self, number: int = signal.SIGTERM, timeout: float = PATIENCE) -> int:
        """Send a signal and return the exit code."""
        if self.alive:
            self._popen.send_signal(number)
        return self.wait(timeout)

    def signal_until_end(self, number: int, send: Callable[[int, int], None] = os.kill) -> int:
        """Send a signal again and again until the process has ended; return the exit code."""
        while self.alive:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                send(self.pid, number)
            time.sleep(0.001)
        return self.wait()

    def close(self) -> None:
        """End the process and its children, with SIGKILL if SIGTERM has no effect."""
        if self.alive:
            self._signal_group(signal.SIGTERM)
            self._signal_group(signal.SIGCONT)  # a test may have stopped it
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
            print(self)  # pytest shows this with the failure


def _close(*streams: IO[bytes]) -> None:
    for stream in streams:
        stream.close()


def _contents(stream: IO[bytes]) -> str:
    return os.pread(stream.fileno(), 10_000_000, 0).decode("utf-8", "replace")


class Graph:
    """A ROS graph: its master, the environment of its processes, and functions to inspect it.

    `call`, `message` and `collect` use rospy in this process, which supports one master only: they work for the shared
    graph. Commands and nodes work for any graph.
    """

    def __init__(self, uri: str, home: Path) -> None:
        self.uri = uri
        self.home = home
        self.env = {k: v for k, v in os.environ.items() if not k.startswith("ROS_")}
        self.env.update(
            generate.environment(),
            PATH=f"{SCRIPTS}:/usr/local/bin:/usr/bin:/bin",  # the commands run Debian's python3
            HOME=str(home),
            ROS_HOME=str(home / ".ros"),
            ROS_IP="127.0.0.1",
            ROS_MASTER_URI=uri,
        )

    # --- processes ---

    def start(self, *command: str, cwd: Path | None = None, **env: str) -> Process:
        """Start a command in this graph; the caller closes it, or uses it in a `with` statement."""
        return Process(list(command), {**self.env, **env}, cwd)

    @contextmanager
    def node(self, script: str, *arguments: str, cwd: Path | None = None, **env: str) -> Iterator[Process]:
        """Run a node of scripts/ (``bass-ros``, ``rosAFE-ros``); yield when all its services are registered."""
        component = interface.COMPONENTS[Path(script).name.removesuffix("-ros")]
        name = component.name
        for option, value in itertools.pairwise(arguments):
            if option in ("-i", "--name", "--instance"):
                name = value
        self._forget(f"/{name}")
        with self.start(str(SCRIPTS / script), *arguments, cwd=cwd, **env) as process:
            self.wait_until_up(process, component.name, name)
            yield process
        self._forget(f"/{name}")

    def run(
        self, *command: str, timeout: float = PATIENCE, check: bool = True, stdin: str = "", **env: str
    ) -> subprocess.CompletedProcess[str]:
        """Run a command to its end; AssertionError if it takes too long, or if it fails and `check` is true."""
        env = {**self.env, **env}
        if can_fork(list(command), env):
            done = fork_server.shared().run(command, env, None, stdin, timeout)
        else:
            limited = ["timeout", "-k", "2", str(timeout), *command]
            done = subprocess.run(limited, env=env, input=stdin, text=True, capture_output=True, check=False)
        if done.returncode == 124:
            raise AssertionError(f"{' '.join(command)}: not done after {timeout:g} s\n{done.stdout}\n{done.stderr}")
        if check and done.returncode != 0:
            raise AssertionError(f"{' '.join(command)}: exit {done.returncode}\n{done.stdout}\n{done.stderr}")
        return done

    # --- the master's view ---

    def services(self) -> set[str]:
        """Return all registered services."""
        return {name for name, _ in self._state()[2]}

    def topics(self) -> set[str]:
        """Return all topics with a publisher."""
        return {name for name, _ in self._state()[0]}

    def readers(self) -> set[tuple[str, str]]:
        """Return all subscriptions: (topic, node)."""
        return {(topic, node) for topic, nodes in self._state()[1] for node in nodes}

    def wait_until_read(self, topics: Iterable[str], readers: Collection[str]) -> None:
        """Wait until the publishers of `topics` are connected to the nodes `readers`: later than their registration."""
        master: Any = xmlrpc.client.ServerProxy(self.uri)
        publishers = dict(self._state()[0])
        for topic, node in ((name, node) for name in topics for node in publishers.get(name, ())):
            address = master.lookupNode("/harness", node)[2]
            wait_for(partial(_is_read, address, topic, set(readers)), what=f"{node} sends {topic} to {readers}")

    def nodes(self) -> set[str]:
        """Return all nodes with a publisher, a subscriber or a service."""
        return {node for kind in self._state() for _, nodes in kind for node in nodes}

    def _state(self) -> Any:
        import rosgraph

        return rosgraph.Master("/harness", master_uri=self.uri).getSystemState()

    def wait_until_up(self, process: Process, kind: str, name: str = "") -> None:
        """Wait until a node of the component `kind` has registered all its services, one after the other."""
        component = interface.COMPONENTS[kind]
        wait_for(lambda: self._is_up(name or kind, component, process), what=lambda: f"start of {process}")

    def _is_up(self, name: str, component: interface.ComponentSpec, process: Process) -> bool:
        if not process.alive:
            raise AssertionError(f"ended during its start: {process}")
        if "ready as " not in process.err:  # the state of the master is large
            return False
        _, subscribed, served = ({entry for entry, _ in kind} for kind in self._state())
        return {f"/{name}/{s.name}" for s in component.on_graph} <= served and {
            f"/{name}/{s.name}/cancel" for s in component.activities
        } <= subscribed

    def _forget(self, name: str) -> None:
        """Remove the registrations of a killed node of that name, like ``rosnode cleanup``."""
        import rosgraph

        try:
            if name not in self.nodes():
                return
        except OSError:  # the test has killed the master, which loses all registrations
            return
        master = rosgraph.Master(name, master_uri=self.uri)
        publishers, subscribers, services = master.getSystemState()
        address = master.lookupNode(name)
        if _is_served(address):  # the node is alive: it would register again, and end its successor
            return
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

        `service` is a name such as ``/bass/Acquire``; its type is looked up on the graph.
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
        """Return the first message on `topic`, including a latched one, for which `accept` is true."""
        with self.collect(topic, message_class) as messages:
            return wait_for(
                lambda: next((m for m in list(messages) if accept(m)), None),
                timeout,
                lambda: f"message on {topic} ({len(messages)} received, last: {str(messages[-1:])[:500]})",
            )

    @contextmanager
    def collect(self, topic: str, message_class: Any = None) -> Iterator[list[Any]]:
        """Collect messages on `topic` until the end of the ``with`` block; yield when the publishers are connected."""
        import rospy
        import rostopic

        self.client()
        if message_class is None:
            message_class = wait_for(lambda: rostopic.get_topic_class(topic)[0], what=f"publisher of {topic}")
        messages: list[Any] = []
        subscriber = rospy.Subscriber(topic, message_class, messages.append, buff_size=2**22, tcp_nodelay=True)
        try:
            self.wait_until_read([topic], [rospy.get_name()])
            yield messages
        finally:
            subscriber.unregister()

    def client(self) -> None:
        """Initialise rospy in this process, once."""
        import rospy

        if os.environ.get("ROS_MASTER_URI") != self.uri:
            raise RuntimeError("rospy in this process belongs to the shared graph")
        if not rospy.core.is_initialized():
            rospy.init_node(f"test_{os.getpid()}", disable_signals=True)


def _is_read(address: str, topic: str, readers: set[str]) -> bool:
    """Return whether the node at `address` is connected to all `readers` of `topic`, or has ended."""
    node: Any = xmlrpc.client.ServerProxy(address)
    try:
        connections = node.getBusInfo("/harness")[2]
    except OSError:
        return True
    return readers <= {entry[1] for entry in connections if (entry[2], entry[4]) == ("o", topic)}


def _is_served(uri: str) -> bool:
    """Return whether a server accepts connections at an address."""
    parts = urlsplit(uri)
    try:
        socket.create_connection((parts.hostname or "", parts.port or 0), PATIENCE).close()
    except OSError:
        return False
    return True


def python_path(graph: Graph) -> str:
    """Return a PYTHONPATH for programs of a test: this checkout, and the messages."""
    return f"{ROOT}:{graph.env['PYTHONPATH']}"


@contextmanager
def shared_graph(home: Path) -> Iterator[Graph]:
    """Run the graph of this test process: its master runs in this process, and rospy connects to it."""
    with PrivateMaster() as master:
        os.environ.update(ROS_MASTER_URI=master.uri, ROS_IP="127.0.0.1", ROS_HOME=str(home / ".ros"))
        yield Graph(master.uri, home)
        if "rospy" in sys.modules:
            sys.modules["rospy"].signal_shutdown("end of the tests")  # before the master ends


class PortTakenError(Exception):
    """A port was taken between the check and its use."""


class MasterProcess:
    """A master in a separate process, which can be killed and started again at the same address."""

    def __init__(self) -> None:
        self.port = free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self.process: Process | None = None

    def start(self, env: dict[str, str]) -> None:
        """Start the master and wait until it responds."""
        from rosafe.ros1.transport.master import MasterError, check_master

        def responds() -> bool:
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
        wait_for(responds, what=lambda: f"master {self.process}")

    def kill(self) -> None:
        """Kill the master, like a crash."""
        if self.process is not None:
            self.process.stop(signal.SIGKILL)
            self.process.close()
            self.process = None


@contextmanager
def private_graph(home: Path) -> Iterator[tuple[Graph, MasterProcess]]:
    """Run a graph with a separate master process."""
    for attempts_left in reversed(range(5)):
        master = MasterProcess()
        graph = Graph(master.uri, home)
        try:
            master.start(graph.env)
            break
        except PortTakenError:  # another process took the port
            if not attempts_left:
                raise
    try:
        yield graph, master
    finally:
        master.kill()


def run_together(count: int, work: Callable[[int], T]) -> list[T]:
    """Run `work(0)` to `work(count - 1)` at the same time in threads, and return their results."""
    gate = threading.Barrier(count)
    results: dict[int, T] = {}
    errors: list[BaseException] = []

    def go(index: int) -> None:
        gate.wait()
        try:
            results[index] = work(index)
        except BaseException as error:  # raised below in the thread of the test
            errors.append(error)

    threads = [threading.Thread(target=go, args=(index,)) for index in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    return [results[index] for index in range(count)]
