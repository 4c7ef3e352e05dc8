"""Finding the ROS master: local defaults for the environment, and a probe that never hangs. Imports no rospy."""

from __future__ import annotations

import http.client
import os
import threading
import xmlrpc.client
from collections.abc import MutableMapping
from typing import cast
from urllib.parse import urlsplit

DEFAULT_URI = "http://127.0.0.1:11311"
PROBE_SECONDS = 3.0
RESOLVE_SECONDS = 5.0  # the whole probe; a name server that is silent is not bound by the socket's timeout
FAILURES = (OSError, xmlrpc.client.Error, http.client.HTTPException, ValueError, SyntaxError)  # of a call, see `reason`


class MasterError(Exception):
    """There is no master to work with; the text is one line that says what to do."""


def set_local_defaults(environ: MutableMapping[str, str] = os.environ) -> None:
    """Let ROS work on this machine alone where the environment says nothing else.

    Numbers instead of `localhost`, which rospy waits for without end on a machine without /etc/hosts. ROS_IP is left
    alone beside a master on another host, which could not call back to loopback.
    """
    if not environ.get("ROS_MASTER_URI"):
        environ["ROS_MASTER_URI"] = DEFAULT_URI
    if not (environ.get("ROS_IP") or environ.get("ROS_HOSTNAME")) and is_local(environ["ROS_MASTER_URI"]):
        environ["ROS_IP"] = "127.0.0.1"


def is_local(uri: str) -> bool:
    """Whether `uri` names this machine by a loopback address."""
    try:
        host = urlsplit(uri).hostname or ""
    except ValueError:
        return False
    return host in ("localhost", "::1") or host.startswith("127.")


def check_address(uri: str) -> None:
    """Return if `uri` could be that of a ROS master, else raise MasterError."""
    try:
        parts = urlsplit(uri)
        usable = parts.scheme == "http" and parts.hostname and parts.port
    except ValueError:
        usable = None
    if not usable:
        raise MasterError(f"ROS_MASTER_URI is {uri!r}, which is no address like {DEFAULT_URI}")


def check_master(uri: str) -> None:
    """Return if a ROS master answers at `uri` within a few seconds, else raise MasterError."""
    check_address(uri)
    outcome: list[str] = []
    asking = threading.Thread(target=lambda: outcome.append(_ask(uri)), daemon=True)
    asking.start()
    asking.join(RESOLVE_SECONDS)
    problem = outcome[0] if outcome else "no answer"
    if problem:
        raise _error(uri, problem)


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


def proxy(uri: str) -> xmlrpc.client.ServerProxy:
    """The master at `uri`, or another XML-RPC server, with calls that end within `PROBE_SECONDS`."""
    return xmlrpc.client.ServerProxy(uri, transport=Transport())


class Transport(xmlrpc.client.Transport):
    """HTTP that gives up."""

    def make_connection(self, host: object) -> http.client.HTTPConnection:
        connection = super().make_connection(host)  # type: ignore[arg-type]
        connection.timeout = PROBE_SECONDS
        return connection


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
