"""The command `genomixd`: options, background, signals, a clean end."""

from __future__ import annotations

import argparse
import asyncio
import errno
import logging
import os
import resource
import signal
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

from rosafe.client.graph import JOIN_SECONDS, Graph
from rosafe.component import generate, startup
from rosafe.genomix.names import Names, parameter_name
from rosafe.genomix.routes import HttpApi
from rosafe.genomix.sessions import Sessions
from rosafe.http_server.access import host_name, own_names
from rosafe.terminal import printable
from rosafe.transport import master, systemd
from rosafe.version import VERSION

DEFAULT_PORT = 8080
DEFAULT_HOST = "127.0.0.1"
THREADS = 16  # that wait for rospy


def main(argv: list[str] | None = None) -> int:
    """Run genomixd until a signal ends it; the exit code."""
    options = _parse(startup.without_names(sys.argv[1:] if argv is None else argv))
    _log_to_stderr(2 if options.debug else min(options.verbose, 2))
    told = startup.DaemonFork() if options.background else None
    if told is not None and told.in_parent:
        return told.wait()
    master.set_local_defaults()
    try:
        generate.ensure_messages()
        startup.ensure_log_directory()
        return asyncio.run(_serve(options, told))
    except (generate.GenerationError, OSError, ValueError) as problem:
        print(f"genomixd: {printable(_told(problem, options))}", file=sys.stderr)
        return 1


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = startup.Parser(
        prog="genomixd",
        usage="genomixd [-p PORT] [--host HOST] [--name NAME] [-b] [-d] [-v] [-h] [--version]",
        description="HTTP server for the components of the ROS graph: Tcl, MATLAB and other clients use them by it.",
        epilog="example:\n  genomixd -p 8081 &\n  curl http://127.0.0.1:8081/call/rosAFE/getParameters\n\n"
        "Programs on this machine may use it; with --host others too, whoever can reach that address.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("-p", "--port", type=_port, default=DEFAULT_PORT, help="TCP port (8080; 0: a free one)")
    parser.add_argument("--host", default=DEFAULT_HOST, help="address to listen on (default: 127.0.0.1)")
    parser.add_argument(
        "--name",
        type=_name,
        action="append",
        default=[],
        help="a further name by which clients call this machine, such as robot.lab; repeatable",
    )
    parser.add_argument("-b", "--background", action="store_true", help="go to the background once it serves")
    parser.add_argument("-d", "--debug", action="store_true", help="say on stderr what is asked")
    parser.add_argument("-v", "--verbose", action="count", default=0, help="say more; twice: as -d")
    parser.add_argument(
        "--until-eof",
        action="store_true",
        help="say the port on stdout, and end with the standard input: a private server of the program that starts it",
    )
    parser.add_argument("--version", action="version", version=f"genomixd {VERSION}")
    return parser.parse_args(arguments)


def _name(text: str) -> str:
    if not host_name(text):
        raise argparse.ArgumentTypeError(f"expected the name of a host, such as robot.lab, got {text!r}")
    return text


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"{text!r} is no port: 0 to 65535")
    return int(text)


def _told(problem: Exception, options: argparse.Namespace) -> str:
    number = getattr(problem, "errno", None)
    if number == errno.EADDRINUSE:
        return f"port {options.port} of {options.host} is taken, perhaps by another genomixd; -p chooses another"
    if number == errno.EACCES:
        return f"port {options.port} of {options.host} is not for this user; -p chooses another"
    if isinstance(problem, UnicodeError):  # of a host's name
        return f"--host: expected a name or address of this machine, got {options.host!r}"
    return str(problem)


class _Formatter(logging.Formatter):
    """Escapes what a line of the log quotes from clients."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return printable(super().formatMessage(record))


def _log_to_stderr(verbosity: int) -> None:
    handler = logging.StreamHandler()
    handler.setFormatter(_Formatter("genomixd: %(message)s"))
    log = logging.getLogger("genomixd")
    log.addHandler(handler)
    log.setLevel((logging.WARNING, logging.INFO, logging.DEBUG)[verbosity])
    log.propagate = False  # rospy sets up the root for itself


async def _serve(options: argparse.Namespace, told: startup.DaemonFork | None) -> int:
    loop = asyncio.get_running_loop()
    end = asyncio.Event()
    for number in startup.ending_signals():
        loop.add_signal_handler(number, end.set)
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    loop.set_default_executor(ThreadPoolExecutor(THREADS, "rospy"))
    _allow_many_files()
    sys.setswitchinterval(startup.SWITCH_SECONDS)
    graph = Graph(os.environ["ROS_MASTER_URI"], server=True)
    names = Names(graph, parameter_name(sys.argv[1:]), {*own_names(), options.host, *options.name})
    server = HttpApi(Sessions(graph), names)
    try:
        port = await server.start(options.host, options.port)
        logging.getLogger("genomixd").info("serving http://%s:%d", options.host, port)
        if options.until_eof:
            print(port, flush=True)
            threading.Thread(target=_wait_for_eof, args=(loop, end), daemon=True).start()
        joining = asyncio.create_task(graph.join())
        ended = asyncio.create_task(graph.gone.wait())
        # A master that is there is to know the node once it is up; one that is not may come later.
        await asyncio.wait((joining, ended), timeout=JOIN_SECONDS, return_when=asyncio.FIRST_COMPLETED)
        if told is not None:
            told.up()
        systemd.notify("READY=1")
        feeding = asyncio.create_task(_feed_watchdog())
        waits = [asyncio.create_task(event.wait()) for event in (end, graph.gone)]
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        feeding.cancel()
        systemd.notify("STOPPING=1")
        return int(graph.gone.is_set() and not graph.is_node)
    finally:
        startup.watchdog(startup.END_SECONDS, 0)
        await server.close()
        await graph.close()


async def _feed_watchdog() -> None:
    """Tell systemd that requests have their turn, if it asks for that."""
    seconds = systemd.watchdog_seconds()
    while seconds is not None:
        systemd.notify("WATCHDOG=1")
        await asyncio.sleep(seconds / 3)


def _wait_for_eof(loop: asyncio.AbstractEventLoop, end: asyncio.Event) -> None:
    while os.read(0, 4096):
        continue
    if not loop.is_closed():
        loop.call_soon_threadsafe(end.set)


def _allow_many_files() -> None:
    """As many connections as the system lets this user have."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
