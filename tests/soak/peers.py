"""Misbehaving peers of the nodes: connections that send nothing, or announce wrong lengths."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any
from urllib.parse import urlsplit
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCServer

import rosgraph
from rosgraph.network import decode_ros_handshake_header, encode_ros_handshake_header

from tests.harness import PATIENCE, Graph

Address = tuple[str, int]
MAX_LENGTH = b"\xff\xff\xff\xff"  # the length word of a message of 4 GiB


def node_addresses(graph: Graph, node: str) -> dict[str, Address]:
    """Return the addresses of a node's TCPROS and XML-RPC ports."""
    master = rosgraph.Master("/peer", master_uri=graph.uri)
    found = {"TCPROS": master.lookupService(f"/{node}/kill"), "XML-RPC": master.lookupNode(f"/{node}")}
    return {name: _address(uri) for name, uri in found.items()}


def _address(uri: str) -> Address:
    parts = urlsplit(uri)
    assert parts.hostname and parts.port, uri
    return parts.hostname, parts.port


def connect(address: Address, text: bytes = b"") -> socket.socket:
    """Return a connection on which `text` was sent. The peer may have closed it already."""
    connection = socket.create_connection(address, timeout=PATIENCE)
    with suppress(ConnectionError):
        connection.sendall(text)
    return connection


@contextmanager
def crowd(address: Address, count: int, text: bytes = b"") -> Iterator[list[socket.socket]]:
    """Open up to `count` connections and send `text` on each of them. Fewer are opened if the peer rejects them."""
    with ExitStack() as stack:
        connections = []
        for _ in range(count):
            try:
                connections.append(stack.enter_context(connect(address, text)))
            except OSError:  # rejected
                break
        yield connections


def closed(connection: socket.socket) -> bool:
    """Return whether the peer has closed the connection. Received data is discarded."""
    connection.setblocking(False)
    try:
        while connection.recv(2**20):
            continue
    except BlockingIOError:
        return False
    except ConnectionError:
        return True
    return True


def flood(connection: socket.socket, limit: int, text: bytes = bytes(2**20)) -> int:
    """Send `text` repeatedly until the peer closes or stops reading, up to `limit` bytes. Return the sent bytes."""
    connection.settimeout(2.0)
    sent = 0
    with suppress(OSError):
        while sent < limit:
            sent += connection.send(text)
    return sent


# --- TCPROS -----------------------------------------------------------------------------------------------------


def call_header(service: str) -> bytes:
    """Return the connection header of a client of a service."""
    fields = {"service": service, "md5sum": "*", "callerid": "/peer", "persistent": "1"}
    return bytes(encode_ros_handshake_header(fields))


@contextmanager
def deaf_subscriber(graph: Graph, node: str, topic: str, message_class: Any) -> Iterator[socket.socket]:
    """A subscriber that connects and then reads nothing."""
    api = ServerProxy(rosgraph.Master("/peer", master_uri=graph.uri).lookupNode(f"/{node}"))
    answer: Any = api.requestTopic("/peer", topic, [["TCPROS"]])
    _, host, port = answer[2]
    fields = {
        "topic": topic,
        "md5sum": message_class._md5sum,
        "type": message_class._type,
        "callerid": "/peer",
    }
    with connect((host, port), bytes(encode_ros_handshake_header(fields))) as connection:
        yield connection


class LyingPublisher:
    """A publisher that announces a message of 4 GiB and sends data until the peer stops reading."""

    def __init__(self, topic: str, message_class: Any, limit: int) -> None:
        self.sent = 0  # bytes, on all connections
        self.closed = threading.Event()  # by the peer
        self._topic, self._class, self._limit = topic, message_class, limit
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._api = SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False, allow_none=True)
        self._api.register_function(self._request_topic, "requestTopic")
        self._api.register_function(lambda *_: [1, "", 0], "publisherUpdate")
        self.uri = f"http://127.0.0.1:{self._api.server_address[1]}/"
        threading.Thread(target=self._api.serve_forever, daemon=True).start()
        threading.Thread(target=self._serve, daemon=True).start()

    def _request_topic(self, *_: Any) -> list[Any]:
        return [1, "", ["TCPROS", "127.0.0.1", self._listener.getsockname()[1]]]

    def _serve(self) -> None:
        with suppress(OSError):  # the listener was closed
            while True:
                connection, _ = self._listener.accept()
                with connection, suppress(OSError):
                    self._lie(connection)

    def _lie(self, connection: socket.socket) -> None:
        connection.settimeout(PATIENCE)
        stream = connection.makefile("rb")
        header = stream.read(int.from_bytes(stream.read(4), "little"))
        subscribed = decode_ros_handshake_header(len(header).to_bytes(4, "little") + header)
        assert subscribed["topic"] == self._topic
        fields = {
            "topic": self._topic,
            "md5sum": self._class._md5sum,
            "type": self._class._type,
            "callerid": "/peer",
            "message_definition": "",
        }
        connection.sendall(bytes(encode_ros_handshake_header(fields)) + MAX_LENGTH)
        sent = flood(connection, self._limit)
        self.sent += sent
        if sent < self._limit:
            self.closed.set()

    def close(self) -> None:
        self._api.shutdown()
        self._api.server_close()
        self._listener.close()

    @contextmanager
    def registered(self, graph: Graph) -> Iterator[None]:
        """Register it at the master, which notifies the subscribers."""
        master = rosgraph.Master("/peer", master_uri=graph.uri)
        master.registerPublisher(self._topic, self._class._type, self.uri)
        try:
            yield
        finally:
            master.unregisterPublisher(self._topic, self.uri)
            self.close()
