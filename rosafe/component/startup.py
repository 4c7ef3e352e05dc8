"""From the shell to a running node and back: options, environment, master, background, signals, a clean end."""

from __future__ import annotations

import argparse
import contextlib
import functools
import gc
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

from rosafe.component import generate, malloc_tuning
from rosafe.declarations.errors import ComponentError
from rosafe.terminal import printable
from rosafe.transport import master, paths, systemd
from rosafe.version import VERSION

if TYPE_CHECKING:
    from rosafe.interface import ComponentSpec  # which needs numpy, and `rosafe doctor` must not

MASTER_SECONDS = 5.0  # `roscore & rosAFE-ros &` starts both at once, and roscore takes a second or two
START_SECONDS = 20.0  # a node that is not up by then waits for something that does not come
END_SECONDS = 4.5  # from the wish to end until the process is gone, whatever its threads do
SWITCH_SECONDS = 0.0005  # threads that only wait for their turn answer requests ten times faster than with the default
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_ENVIRONMENT_REMAPPINGS = {"__ip": "ROS_IP", "__hostname": "ROS_HOSTNAME", "__master": "ROS_MASTER_URI"}


class RosNode(Protocol):
    """What `run_server` needs of a node; `shutdown` may be called twice."""

    finished: threading.Event

    def shutdown(self, by: str) -> None: ...


class _Failure(Exception):
    """The node cannot start; the text is the one line that the user gets."""


class _WaitInterrupted(Exception):
    """A signal came while the node was waiting for a master, as it was told to."""


def run_server(
    component: ComponentSpec,
    build: Callable[..., RosNode],
    argv: list[str] | None = None,
    prepare: Callable[[], object] = lambda: None,
    more_options: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> int:
    """Run one component's node until a signal, its `kill` request or the master ends it.

    Parameters
    ----------
    component : Component
        The component; its name is the instance's where the user gives none.
    build : callable
        Makes and starts the node of the instance that it is given, after `rospy.init_node`. It is given the values of
        `more_options` too, by name.
    argv : list of str, optional
        The command line without the program; by default that of this process.
    prepare : callable, optional
        Called before that, and may take its time: compile something, say.
    more_options : mapping, optional
        Options of this component alone, such as ``--strict``, and what argparse is to know of each.

    Returns
    -------
    int
        0 after a clean end (or, with -b, once the node is up), 1 where the node could not start. A wrong command line
        raises SystemExit(2), and -h and --version SystemExit(0).
    """
    arguments = sys.argv[1:] if argv is None else argv
    options = _parse(component, [a for a in arguments if ":=" not in a], more_options)
    remappings = [a for a in arguments if ":=" in a]
    told = DaemonFork() if options.background else None
    if told is not None and told.in_parent:
        return told.wait()
    received: list[int] = []
    for number in ending_signals():
        signal.signal(number, lambda number, frame: received.append(number))
    try:
        own = {name: getattr(options, name) for name in (flag.lstrip("-") for flag in more_options)}
        node = _start(component, functools.partial(build, **own), options, remappings, received, prepare)
    except _WaitInterrupted:
        return 0
    except (_Failure, generate.GenerationError, master.MasterError, ComponentError, OSError) as problem:
        print(f"{component.name}-ros: {printable(problem)}", file=sys.stderr)
        watchdog(END_SECONDS, 1)
        return 1
    ready = f"{component.name}-ros: ready as /{_instance(options, remappings)} at {os.environ['ROS_MASTER_URI']}"
    with contextlib.suppress(OSError):  # whoever read that has gone
        print(printable(ready), file=sys.stderr, flush=True)
    if told is not None:
        told.up()
    systemd.notify("READY=1")
    _serve(node, received)
    return 0


def ending_signals() -> list[int]:
    """The signals that end a server: also SIGINT where a script has put it behind `&`, but not SIGHUP under nohup."""
    nohup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [number for number in SIGNALS if not (nohup and number == signal.SIGHUP)]


# --- command line -----------------------------------------------------------------------------------------------


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {printable(message)}; {self.prog} -h shows what is possible\n")


def _parse(
    component: ComponentSpec, arguments: list[str], more_options: Mapping[str, Mapping[str, Any]]
) -> argparse.Namespace:
    program = f"{component.name}-ros"
    more = "".join(f" [{' '.join((name, told.get('metavar', ''))).strip()}]" for name, told in more_options.items())
    parser = Parser(
        prog=program,
        usage=f"{program} [-b] [-i NAME] [--wait]{more} [-h] [--version] [NAME:=VALUE ...]",
        description=f"{component.doc}.",
        epilog=f"ROS remappings are taken too: topics (a:=b) and __name, __ns, __master, __ip, __hostname, __log.\n\n"
        f"example:\n  {program} -b -i left        # serves /left/...; returns once the node is up",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("-b", "--background", action="store_true", help="go to the background once the node is up")
    parser.add_argument(
        "-i",
        "--instance",
        "--name",
        metavar="NAME",
        default=component.name,
        help=f"name of the node and first part of all its names (default: {component.name})",
    )
    parser.add_argument(
        "--wait",
        action="store_true",
        help=f"wait for a ROS master for ever, as a service at boot must (default: for {MASTER_SECONDS:g} s)",
    )
    for name, told in more_options.items():
        parser.add_argument(name, **told)
    parser.add_argument("--version", action="version", version=f"{component.name} {VERSION}")
    return parser.parse_args(arguments)


# --- start ------------------------------------------------------------------------------------------------------


def _start(
    component: ComponentSpec,
    build: Callable[..., RosNode],
    options: argparse.Namespace,
    remappings: list[str],
    received: list[int],
    prepare: Callable[[], object],
) -> RosNode:
    mappings = dict(remapping.split(":=", 1) for remapping in remappings)
    instance = _instance(options, remappings)
    if not re.fullmatch("[A-Za-z][A-Za-z0-9_]*", instance):
        raise _Failure(f"{instance!r} is no instance name: letters, digits and _ only, a letter first")
    for name, variable in _ENVIRONMENT_REMAPPINGS.items():
        if mappings.get(name):
            os.environ[variable] = mappings[name]
    malloc_tuning.limit_arenas()
    master.set_local_defaults()
    master.check_address(os.environ["ROS_MASTER_URI"])  # a wrong one does not get better
    doubt = master.unreachable()
    if doubt:
        print(f"{component.name}-ros: warning: {printable(doubt)}", file=sys.stderr, flush=True)
    _await_master(os.environ["ROS_MASTER_URI"], received, f"{component.name}-ros" if options.wait else "")
    generate.ensure_messages()
    paths.prefer_pypi_packages()
    ensure_log_directory()
    prepare()
    limit = watchdog(
        START_SECONDS,
        1,
        f"{component.name}-ros: not up after {START_SECONDS:g} s: is this machine reachable under the name or address "
        "in ROS_HOSTNAME or ROS_IP?",
    )
    sys.setswitchinterval(SWITCH_SECONDS)
    import rospy

    from rosafe.transport import registration

    try:
        registrar = registration.init_node(instance, [f"{component.name}-ros", *remappings])
    except (rospy.ROSException, ValueError) as problem:
        raise _Failure(f"cannot start the node: {problem}") from problem
    log_to_stderr()
    try:
        try:
            node = build(instance)
        finally:
            registrar.up()  # whatever has failed, it fails because the node was told to end
    except rospy.ROSException as problem:
        raise _Failure(f"cannot start the node: {problem}") from None
    gc.freeze()  # a look at all that the modules made stops every thread for tens of milliseconds, and finds nothing
    limit.cancel()
    return node


def _instance(options: argparse.Namespace, remappings: list[str]) -> str:
    named = [remapping.partition(":=")[2] for remapping in remappings if remapping.startswith("__name:=")]
    return str(named[-1] if named else options.instance)


def _await_master(uri: str, received: list[int], patient: str) -> None:
    """Give a master that is just starting a moment; MasterError where none is there by then, or at a signal.

    The program that is `patient` says so and waits for ever; a signal is `_WaitInterrupted` to it.
    """
    deadline = time.monotonic() + MASTER_SECONDS
    told = False
    while True:
        try:
            return master.check_master(uri, lambda: bool(received))
        except master.MasterError:
            if received and patient:
                raise _WaitInterrupted from None
            if received or (time.monotonic() > deadline and not patient):
                raise
        if patient and not told:
            print(f"{patient}: waiting for a ROS master at {printable(uri)}", file=sys.stderr, flush=True)
            told = True
        if patient:
            systemd.notify(f"STATUS=waiting for a ROS master at {uri}", "EXTEND_TIMEOUT_USEC=30000000")
        time.sleep(0.1)


_NAME = re.compile(r"__\w+:=")


def without_names(arguments: list[str]) -> list[str]:
    """The command line without what roslaunch adds for nodes, such as ``__name:=...``."""
    return [word for word in arguments if not _NAME.match(word)]


def names_given() -> list[str]:
    """What `without_names` leaves out of this process' command line, after the program."""
    return [sys.argv[0], *(word for word in sys.argv[1:] if _NAME.match(word))]


def become_node(name: str) -> None:
    """Make this process a node of the graph, whose name begins with `name` unless roslaunch gives another one.

    Raises
    ------
    MasterError
        There is no master.
    GenerationError
        There are no messages.
    """
    import rospy

    from rosafe.transport import registration

    master.set_local_defaults()
    master.check_master(os.environ["ROS_MASTER_URI"])
    generate.ensure_messages()
    ensure_log_directory()
    try:
        registration.init_node(name, names_given(), anonymous=True).up()
    except (rospy.ROSException, ValueError) as problem:
        raise master.MasterError(f"cannot become a node: {problem}") from None
    log_to_stderr()


def ensure_log_directory() -> None:
    """Send rospy's log file to a temporary folder where the usual one cannot be written: it is not worth failing."""
    import rospkg

    if not paths.writable(Path(rospkg.get_log_dir())):
        os.environ["ROS_LOG_DIR"] = str(paths.private_temporary() / "log")


def log_to_stderr() -> None:
    """Move rospy's information lines to stderr, where its warnings are: stdout belongs to what a request prints.

    What they quote from clients and files is escaped.
    """
    import logging

    from rosgraph.roslogging import RosStreamHandler

    class Handler(RosStreamHandler):
        def emit(self, record: logging.LogRecord) -> None:
            text = printable(record.getMessage(), keep="\n")
            super().emit(logging.makeLogRecord({**vars(record), "msg": text, "args": ()}))

    rosout = logging.getLogger("rosout")
    for handler in rosout.handlers[:]:
        if isinstance(handler, RosStreamHandler):
            rosout.removeHandler(handler)
            rosout.addHandler(Handler(stdout=sys.stderr, stderr=sys.stderr))


# --- end --------------------------------------------------------------------------------------------------------


def _serve(node: RosNode, received: list[int]) -> None:
    """Wait until `node` is to end (`received` is where the signals arrive) and end it."""
    import rospy

    rospy.on_shutdown(lambda: node.shutdown("kill"))  # whoever ends rospy: we, rosnode kill, a new node of this name
    over = threading.Event()
    rospy.core.add_shutdown_hook(lambda reason: over.set())  # after rospy's own, which tell the master
    # An Event must not be set from a signal handler, which may interrupt the wait while that holds its lock.
    while not received and not rospy.is_shutdown() and not node.finished.wait(0.1):
        pass
    systemd.notify("STOPPING=1")
    watchdog(END_SECONDS, 0)
    rospy.signal_shutdown("signal" if received else "kill")
    over.wait()  # another thread may be at it already; the watchdog bounds this


def watchdog(seconds: float, code: int, message: str = "") -> threading.Timer:
    """End the process with `code` after `seconds` unless it has ended, or the timer is cancelled, by then."""

    def end() -> None:
        if message:
            print(message, file=sys.stderr)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
    return timer


# --- background -------------------------------------------------------------------------------------------------


class DaemonFork:
    """The process cut in two: the parent waits for the shell until the child, which becomes the node, is up."""

    def __init__(self) -> None:
        self._reader, self._writer = os.pipe()
        sys.stdout.flush()
        sys.stderr.flush()
        self.in_parent = os.fork() > 0
        if not self.in_parent:
            os.close(self._reader)
            os.setsid()

    def wait(self) -> int:
        """In the parent: 0 once the child is up, 1 where it ended before (and said why)."""
        os.close(self._writer)
        with os.fdopen(self._reader, "rb") as pipe:
            return 0 if pipe.read() == b"up" else 1

    def up(self) -> None:
        """In the child: let the parent go, and let go of the terminal or pipe that it leaves."""
        nothing = os.open(os.devnull, os.O_RDWR)
        os.dup2(nothing, 0)
        for stream in (1, 2):
            if not _is_file(stream):
                os.dup2(nothing, stream)
        os.write(self._writer, b"up")
        os.close(self._writer)


def _is_file(stream: int) -> bool:
    import stat

    return stat.S_ISREG(os.fstat(stream).st_mode)
