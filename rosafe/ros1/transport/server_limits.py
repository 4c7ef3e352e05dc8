"""Limits of a node's two servers, in place of rospy's implementation.

A node listens on two TCP ports that rospy chooses, on all interfaces unless ROS_IP or ROS_HOSTNAME is a loopback
address: XML-RPC (the slave API, called by the master and by subscribers) and TCPROS (for subscribers and service
clients).

rospy reads openings in its accept loops, accepts every length, and ends the loops if descriptors run out. `install`
replaces the following, before `rospy.init_node`:

* ``rosgraph.xmlrpc.ThreadingXMLRPCServer``: a `HandshakeServer` reads requests, and only complete ones are parsed.
* ``rospy.impl.tcpros_base.TCPServer``: a `HandshakeServer` reads headers. rospy handles topics, this module services.
* ``rospy.topics.Poller``: descriptors of topics that have ended are closed at once, by `TopicPoller`.
* the functions that `received_data` replaces: they read the data of publishers.
"""

from __future__ import annotations

import functools
import io
import re
import select
import socket
import struct
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any

import rosgraph.xmlrpc
import rospy
import rospy.topics
from rosgraph.network import decode_ros_handshake_header, write_ros_handshake_header
from rospy.impl import tcpros_base, tcpros_service
from rospy.impl.registration import get_service_manager

from rosafe.ros1.transport import handshake_server, received_data
from rosafe.ros1.transport.handshake_server import HandshakeRejected, HandshakeServer, keep_alive
from rosafe.ros1.transport.publisher import BufferList, send_pieces
from rosafe.ros1.transport.received_data import ERROR_REPLY_MARGIN, header_size, max_size, report

HTTP_HEADER_BYTES = 16384
BODY_BYTES = 2**18  # an XML-RPC request; the longest one is a list of publishers
LONG_BYTES, LONG_REQUESTS = 65536, 16  # at most 16 requests that are longer than 64 KiB are read at a time
REQUEST_SECONDS = 10.0  # from the first byte of a service request to the last
ANSWER_SECONDS = 60.0  # for a client to read an answer
KEEP_SECONDS = 60.0  # that an HTTP connection may be idle
CALLER_CHARACTERS = 1024  # in the name of a peer

_LENGTH = struct.Struct("<I")
_LONG = threading.BoundedSemaphore(LONG_REQUESTS)


def install() -> None:
    """Replace rospy's servers and poller by those of this module, and raise the limit of descriptors."""
    handshake_server.raise_limit()
    rosgraph.xmlrpc.ThreadingXMLRPCServer = XmlRpcServer
    tcpros_base.TCPServer = TcprosServer
    rospy.topics.Poller = TopicPoller
    received_data.install()


class TopicPoller(rospy.topics.Poller):
    """Detects connections of a topic that have ended. Its descriptor is closed with the topic.

    rospy's poller holds its own methods, so that descriptors of closed topics and of ended subscriptions remain open
    until garbage collection.
    """

    def __init__(self) -> None:
        self.poller = select.epoll()

    add_fd = rospy.topics.Poller.add_epoll
    remove_fd = rospy.topics.Poller.remove_epoll
    error_iter = rospy.topics.Poller.error_epoll_iter


# --- TCPROS: incoming connections -------------------------------------------------------------------------------


class TcprosServer(tcpros_base.TCPServer):
    """The port that subscribers and service clients connect to."""

    def run(self) -> None:
        """Serve until the socket is closed; that may be before this thread begins."""
        listener = self.server_sock
        try:
            server = HandshakeServer(listener, header_size, _parse_header, functools.partial(report, "TCPROS"))
        except OSError:
            if listener.fileno() >= 0:
                raise
        else:
            server.run()


def _parse_header(sock: socket.socket, address: Any, opening: bytes, rest: bytes) -> None:
    """Hand a connection to the topic or service that its header names."""
    try:
        keep_alive(sock, idle=60, interval=10, count=6)
        sock.settimeout(ANSWER_SECONDS)
        header = decode_ros_handshake_header(opening)
        problem = _route_connection(sock, address, header, rest)
        if problem:
            write_ros_handshake_header(sock, {"error": problem})
    except OSError:
        sock.close()  # the client has disconnected
        return
    except Exception as error:  # rospy raises many kinds, also if a topic is closed meanwhile
        problem = f"{type(error).__name__}: {error}"
    if problem:
        sock.close()
        if not rospy.core.is_shutdown_requested():
            report("TCPROS", address[0], problem, "header")


def _route_connection(sock: socket.socket, address: Any, header: Mapping[str, str], rest: bytes) -> str | None:
    """Return the problem of the header; None if the connection is accepted (or was served and closed)."""
    if rospy.core.is_shutdown_requested():
        return "node shutting down"
    caller = header.get("callerid", "")
    if not caller.isprintable() or len(caller) > CALLER_CHARACTERS:
        return "callerid: expected a name"  # rosnode info would print it
    if "topic" in header:
        return tcpros_base._tcpros_server.topic_connection_handler(sock, address, header)
    if "service" in header:
        return _serve(sock, address, header, rest)
    return "no topic or service name detected"


# --- TCPROS: services -------------------------------------------------------------------------------------------


def _serve(sock: socket.socket, address: Any, header: Mapping[str, str], rest: bytes) -> str | None:
    """Serve a service client until its connection ends; return the problem of its header if it is rejected."""
    missing = {"service", "md5sum", "callerid"} - header.keys()
    if missing:
        return f"Missing required '{min(missing)}' field"
    service = get_service_manager().get_service(header["service"])
    if service is None:
        return f"[{rospy.get_name()}] is not a provider of [{header['service'][:200]}]"
    if header["md5sum"] not in (rospy.names.SERVICE_ANYTYPE, service.service_class._md5sum):
        return (
            f"request from [{header['callerid']}]: md5sums do not match: [{header['md5sum'][:200]}] vs. "
            f"[{service.service_class._md5sum}]"
        )
    with sock:
        write_ros_handshake_header(sock, service.protocol.get_header_fields())
        if header.get("probe") == "1":
            return None
        persistent = header.get("persistent", "").lower() in ("1", "true")
        reader = _RequestReader(sock, rest, max(ERROR_REPLY_MARGIN, max_size(service.request_class)))
        try:
            while True:
                data = reader.next(persistent)
                if data is None:
                    return None
                _answer(sock, service, data, header)
                if not persistent:
                    return None
        except HandshakeRejected as refusal:
            report(service.resolved_name, address[0], f"{refusal}; disconnected")
        return None


class _RequestReader:
    """Reads the requests of one client, each limited in length and, from its first byte, in time."""

    def __init__(self, sock: socket.socket, rest: bytes, limit: int) -> None:
        self._sock = sock
        self._rest = rest
        self._limit = limit

    def next(self, persistent: bool) -> bytes | None:
        """Return the next request; None if the client has disconnected. A `persistent` client may pause before it."""
        if not self._rest and persistent:
            self._sock.settimeout(None)
            self._rest = self._sock.recv(_LENGTH.size)
        until = time.monotonic() + REQUEST_SECONDS
        prefix = self._read(_LENGTH.size, until)
        if prefix is None:
            return None
        (size,) = _LENGTH.unpack(prefix)
        if size > self._limit:
            raise HandshakeRejected(f"request: expected at most {self._limit} bytes, got {size}")
        if size <= LONG_BYTES:
            return self._read(size, until)
        if not _LONG.acquire(timeout=REQUEST_SECONDS):
            raise HandshakeRejected("too many long requests at a time")
        try:
            return self._read(size, until)
        finally:
            _LONG.release()

    def _read(self, size: int, until: float) -> bytes | None:
        data = bytearray(self._rest[:size])
        self._rest = self._rest[size:]
        while len(data) < size:
            try:
                self._sock.settimeout(max(until - time.monotonic(), 1e-3))
                part = self._sock.recv(size - len(data))
            except TimeoutError:
                raise HandshakeRejected(f"no complete request within {REQUEST_SECONDS:g} s") from None
            if not part:
                return None
            data += part
        return bytes(data)


def _answer(sock: socket.socket, service: Any, data: bytes, header: Mapping[str, str]) -> None:
    """Serve one request like rospy, but without copying the arrays of the response."""
    written = BufferList()
    try:
        try:
            request = service.request_class().deserialize(data)
        except Exception as problem:  # genpy raises several kinds
            raise rospy.ServiceException(f"it cannot be decoded: {problem}") from None
        request._connection_header = header
        response = tcpros_service.convert_return_to_response(service.handler(request), service.response_class)
        response.serialize(written)
        prefix = b"\1"
    except Exception as problem:  # any failure is reported to the client, and the node continues
        if isinstance(problem, rospy.ServiceException):
            text = f"service cannot process request: {problem}"
        else:
            text = f"error processing request: {problem}"
            service.error_handler(problem, *sys.exc_info())
        prefix, written = b"\0", BufferList()
        written.write(text.encode("utf-8", "replace"))
    sock.settimeout(ANSWER_SECONDS)
    send_pieces(sock, [prefix + _LENGTH.pack(written.size), *written.pieces])


# --- XML-RPC ----------------------------------------------------------------------------------------------------

_BLANK_LINE = re.compile(rb"\r?\n\r?\n")
_CONTENT_LENGTH = re.compile(rb"^content-length[ \t]*:[ \t]*([0-9]+)[ \t]*\r?$", re.IGNORECASE | re.MULTILINE)


class XmlRpcServer(rosgraph.xmlrpc.ThreadingXMLRPCServer):
    """The port that the master and subscribers call."""

    def serve_forever(self, poll_interval: float = 0.5) -> None:
        """Serve until the socket is closed."""
        problems = functools.partial(report, "XML-RPC")
        self._handshake_server = HandshakeServer(self.socket, _request_size, self._enter, problems)
        self._handshake_server.run()

    def register_multicall_functions(self) -> None:
        """Register none: nodes do not need them, and a short request could produce an answer of gigabytes."""

    def _enter(self, sock: socket.socket, address: Any, opening: bytes, rest: bytes) -> None:
        """Answer one request, and wait for the next one if the client keeps the connection."""
        try:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            handler = _HttpRequest(sock, address, self, opening)
            sock.settimeout(REQUEST_SECONDS)
            sock.sendall(handler.wfile.getvalue())
        except Exception as problem:
            if not isinstance(problem, OSError):  # an OSError: the client has disconnected, or does not read
                report("XML-RPC", address[0], f"{type(problem).__name__}: {problem}", "request")
            sock.close()
        else:
            if handler.close_connection:
                self.shutdown_request(sock)
            else:
                self._handshake_server.adopt_idle(sock, address, rest, KEEP_SECONDS)


class _HttpRequest(rosgraph.xmlrpc.SilenceableXMLRPCRequestHandler):
    """One request that has been received completely."""

    def __init__(self, sock: socket.socket, address: Any, server: XmlRpcServer, opening: bytes) -> None:
        self._opening = opening
        super().__init__(sock, address, server)

    def setup(self) -> None:
        """Read from the received bytes, and collect the answer."""
        self.rfile: Any = io.BytesIO(self._opening)
        self.wfile: Any = io.BytesIO()

    def handle(self) -> None:
        """Handle only this request: the next one may arrive much later."""
        self.close_connection = True
        self.handle_one_request()

    def finish(self) -> None:
        """Do nothing: `XmlRpcServer` sends the answer."""

    def decode_request_content(self, data: bytes) -> bytes | None:
        """Reject compressed content, because a short compressed request may expand to a long one."""
        if self.headers.get("content-encoding", "identity").lower() == "identity":
            return data
        self.send_response(501, "content encodings are not supported")
        self.send_header("Content-length", "0")
        self.end_headers()
        return None


def _request_size(data: bytes | bytearray) -> int | None:
    """Return the size of an HTTP request; None if it is incomplete."""
    end = _BLANK_LINE.search(data, 0, HTTP_HEADER_BYTES)
    if end is None:
        if len(data) > HTTP_HEADER_BYTES:
            problem = f"HTTP headers: expected at most {HTTP_HEADER_BYTES} bytes"
            raise HandshakeRejected(problem, _http_error("431 Header Fields Too Large"))
        return None
    lengths = [int(text[:20]) for text in _CONTENT_LENGTH.findall(data, 0, end.end())]
    if lengths and max(lengths) > BODY_BYTES:
        problem = f"HTTP request: expected at most {BODY_BYTES} bytes, got {max(lengths)}"
        raise HandshakeRejected(problem, _http_error("413 Content Too Large"))
    size = end.end() + (lengths[0] if lengths else 0)
    return size if len(data) >= size else None


def _http_error(status: str) -> bytes:
    return f"HTTP/1.1 {status}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n".encode()
