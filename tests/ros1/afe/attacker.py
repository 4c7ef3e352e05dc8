"""Attacks of a hostile or broken peer on a node, and checks of the node afterwards."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import socket
import socketserver
import struct
import threading
import time
import xmlrpc.client
import xmlrpc.server
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import rosgraph
from rosgraph.network import encode_ros_handshake_header, read_ros_handshake_header

from rosafe.system import log_throttle
from tests.harness import PATIENCE, Graph, Process, proc, wait_for

WELL_SECONDS = 4.0  # for any call of a healthy node; silent clients block a faulty one for 5 s or more
HUGE = 0xFFFFFFFF


class Target:
    """A node under attack."""

    def __init__(self, graph: Graph, process: Process, name: str) -> None:
        self.graph = graph
        self.process = process
        self.name = name
        self._master = rosgraph.Master("/attacker", master_uri=graph.uri)
        state = importlib.import_module(f"{'bass' if 'bass' in name else 'rosAFE'}.msg")
        self._state = state.genom_state_component
        api, service = self._master.lookupNode(f"/{name}"), self._master.lookupService(f"/{name}/Stop")
        self.api_uri = api
        self.ports = {"XML-RPC": _address(api), "TCPROS": _address(service)}

    # --- attacks ---

    def connect(self, port: str, data: bytes = b"") -> socket.socket:
        """Open a connection and send data."""
        sock = socket.create_connection(self.ports[port], PATIENCE)
        sock.sendall(data)
        return sock

    def subscribe(self, topic: str, caller: str = "/attacker", wait: bool = True) -> socket.socket:
        """Connect a subscriber that never reads; without `wait`, its header is not answered yet."""
        fields = {"topic": f"/{self.name}/{topic}", "md5sum": "*", "type": "*", "callerid": caller}
        return self._greet(fields, wait)

    def client(self, service: str, **fields: str) -> socket.socket:
        """Connect a service client that has not sent a request yet."""
        return self._greet({"service": f"/{self.name}/{service}", "md5sum": "*", "callerid": "/attacker", **fields})

    def _greet(self, fields: dict[str, str], wait: bool = True) -> socket.socket:
        sock = self.connect("TCPROS", encode_ros_handshake_header(fields))
        if wait:
            read_ros_handshake_header(sock, io.BytesIO(), 4096)
        return sock

    # --- checks ---

    def assert_healthy(self) -> None:
        """Check that new clients are served immediately: a service call, the master or a tool, and a subscriber.

        Makes up to three attempts, as the machine may be busy.
        """
        for _ in range(3):
            took = self._ask()
            if max(took) < WELL_SECONDS:
                return
        raise AssertionError(f"service, XML-RPC, topic: {took} s; {self.process}")

    def _ask(self) -> tuple[float, float, float]:
        begin = time.monotonic()
        self.graph.call(f"/{self.name}/abort_activity", activity=2**32 - 1)
        called = time.monotonic()
        node: Any = xmlrpc.client.ServerProxy(self.api_uri)
        assert node.getPid("/test")[2] == self.process.pid
        requested = time.monotonic()
        self.graph.message(f"/{self.name}/genom_state", self._state)
        return called - begin, requested - called, time.monotonic() - requested

    @property
    def descriptors(self) -> int:
        return len(os.listdir(proc(self.process.pid, "fd")))

    @property
    def megabytes(self) -> float:
        return int(proc(self.process.pid, "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    @property
    def _all_imported(self) -> bool:
        """Return whether rosAFE has imported `scipy.signal`, which it does after it has reported that it is ready."""
        return "bass" in self.name or "scipy/signal/_peak_finding" in proc(self.process.pid, "maps").read_text()

    @contextmanager
    def needs_no_resources(self, megabytes: float = 30.0) -> Iterator[None]:
        """Check after the block that the node is healthy and has the same number of descriptors and no more memory."""
        self.assert_healthy()
        wait_for(lambda: self._all_imported, what="the end of imports after start-up")
        descriptors, before = self.descriptors, self.megabytes
        yield
        self.assert_healthy()
        wait_for(
            lambda: self.descriptors <= descriptors + 2,
            what=lambda: f"{descriptors} descriptors, there are {self.descriptors}",
        )
        assert self.megabytes < before + megabytes
        assert self.process.alive and "Traceback" not in self.process.err, self.process

    def logged(self, pattern: str) -> int:
        """Return the number of log lines about an event, without summaries."""
        lines = self.process.err.splitlines()
        return sum(bool(re.search(pattern, line)) and " like it in " not in line for line in lines)

    @contextmanager
    def logs_once(self, *patterns: str) -> Iterator[None]:
        """Check that the block logs lines of each kind, at most one in a second, or none directly after another one."""
        before, begin = {pattern: self.logged(pattern) for pattern in patterns}, time.monotonic()
        yield
        for pattern in patterns:
            wait_for(lambda: self.logged(pattern), what=lambda: f"{pattern} in {self.process}")  # noqa: B023
            logged = self.logged(pattern)
            assert logged <= before[pattern] + 1 + (time.monotonic() - begin) / log_throttle.PERIOD


def _address(uri: str) -> tuple[str, int]:
    parts = urlsplit(uri)
    assert parts.hostname and parts.port
    return parts.hostname, parts.port


def answer(sock: socket.socket) -> bytes:
    """Return all data from the node until it closes the connection."""
    sock.settimeout(PATIENCE)
    data = b""
    with contextlib.suppress(ConnectionError):
        while part := sock.recv(65536):
            data += part
    return data


def flood(sock: socket.socket, data: bytes, most: int = 200_000_000) -> int:
    """Send `data` repeatedly until the node does not read it any more. Return the number of bytes sent."""
    sent = 0
    sock.settimeout(PATIENCE)
    with contextlib.suppress(ConnectionError):
        while sent < most:
            sent += sock.send(data)
    return sent


class FakePublisher:
    """A publisher that looks valid to the master and to subscribers, and then sends any data.

    Parameters
    ----------
    behave : callable
        Called with each connection of a subscriber whose header has been read.
    on_request : callable, optional
        Returns the response of requestTopic for the port; by default a valid one.
    """

    def __init__(
        self,
        graph: Graph,
        topic: str,
        kind: str,
        behave: Callable[[socket.socket], None],
        on_request: Callable[[int], Any] | None = None,
        name: str = "/evil_publisher",
    ) -> None:
        self.calls = 0

        class Connection(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                read_ros_handshake_header(self.request, io.BytesIO(), 4096)
                behave(self.request)

        class Listener(socketserver.ThreadingTCPServer):
            daemon_threads = True
            block_on_close = False

        class Api(socketserver.ThreadingMixIn, xmlrpc.server.SimpleXMLRPCServer):
            daemon_threads = True
            block_on_close = False

        def request_topic(*_: Any) -> Any:
            self.calls += 1
            return on_request(port) if on_request else (1, "", ["TCPROS", "127.0.0.1", port])

        self._listener = Listener(("127.0.0.1", 0), Connection)
        port = self._listener.server_address[1]
        self._api = Api(("127.0.0.1", 0), logRequests=False)
        self._api.register_function(request_topic, "requestTopic")
        for server in (self._listener, self._api):
            threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        self._topic = topic
        self._uri = f"http://127.0.0.1:{self._api.server_address[1]}/"
        self._master = xmlrpc.client.ServerProxy(graph.uri)
        self._name = name
        self._master.registerPublisher(name, topic, kind, self._uri)

    def __enter__(self) -> FakePublisher:
        return self

    def __exit__(self, *_: object) -> None:
        self._master.unregisterPublisher(self._name, self._topic, self._uri)
        for server in (self._listener, self._api):
            server.shutdown()
            server.server_close()


def publisher_header(kind: Any, topic: str) -> bytes:
    """Return the header that a valid publisher sends."""
    return bytes(
        encode_ros_handshake_header(
            {"topic": topic, "type": kind._type, "md5sum": kind._md5sum, "callerid": "/evil", "latching": "0"}
        )
    )


def length(size: int) -> bytes:
    """Return a length in the format of TCPROS."""
    return struct.pack("<I", size)
