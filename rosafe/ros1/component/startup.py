"""Start and end of a node: options, environment, master, background, signals, clean exit."""

from __future__ import annotations

import argparse
import contextlib
import functools
import gc
import os
import re
import signal
import stat
import sys
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

from rosafe.declarations.errors import ComponentError
from rosafe.ros1.component import generate
from rosafe.ros1.transport import master, paths, systemd
from rosafe.system import malloc_tuning
from rosafe.system.terminal import printable
from rosafe.system.version import VERSION

if TYPE_CHECKING:
    from rosafe.interface import ComponentSpec  # imports numpy, on which `rosafe doctor` must not depend

MASTER_SECONDS = 5.0  # `roscore & rosAFE-ros &` starts both at the same time, and roscore takes a second or two
START_SECONDS = 20.0  # a node that has not started by then never will
END_SECONDS = 4.5  # after which a process that is to end is terminated, whatever its threads do
SWITCH_SECONDS = 0.0005  # of the GIL: requests are answered ten times faster than with the default
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_ENVIRONMENT_REMAPPINGS = {"__ip": "ROS_IP", "__hostname": "ROS_HOSTNAME", "__master": "ROS_MASTER_URI"}


class RosNode(Protocol):
    """A node for `run_server`; `shutdown` may be called twice."""

    finished: threading.Event

    def shutdown(self, by: str) -> None: ...


class _Failure(Exception):
    """The node cannot start; the text is the line for the user."""


class _WaitInterrupted(Exception):
    """A signal arrived while the node was waiting for a master (``--wait``)."""


def run_server(
    component: ComponentSpec,
    build: Callable[..., RosNode],
    argv: list[str] | None = None,
    prepare: Callable[[], object] = lambda: None,
    more_options: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> int:
    """Run the node of a component until a signal, its `kill` request or the master ends it.

    Parameters
    ----------
    component : ComponentSpec
        The component. Its name is the default name of the instance.
    build : callable
        Called with the name of the instance, and with the values of `more_options` by name, after `rospy.init_node`.
        It creates and starts the node.
    argv : list of str, optional
        The command line without the program; by default that of this process.
    prepare : callable, optional
        Called before `build`; it may take long, for instance to compile kernels.
    more_options : mapping, optional
        Further options of this component, such as ``--strict``, with the arguments for argparse.

    Returns
    -------
    int
        0 after a clean end (or, with -b, when the node has started), 1 if the node could not start. An invalid command
        line raises SystemExit(2), and -h and --version raise SystemExit(0).
    """
    arguments = sys.argv[1:] if argv is None else argv
    options = _parse(component, [a for a in arguments if ":=" not in a], more_options)
    own = {name: getattr(options, name) for name in (flag.lstrip("-") for flag in more_options)}
    remappings = [a for a in arguments if ":=" in a]
    return run_node(f"{component.name}-ros", functools.partial(build, **own), options, remappings, prepare)


def run_node(
    program: str,
    build: Callable[[str], RosNode],
    options: argparse.Namespace,
    remappings: list[str],
    prepare: Callable[[], object] = lambda: None,
) -> int:
    """Run a node until a signal, its `kill` request or the master ends it.

    Parameters
    ----------
    program : str
        The command, with which messages begin.
    build : callable
        Called with the name of the instance after `rospy.init_node`. It creates and starts the node.
    options : argparse.Namespace
        With `instance`, the name of the node, and the flags `background` and `wait`.
    remappings : list of str
        ROS remappings of the command line.
    prepare : callable, optional
        As for `run_server`.

    Returns
    -------
    int
        As `run_server`.
    """
    options.instance = dict(one.split(":=", 1) for one in remappings).get("__name", options.instance)
    fork = DaemonFork() if options.background else None
    if fork is not None and fork.in_parent:
        return fork.wait()
    received: list[int] = []
    for number in ending_signals():
        signal.signal(number, lambda number, frame: received.append(number))
    try:
        node = _start(program, build, options, remappings, received, prepare)
    except _WaitInterrupted:
        return 0
    except (_Failure, generate.GenerationError, master.MasterError, ComponentError, OSError) as problem:
        print(f"{program}: {printable(problem)}", file=sys.stderr)
        watchdog(END_SECONDS, 1)
        return 1
    import rospy

    ready = f"{program}: ready as {rospy.get_name()} at {os.environ['ROS_MASTER_URI']}"
    with contextlib.suppress(OSError):  # the reader of stderr has ended
        print(printable(ready), file=sys.stderr, flush=True)
    if fork is not None:
        fork.up()
    systemd.notify("READY=1")
    _serve(node, received)
    return 0


def ending_signals() -> list[int]:
    """Return the signals that end a server, SIGINT also for a background job of a script, SIGHUP not under nohup."""
    nohup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [number for number in SIGNALS if not (nohup and number == signal.SIGHUP)]


def ignore_signals() -> None:
    """Ignore further ending signals. At its end, Python removes handlers, and a signal would kill the process."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


# --- command line -----------------------------------------------------------------------------------------------


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {printable(message)}; {self.prog} -h lists the options\n")


def _parse(
    component: ComponentSpec, arguments: list[str], more_options: Mapping[str, Mapping[str, Any]]
) -> argparse.Namespace:
    program = f"{component.name}-ros"
    more = "".join(f" [{' '.join((name, one.get('metavar', ''))).strip()}]" for name, one in more_options.items())
    parser = Parser(
        prog=program,
        usage=f"{program} [-b] [-i NAME] [--wait]{more} [-h] [--version] [NAME:=VALUE ...]",
        description=f"{component.doc}.",
        epilog=f"ROS remappings are accepted: topics (a:=b) and __name, __ns, __master, __ip, __hostname, __log.\n\n"
        f"example:\n  {program} -b -i left        # serves /left/...; returns when the node has started",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "-b", "--background", action="store_true", help="run in the background when the node has started"
    )
    parser.add_argument(
        "-i",
        "--instance",
        "--name",
        metavar="NAME",
        default=component.name,
        help=f"name of the node, with which all its names begin (default: {component.name})",
    )
    parser.add_argument(
        "--wait",
        action="store_true",
        help=f"wait for a ROS master without a time limit, as a boot service must (default: {MASTER_SECONDS:g} s)",
    )
    for name, keywords in more_options.items():
        parser.add_argument(name, **keywords)
    parser.add_argument("--version", action="version", version=f"{component.name} {VERSION}")
    return parser.parse_args(arguments)


# --- start ------------------------------------------------------------------------------------------------------


def _start(
    program: str,
    build: Callable[[str], RosNode],
    options: argparse.Namespace,
    remappings: list[str],
    received: list[int],
    prepare: Callable[[], object],
) -> RosNode:
    mappings = dict(remapping.split(":=", 1) for remapping in remappings)
    if not re.fullmatch("[A-Za-z][A-Za-z0-9_]*", options.instance):
        raise _Failure(
            f"instance name: expected letters, digits and _, beginning with a letter, got {options.instance!r}; "
            "__ns:=robot1 sets the namespace"
        )
    for name, variable in _ENVIRONMENT_REMAPPINGS.items():
        if mappings.get(name):
            os.environ[variable] = mappings[name]
    malloc_tuning.limit_arenas()
    master.set_local_defaults()
    master.check_address(os.environ["ROS_MASTER_URI"])  # an invalid one is an error immediately
    master.check_family()
    warning = master.unreachable()
    if warning:
        print(f"{program}: warning: {printable(warning)}", file=sys.stderr, flush=True)
    _await_master(os.environ["ROS_MASTER_URI"], received, program if options.wait else "")
    generate.ensure_messages()
    paths.prefer_pypi_packages()
    ensure_log_directory()
    prepare()
    limit = watchdog(
        START_SECONDS,
        1,
        f"{program}: not started after {START_SECONDS:g} s: check that this machine is reachable by the "
        "name or address in ROS_HOSTNAME or ROS_IP",
    )
    sys.setswitchinterval(SWITCH_SECONDS)
    import rospy

    from rosafe.ros1.transport import registration

    try:
        registrar = registration.init_node(options.instance, [program, *remappings])
    except (rospy.ROSException, ValueError) as problem:
        raise _Failure(f"cannot start the node: {problem}") from problem
    log_to_stderr()
    try:
        try:
            node = build(options.instance)
        finally:
            registrar.up()  # raises if the node was requested to end, which is then the reason for any failure
    except rospy.ROSException as problem:
        raise _Failure(f"cannot start the node: {problem}") from None
    gc.freeze()  # collecting the objects of modules would stop all threads for tens of milliseconds, without result
    limit.cancel()
    return node


def _await_master(uri: str, received: list[int], patient: str) -> None:
    """Wait up to `MASTER_SECONDS` for a master. Raises MasterError if there is none, or at a signal.

    `patient` is the name of a program that waits without a limit, and reports this. A signal raises `_WaitInterrupted`.
    """
    deadline = time.monotonic() + MASTER_SECONDS
    reported = False
    while True:
        try:
            return master.check_master(uri, lambda: bool(received))
        except master.MasterError:
            if received and patient:
                raise _WaitInterrupted from None
            if received or (time.monotonic() > deadline and not patient):
                raise
        if patient and not reported:
            print(f"{patient}: waiting for a ROS master at {printable(uri)}", file=sys.stderr, flush=True)
            reported = True
        if patient:
            systemd.notify(f"STATUS=waiting for a ROS master at {uri}", "EXTEND_TIMEOUT_USEC=30000000")
        time.sleep(0.1)


_NAME = re.compile(r"__\w+:=")
_REMAPPING = re.compile(r"(__?|[~/])?[A-Za-z][\w/]*:=")  # _seconds:=0.5 sets a parameter of the node


def without_names(arguments: list[str]) -> list[str]:
    """Return the command line without the arguments that roslaunch adds for nodes, such as ``__name:=...``."""
    return [word for word in arguments if not _NAME.match(word)]


def without_remappings(arguments: list[str]) -> list[str]:
    """Return the command line without the arguments that roslaunch adds for nodes and for each ``<remap>``."""
    return [word for word in arguments if not _REMAPPING.match(word)]


def remappings_given() -> list[str]:
    """Return the program of this process and the arguments that `without_remappings` removes."""
    return [sys.argv[0], *(word for word in sys.argv[1:] if _REMAPPING.match(word))]


def become_node(name: str) -> None:
    """Make this process a ROS node, whose name begins with `name` unless roslaunch sets another one.

    Raises
    ------
    MasterError
        No master answers.
    GenerationError
        The messages cannot be generated.
    """
    import rospy

    from rosafe.ros1.transport import registration

    master.set_local_defaults()
    master.check_family()
    master.check_master(os.environ["ROS_MASTER_URI"])
    generate.ensure_messages()
    ensure_log_directory()
    try:
        registration.init_node(name, remappings_given(), anonymous=True).up()
    except (rospy.ROSException, ValueError) as problem:
        raise master.MasterError(f"cannot become a node: {problem}") from None
    log_to_stderr()


def ensure_log_directory() -> None:
    """Redirect rospy's log file to a temporary folder if the usual one is not writable, instead of failing."""
    import rospkg

    if not paths.writable(Path(rospkg.get_log_dir())):
        os.environ["ROS_LOG_DIR"] = str(paths.private_temporary() / "log")


def log_to_stderr() -> None:
    """Redirect rospy's information lines to stderr, where its warnings are: stdout is for the output of requests.

    Warnings of Python become warnings of the node. Text that they quote from clients and files is escaped.
    """
    import logging

    import rospy
    from rosgraph.roslogging import RosStreamHandler

    warnings.showwarning = lambda message, *_: rospy.logwarn("%s", message)

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
    """Wait until `node` has to end, because of a signal in `received` or another reason, and end it."""
    import rospy

    rospy.on_shutdown(lambda: node.shutdown("kill"))  # by us, rosnode kill, or a new node of this name
    ended = threading.Event()
    rospy.core.add_shutdown_hook(lambda reason: ended.set())  # after rospy's own, which unregister at the master
    # An Event must not be set from a signal handler, which may interrupt the wait while that holds its lock.
    while not received and not rospy.is_shutdown() and not node.finished.wait(0.1):
        pass
    systemd.notify("STOPPING=1")
    watchdog(END_SECONDS, 0)
    ignore_signals()
    rospy.signal_shutdown("signal" if received else "kill")
    ended.wait()  # another thread may be ending it already; the watchdog limits the time


def watchdog(seconds: float, code: int, message: str = "") -> threading.Timer:
    """Exit with `code` after `seconds`, unless the process has ended or the timer was cancelled before."""

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
    """A fork of this process: the parent waits until the child, which becomes the node, has started."""

    def __init__(self) -> None:
        self._reader, self._writer = os.pipe()
        sys.stdout.flush()
        sys.stderr.flush()
        self.in_parent = os.fork() > 0
        if not self.in_parent:
            os.close(self._reader)
            os.setsid()

    def wait(self) -> int:
        """In the parent: return 0 when the child has started, 1 if it has ended before, with a message."""
        os.close(self._writer)
        with os.fdopen(self._reader, "rb") as pipe:
            return 0 if pipe.read() == b"up" else 1

    def up(self) -> None:
        """In the child: let the parent exit, and close the terminal or pipe that they share."""
        nothing = os.open(os.devnull, os.O_RDWR)
        os.dup2(nothing, 0)
        for stream in (1, 2):
            if not stat.S_ISREG(os.fstat(stream).st_mode):
                os.dup2(nothing, stream)
        os.write(self._writer, b"up")
        os.close(self._writer)
