"""The command `genomixd`: options, background mode, signals, and shutdown."""

from __future__ import annotations

import argparse
import asyncio
import logging
import os
import resource
import sys
import threading

from rosafe.ros1.client.asyncio_tools import set_up_server, wait_any
from rosafe.ros1.client.graph import JOIN_SECONDS, Graph
from rosafe.ros1.component import generate, startup
from rosafe.ros1.transport import master, systemd
from rosafe.system import option_types
from rosafe.system.terminal import printable
from rosafe.system.version import VERSION
from rosafe.web.genomix.routes import HttpApi, Names, parameter_name
from rosafe.web.genomix.sessions import Sessions
from rosafe.web.server.access import host_name, own_names

DEFAULT_PORT = 8080
DEFAULT_HOST = "127.0.0.1"
THREADS = 16  # for blocking calls of rospy


def main(argv: list[str] | None = None) -> int:
    """Run genomixd until a signal ends it; return the exit code."""
    options = _parse(startup.without_remappings(sys.argv[1:] if argv is None else argv))
    _log_to_stderr(2 if options.debug else min(options.verbose, 2))
    fork = startup.DaemonFork() if options.background else None
    if fork is not None and fork.in_parent:
        return fork.wait()
    master.set_local_defaults()
    try:
        master.check_family()
        generate.ensure_messages()
        startup.ensure_log_directory()
        return asyncio.run(_serve(options, fork))
    except (generate.GenerationError, master.MasterError, OSError, ValueError) as problem:
        print(f"genomixd: {printable(str(problem))}", file=sys.stderr)
        return 1


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = startup.Parser(
        prog="genomixd",
        usage="genomixd [-p PORT] [--host HOST] [--name NAME] [-b] [-d] [-v] [-h] [--version]",
        description="HTTP server that gives Tcl, MATLAB and other clients access to the components of the ROS graph.",
        epilog="example:\n  genomixd -p 8081 &\n  curl http://127.0.0.1:8081/call/rosAFE/getParameters\n\n"
        "All programs on this machine can use it; with --host, all machines that can reach that address.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "-p", "--port", type=option_types.port(), default=DEFAULT_PORT, help="TCP port (8080; 0: a free one)"
    )
    parser.add_argument("--host", default=DEFAULT_HOST, help="address to listen on (default: 127.0.0.1)")
    parser.add_argument(
        "--name",
        type=_name,
        action="append",
        default=[],
        help="an additional name of this machine that clients use, such as robot.lab; repeatable",
    )
    parser.add_argument("-b", "--background", action="store_true", help="run in the background when it is ready")
    parser.add_argument("-d", "--debug", action="store_true", help="log requests on stderr")
    parser.add_argument("-v", "--verbose", action="count", default=0, help="log more; twice: like -d")
    parser.add_argument(
        "--until-eof",
        action="store_true",
        help="print the port on stdout, and end when the standard input ends: a private server of its parent program",
    )
    parser.add_argument("--version", action="version", version=f"genomixd {VERSION}")
    return parser.parse_args(arguments)


def _name(text: str) -> str:
    if not host_name(text):
        raise argparse.ArgumentTypeError(f"expected the name of a host, such as robot.lab, got {text!r}")
    return text


class _Formatter(logging.Formatter):
    """Escapes control characters in log lines, which may quote clients."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return printable(super().formatMessage(record))


def _log_to_stderr(verbosity: int) -> None:
    handler = logging.StreamHandler()
    handler.setFormatter(_Formatter("genomixd: %(message)s"))
    log = logging.getLogger("genomixd")
    log.addHandler(handler)
    log.setLevel((logging.WARNING, logging.INFO, logging.DEBUG)[verbosity])
    log.propagate = False  # rospy configures the root logger


async def _serve(options: argparse.Namespace, fork: startup.DaemonFork | None) -> int:
    loop = asyncio.get_running_loop()
    end = set_up_server(THREADS)
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
        # If the master runs, the node is registered before genomixd reports that it is ready. It may also start later.
        await asyncio.wait((joining, ended), timeout=JOIN_SECONDS, return_when=asyncio.FIRST_COMPLETED)
        if fork is not None:
            fork.up()
        systemd.notify("READY=1")
        feeding = asyncio.create_task(_feed_watchdog())
        await wait_any(end, graph.gone)
        feeding.cancel()
        systemd.notify("STOPPING=1")
        return int(graph.gone.is_set() and not graph.is_node)
    finally:
        startup.watchdog(startup.END_SECONDS, 0)
        await server.close()
        await graph.close()


async def _feed_watchdog() -> None:
    """Notify systemd's watchdog, if there is one, that the event loop runs."""
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
    """Raise the limit of file descriptors to the hard limit."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
