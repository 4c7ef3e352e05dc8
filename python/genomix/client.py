"""The connection to genomixd: persistent HTTP connections of one session, shared by all threads."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import re
import secrets
import socket
import threading
import weakref
from collections import deque
from typing import Any
from urllib.parse import quote, urlencode

from genomix import packed
from genomix.component import Component, label
from genomix.event import GenoMError, error_of

PORT = 8080
CONNECT_SECONDS = 5.0
ANSWER_SECONDS = 90.0  # genomixd answers within 75 s


class Client:
    """A session of genomixd, which gives access to the components of the ROS graph.

    It may be used by several threads. Activities continue when the program ends.

    Parameters
    ----------
    address : str
        See `genomix.connect`.
    """

    def __init__(self, address: str = "") -> None:
        self._link = _Link(*_host_and_port(address))
        self.dropped: deque[str] = deque()  # ids of requests without an object
        self._finalizer = weakref.finalize(self, self._link.end, os.getpid())
        self.get("/components")

    def rpath(self, path: str) -> None:
        """Do nothing: genomixd finds components on the ROS graph. The original searched plugins in this folder."""

    def load(self, component: str, *options: str) -> Component:
        """Return a component that runs or is starting.

        Parameters
        ----------
        component : str
            Name of the component, or the path of its plugin (``/opt/lib/genom/rosAFE.so``), whose file name counts.
        *options : str
            ``"-i", "INSTANCE"``: the name of its node, with namespaces, if it is not that of the component;
            ``"as", "NAME"``: its name in this session.

        Raises
        ------
        GenoMError
            The component does not run, or its interface is unknown.
        """
        given = dict(zip(options[::2], options[1::2], strict=False))
        if len(options) % 2 or not set(given) <= {"-i", "as"} or not all(isinstance(o, str) for o in options):
            what = f'load {component}: expected "-i", INSTANCE or "as", NAME after the component, got {options!r}'
            raise GenoMError("::genom::serialization", what=what)
        place = quote(str(component), safe="", errors="replace")
        about = self.get(f"/load/{place}", **{"i": given.get("-i", ""), "as": given.get("as", "")})
        if not isinstance(about, dict) or not isinstance(about.get("services"), dict):
            raise error_of(about)
        return Component(self, about)

    def unload(self, component: Component | str) -> None:
        """Forget a component of this session, which continues to run.

        Parameters
        ----------
        component : Component or str
            The component, its name in this session, or the path of its plugin.
        """
        name = component if isinstance(component, str) else label(component)
        if name.endswith(".so"):
            name = name.rsplit("/", 1)[-1].removesuffix(".so")
        self.get("/unload/" + quote(name, safe="", errors="replace"))

    def get(self, path: str, **query: str) -> Any:
        """Return the value of a URL of docs/genomixd.md; a GenoMError of the server is raised."""
        return self._link.get(path, query)

    def send(self, path: str, **query: str) -> dict[str, Any]:
        """Send a request in the background and return its state. Before, genomixd forgets those without an object."""
        while self.dropped:
            with contextlib.suppress(GenoMError):  # of another session, after a restart of genomixd
                self.get("/request/clean", id=self.dropped.popleft())
        return dict(self.get(path, **query))

    def __repr__(self) -> str:
        return f"<genomix.Client of genomixd at {self._link.address}>"


class _Link:
    """The HTTP connections of a session. A connection is used by one thread at a time."""

    def __init__(self, host: str, port: int) -> None:
        self.host = host
        self.port = port
        self.session = f"python.{os.getpid()}.{secrets.token_hex(4)}"
        self._lock = threading.Lock()
        self._idle: list[http.client.HTTPConnection] = []
        self._owner = os.getpid()  # a forked process opens its own connections

    @property
    def address(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"

    def get(self, path: str, query: dict[str, str], seconds: float = ANSWER_SECONDS) -> Any:
        url = f"{path}?{urlencode({'s': self.session, **query}, errors='replace')}"
        connection = self._connection()
        try:
            connection.sock.settimeout(seconds)
            connection.request("GET", url)
            response = connection.getresponse()
            body = response.read()
        except (OSError, http.client.HTTPException) as problem:
            connection.close()
            what = f"genomixd at {self.address} does not answer ({str(problem) or type(problem).__name__})"
            raise GenoMError("::genom::mwerr", what=what) from None
        except BaseException:  # the answer to an interrupted request would be taken for that to the next one
            connection.close()
            raise
        if not response.will_close:
            with self._lock:
                self._idle.append(connection)
        return _value(response, body)

    def end(self, owner: int) -> None:
        """End the session, in the process that has started it."""
        if os.getpid() == owner:
            with contextlib.suppress(GenoMError):  # genomixd has ended, and with it the session
                self.get("/session/stop", {}, CONNECT_SECONDS)
        with self._lock:
            while self._idle:
                self._idle.pop().close()

    def _connection(self) -> http.client.HTTPConnection:
        with self._lock:
            if self._owner != os.getpid():
                self._owner, self._idle = os.getpid(), []
            while self._idle:
                connection = self._idle.pop()
                if _is_open(connection.sock):
                    return connection
                connection.close()  # genomixd has closed it
        connection = http.client.HTTPConnection(self.host, self.port, timeout=CONNECT_SECONDS)
        try:
            connection.connect()
            connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except (OSError, UnicodeError) as problem:
            what = f"expected genomixd at {self.address}, got no connection ({problem}); start it: genomixd &"
            raise GenoMError("::genom::mwerr", what=what) from None
        return connection


def _is_open(sock: socket.socket) -> bool:
    """Return whether the server has neither closed an idle connection nor sent unexpected data."""
    sock.setblocking(False)
    try:
        sock.recv(1, socket.MSG_PEEK)
    except BlockingIOError:
        return True
    except OSError:
        pass
    return False


def _value(response: http.client.HTTPResponse, body: bytes) -> Any:
    """Return the value of an answer, or raise its error."""
    kind = response.headers.get_content_type()
    if kind == "application/octet-stream":
        return packed.decode(body)
    try:
        value = json.loads(body) if kind == "application/json" else body.decode()
    except ValueError:
        value = f"{response.status} {response.reason}"
    if response.status != http.client.OK:
        raise error_of(value)
    return value


def _host_and_port(address: str) -> tuple[str, int]:
    """Return host and port of an address such as ``"host"``, ``"host:8080"``, ``":8080"`` or ``"[::1]:8080"``."""
    text = str(address or os.environ.get("GENOMIXD", "")).strip().removeprefix("http://").rstrip("/")
    found = re.fullmatch(r"(?:\[([0-9a-fA-F:.%]+)\]|([^][:/\s]*))(?::([0-9]{1,5}))?", text)
    port = int(found[3] or PORT) if found else 0
    if not found or not 0 < port < 65536:
        raise GenoMError("::genom::mwerr", what=f"connect: expected host or host:port, got {address!r}")
    return found[1] or found[2] or "127.0.0.1", port
