"""Finding the ROS master: local defaults for the environment, and a probe that never hangs. Imports no rospy."""

from __future__ import annotations

import http.client
import os
import socket
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Mapping, MutableMapping
from typing import TypeVar, cast
from urllib.parse import urlsplit

DEFAULT_URI = "http://127.0.0.1:11311"
PROBE_SECONDS = 3.0
ANSWER_BYTES = 2**22  # to any call; the longest is the master's list of all topics
RESOLVE_SECONDS = 5.0  # the whole probe; a name server that is silent is not bound by the socket's timeout
FAILURES = (OSError, xmlrpc.client.Error, http.client.HTTPException, ValueError, SyntaxError)  # of a call, see `reason`

T = TypeVar("T")


class MasterError(Exception):
    """There is no master to work with; the text is one line that says what to do."""


def set_local_defaults(environ: MutableMapping[str, str] = os.environ) -> None:
    """Let ROS work on this machine alone where the environment says nothing else.

    Numbers instead of `localhost`, which rospy waits for without end on a machine without /etc/hosts. ROS_IP is left
    alone beside a master on another host, which could not call back to loopback. What is empty counts as not set;
    rospy would complain of it again and again.
    """
    for variable in ("ROS_HOSTNAME", "ROS_IP"):
        if environ.get(variable) == "":
            del environ[variable]
    if not environ.get("ROS_MASTER_URI"):
        environ["ROS_MASTER_URI"] = DEFAULT_URI
    if not (environ.get("ROS_IP") or environ.get("ROS_HOSTNAME")) and is_local(environ["ROS_MASTER_URI"]):
        environ["ROS_IP"] = "127.0.0.1"


def is_local(uri: str) -> bool:
    """Whether `uri` names this machine by a loopback address."""
    return _is_loopback(_host(uri))


def _host(uri: str) -> str:
    try:
        return urlsplit(uri).hostname or ""
    except ValueError:
        return ""


def _is_loopback(host: str) -> bool:
    return host in ("localhost", "::1") or host.startswith("127.")


def unreachable(environ: Mapping[str, str] = os.environ) -> str:
    """Why nobody could call a node that starts with this environment, and what to do; empty where all is well.

    A node tells the master ROS_HOSTNAME, or else ROS_IP, as the address to call it at.
    """
    variable = next((v for v in ("ROS_HOSTNAME", "ROS_IP") if environ.get(v)), "")
    if not variable:
        return ""
    host, uri = environ[variable], environ.get("ROS_MASTER_URI") or DEFAULT_URI
    found = _addresses(host)
    if not found:
        wrong = "which is no address, and no name that is known here: nobody can call a node"
    elif {"0.0.0.0", "::"} & set(found):
        wrong = "which is no address to call a node at"
    elif not any(map(_is_own, found)):
        wrong = "which is no address of this machine: nobody can call a node"
    elif _is_loopback(host) and not any(map(_is_own, _addresses(_host(uri) or host))):
        wrong = f"where only this machine can call a node, but the master is at {uri}"
    else:
        return ""
    return f"{variable} is {host}, {wrong}; unset it or set it to {_own_addresses(is_local(uri))}"


def _addresses(host: str) -> list[str]:
    """The addresses that `host` stands for; none where it stands for nothing, or the name server does not answer."""

    def resolve() -> list[str]:
        try:
            return [str(entry[4][0]) for entry in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)]
        except (OSError, UnicodeError):
            return []

    return _bounded(resolve, [])


def _is_own(address: str) -> bool:
    """Whether an address belongs to this machine: others cannot be bound."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_STREAM) as sock:
            sock.bind((address, 0))
            return True
    except OSError:
        return False


def _own_addresses(loopback: bool) -> str:
    try:
        from rosgraph.network import get_local_addresses
    except ImportError:
        return "an address of this machine"
    return " or ".join(a for a in get_local_addresses() if loopback or not _is_loopback(a)) or "an address of its own"


def check_address(uri: str) -> None:
    """Return if `uri` could be that of a ROS master, else raise MasterError."""
    try:
        parts = urlsplit(uri)
        usable = parts.scheme == "http" and parts.hostname and parts.port
    except ValueError:
        usable = None
    if not usable:
        raise MasterError(f"ROS_MASTER_URI is {uri!r}, which is no address like {DEFAULT_URI}")


def check_master(uri: str, give_up: Callable[[], bool] = lambda: False) -> None:
    """Return if a ROS master answers at `uri` within a few seconds, else (or once `give_up()`) raise MasterError."""
    check_address(uri)
    problem = _bounded(lambda: _ask(uri), "no answer", give_up)
    if problem:
        raise _error(uri, problem)


def _bounded(ask: Callable[[], T], otherwise: T, give_up: Callable[[], bool] = lambda: False) -> T:
    """What `ask()` returns within `RESOLVE_SECONDS`: name servers that are silent have no other bound."""
    outcome: list[T] = []
    asking = threading.Thread(target=lambda: outcome.append(ask()), daemon=True)
    asking.start()
    deadline = time.monotonic() + RESOLVE_SECONDS
    while asking.is_alive() and time.monotonic() < deadline and not give_up():
        asking.join(0.1)
    return outcome[0] if outcome else otherwise


def _error(uri: str, problem: str) -> MasterError:
    return MasterError(
        f"no ROS master at {uri} ({problem}): start roscore first, or set ROS_MASTER_URI to where it runs"
    )


def _ask(uri: str) -> str:
    """What is wrong with the master at `uri`; empty where it answers."""
    try:
        with proxy(uri) as master:
            master.getPid("/rosafe_probe")
    except FAILURES as problem:
        return reason(problem)
    return ""


def published_topics(uri: str, caller: str) -> dict[str, str]:
    """All topics that somebody publishes, with their types; MasterError where the master does not answer."""
    check_master(uri)
    try:
        with proxy(uri) as master:
            _, _, topics = cast(tuple[int, str, list[list[str]]], master.getPublishedTopics(caller, ""))
    except FAILURES as problem:
        raise _error(uri, reason(problem)) from None
    return dict(topics)


def node_address(uri: str, name: str) -> str | None:
    """The address that the master at `uri` has for a node, None if it has none; raises `FAILURES`."""
    with proxy(uri) as master:
        code, _, address = cast(tuple[int, str, str], master.lookupNode(name, name))
    return address if code == 1 else None


def reason(problem: Exception) -> str:
    """In a few words, why a call of the master came to nothing."""
    if isinstance(problem, TimeoutError):
        return "no answer"
    if isinstance(problem, OSError):
        return problem.strerror or str(problem)
    return f"not a ROS master: {type(problem).__name__}"


def uri() -> str:
    """Where the master is, as the environment says."""
    return os.environ.get("ROS_MASTER_URI") or DEFAULT_URI


def proxy(uri: str, seconds: float = PROBE_SECONDS) -> xmlrpc.client.ServerProxy:
    """The master at `uri`, or another XML-RPC server, with calls that end within `seconds` where nothing comes."""
    return xmlrpc.client.ServerProxy(uri, transport=Transport(seconds))


class Transport(xmlrpc.client.Transport):
    """HTTP that gives up: where nothing comes for some seconds, and where too much comes."""

    accept_gzip_encoding = False  # packed, a short answer may be long

    def __init__(self, seconds: float = PROBE_SECONDS) -> None:
        super().__init__()
        self._seconds = seconds

    def make_connection(self, host: object) -> http.client.HTTPConnection:
        connection = super().make_connection(host)  # type: ignore[arg-type]
        connection.timeout = self._seconds
        connection.response_class = _Answer
        return connection


class _Answer(http.client.HTTPResponse):
    """One of bounded length; ValueError beyond it."""

    _taken = 0

    def read(self, amt: int | None = None) -> bytes:
        data = super().read(ANSWER_BYTES + 1 if amt is None else amt)
        self._taken += len(data)
        if self._taken > ANSWER_BYTES:
            raise ValueError(f"an answer of more than {ANSWER_BYTES} bytes")
        return data


class PrivateMaster:
    """A master of this process' own on a free port of the loopback interface, up once made.

    Use it as a context manager, or `close` it. `uri` is its address.
    """

    def __init__(self) -> None:
        import rosmaster.master

        set_local_defaults()
        self._master = rosmaster.master.Master(port=0)
        self._master.start()
        self.uri = f"http://127.0.0.1:{self._master.master_node.port}"

    def close(self) -> None:
        """End the master; nodes that it knows notice at their next call."""
        self._master.stop()

    def __enter__(self) -> PrivateMaster:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
