"""Access to the ROS master: defaults for the environment, and calls with a time limit. Does not import rospy."""

from __future__ import annotations

import contextlib
import http.client
import logging
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
ANSWER_BYTES = 2**22  # of the answer to any call; the longest is the master's list of all topics
RESOLVE_SECONDS = 5.0  # for the whole probe: the socket's timeout does not include name resolution
FAILURES = (OSError, xmlrpc.client.Error, http.client.HTTPException, ValueError, SyntaxError)  # of a call, see `reason`

T = TypeVar("T")


class MasterError(Exception):
    """No master can be reached; the message is one line and ends with the next step for the user."""


def set_local_defaults(environ: MutableMapping[str, str] = os.environ) -> None:
    """Set ROS variables that are unset or empty, so that ROS works on this machine alone.

    The address is 127.0.0.1 because rospy waits forever for `localhost` on a machine without /etc/hosts. ROS_IP is not
    set if the master is on another host, which could not call back to loopback, or with ROS_IPV6=on. Empty variables
    are removed because rospy logs a warning about them repeatedly.
    """
    for variable in ("ROS_HOSTNAME", "ROS_IP"):
        if environ.get(variable) == "":
            del environ[variable]
    if not environ.get("ROS_MASTER_URI"):
        environ["ROS_MASTER_URI"] = DEFAULT_URI
    named = environ.get("ROS_IP") or environ.get("ROS_HOSTNAME") or environ.get("ROS_IPV6") == "on"
    if not named and is_local(environ["ROS_MASTER_URI"]):
        environ["ROS_IP"] = "127.0.0.1"


def is_local(uri: str) -> bool:
    """Return whether the host of `uri` is a loopback address."""
    return _is_loopback(_host(uri))


def _host(uri: str) -> str:
    try:
        return urlsplit(uri).hostname or ""
    except ValueError:
        return ""


def _is_loopback(host: str) -> bool:
    return host in ("localhost", "::1") or host.startswith("127.")


def unreachable(environ: Mapping[str, str] = os.environ) -> str:
    """Return why a node with this environment could not be called and how to correct it; empty if it can be called.

    A node registers ROS_HOSTNAME, or ROS_IP if that is not set, as its address at the master.
    """
    if problem := wrong_family(environ):
        return problem
    variable = _address_variable(environ)
    if not variable:
        return ""
    host, uri = environ[variable], environ.get("ROS_MASTER_URI") or DEFAULT_URI
    found = _addresses(host)
    if not found:
        problem = "neither an address nor a name that is known on this machine: nodes cannot be called"
    elif {"0.0.0.0", "::"} & set(found):
        problem = "which is not an address that nodes can be called at"
    elif not any(map(_is_own, found)):
        problem = "which is not an address of this machine: nodes cannot be called"
    elif _is_loopback(host) and not any(map(_is_own, _addresses(_host(uri) or host))):
        problem = f"at which only this machine can call nodes, but the master is at {uri}"
    else:
        return ""
    return f"{variable} is {host}, {problem}; unset it or set it to {_own_addresses(is_local(uri))}"


def _address_variable(environ: Mapping[str, str]) -> str:
    return next((variable for variable in ("ROS_HOSTNAME", "ROS_IP") if environ.get(variable)), "")


def wrong_family(environ: Mapping[str, str] = os.environ) -> str:
    """Return why rospy's nodes would listen at other addresses than they register; empty if they would not.

    rospy listens for IPv6 only with ROS_IPV6=on, then at ::1 only for a loopback address, and it puts no brackets
    around an IPv6 address in a URI.
    """
    variable = _address_variable(environ)
    host, ipv6 = environ.get(variable, ""), environ.get("ROS_IPV6") == "on"
    if ":" in host:
        return (
            f"{variable}: expected an IPv4 address or a name, because ROS nodes with an IPv6 address cannot be called, "
            f"got {host}; set it to an IPv4 address, or set ROS_IPV6=on and ROS_HOSTNAME to a name of that address"
        )
    found = _addresses(host) if host else []
    if ipv6 and found and _is_loopback(host) and "::1" not in found:
        return f"{variable}: expected a name of ::1, because of ROS_IPV6=on, got {host}; unset ROS_IPV6 or {variable}"
    if not ipv6 and found and all(":" in address for address in found):
        return (
            f"{variable}: expected an IPv4 address or a name of one, got {host} ({found[0]}); set ROS_IPV6=on for IPv6"
        )
    return ""


def check_family() -> None:
    """Raise MasterError if nodes of this environment would listen at other addresses than they register."""
    if problem := wrong_family():
        raise MasterError(problem)


def _addresses(host: str) -> list[str]:
    """Return the addresses of `host`; none if the name is unknown or the name server does not answer."""

    def resolve() -> list[str]:
        try:
            return [str(entry[4][0]) for entry in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)]
        except (OSError, UnicodeError):
            return []

    return bounded(resolve, [])


def _is_own(address: str) -> bool:
    """Return whether an address belongs to this machine: other addresses cannot be bound."""
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
    """Raise MasterError if `uri` is not a valid address of a ROS master."""
    try:
        parts = urlsplit(uri)
        usable = parts.scheme == "http" and parts.hostname and parts.port
    except ValueError:
        usable = None
    if not usable:
        raise MasterError(f"ROS_MASTER_URI: expected an address such as {DEFAULT_URI}, got {uri!r}")


def check_master(uri: str, give_up: Callable[[], bool] = lambda: False) -> None:
    """Raise MasterError if no ROS master answers at `uri` within a few seconds and before `give_up()` returns True."""
    check_address(uri)
    problem = bounded(lambda: _ask(uri), "no answer", give_up)
    if problem:
        raise _error(uri, problem)


def bounded(
    call: Callable[[], T],
    default: T,
    give_up: Callable[[], bool] = lambda: False,
    seconds: float = RESOLVE_SECONDS,
) -> T:
    """Return `call()`, or `default` after `seconds` or `give_up()`: name resolution has no other time limit."""
    results: list[T] = []
    thread = threading.Thread(target=lambda: results.append(call()), daemon=True)
    thread.start()
    deadline = time.monotonic() + seconds
    while thread.is_alive() and time.monotonic() < deadline and not give_up():
        thread.join(0.1)
    return results[0] if results else default


def _error(uri: str, problem: str) -> MasterError:
    return MasterError(
        f"no ROS master at {uri} ({problem}): start roscore first, or set ROS_MASTER_URI to where it runs"
    )


def _ask(uri: str) -> str:
    """Return why the master at `uri` cannot be used; empty if it answers."""
    try:
        with proxy(uri) as master:
            master.getPid("/rosafe_probe")
    except FAILURES as problem:
        return reason(problem)
    return ""


def published_topics(uri: str, caller: str) -> dict[str, str]:
    """Return all published topics with their types; MasterError if the master does not answer."""
    check_master(uri)
    try:
        with proxy(uri) as master:
            _, _, topics = cast(tuple[int, str, list[list[str]]], master.getPublishedTopics(caller, ""))
    except FAILURES as problem:
        raise _error(uri, reason(problem)) from None
    return dict(topics)


def node_address(uri: str, name: str) -> str | None:
    """Return the address of a node at the master `uri`, None if it is not registered; raises `FAILURES`."""
    with proxy(uri) as master:
        code, _, address = cast(tuple[int, str, str], master.lookupNode(name, name))
    return address if code == 1 else None


def reason(problem: Exception) -> str:
    """Return in a few words why a call of the master failed."""
    if isinstance(problem, TimeoutError):
        return "no answer"
    if isinstance(problem, OSError):
        return problem.strerror or str(problem)
    return f"not a ROS master: {type(problem).__name__}"


def uri() -> str:
    """Return the address of the master from the environment."""
    return os.environ.get("ROS_MASTER_URI") or DEFAULT_URI


def proxy(uri: str, seconds: float = PROBE_SECONDS) -> xmlrpc.client.ServerProxy:
    """Return a proxy of the master or another XML-RPC server at `uri`; a call fails after `seconds` without data."""
    return xmlrpc.client.ServerProxy(uri, transport=Transport(seconds))


class Transport(xmlrpc.client.Transport):
    """An HTTP transport whose calls are limited in time and in the length of the answer."""

    accept_gzip_encoding = False  # a short compressed answer may expand to a long one

    def __init__(self, seconds: float = PROBE_SECONDS) -> None:
        super().__init__()
        self._seconds = seconds

    def make_connection(self, host: object) -> http.client.HTTPConnection:
        connection = super().make_connection(host)  # type: ignore[arg-type]
        connection.timeout = self._seconds
        connection.response_class = _Answer
        return connection


class _Answer(http.client.HTTPResponse):
    """An answer of limited length; reading beyond the limit raises ValueError."""

    _received = 0

    def read(self, amt: int | None = None) -> bytes:
        data = super().read(ANSWER_BYTES + 1 if amt is None else amt)
        self._received += len(data)
        if self._received > ANSWER_BYTES:
            raise ValueError(f"an answer of more than {ANSWER_BYTES} bytes")
        return data


_NO_OUTPUT = logging.NullHandler()


class PrivateMaster(contextlib.AbstractContextManager["PrivateMaster"]):
    """A ROS master in this process, on a free port of the loopback interface, started by the constructor.

    Use it as a context manager, or call `close`. `uri` is its address.
    """

    def __init__(self) -> None:
        import rosmaster.master

        set_local_defaults()
        for name in ("xmlrpc", "rosmaster"):  # otherwise, Python prints the tracebacks of its dead clients to stderr
            logging.getLogger(name).addHandler(_NO_OUTPUT)
        self._master = rosmaster.master.Master(port=0)
        self._master.start()
        self.uri = f"http://127.0.0.1:{self._master.master_node.port}"

    def close(self) -> None:
        """End the master; its nodes notice at their next call."""
        self._master.stop()

    def __exit__(self, *exception: object) -> None:
        self.close()
