"""Limits of a node's two servers and of the data that it receives, in place of rospy's implementation.

A node listens on two TCP ports that rospy chooses, on all interfaces unless ROS_IP or ROS_HOSTNAME is a loopback
address: XML-RPC (the slave API, called by the master and by subscribers) and TCPROS (for subscribers and service
clients). It also connects to the publishers that the master lists, and receives their messages.

rospy reads openings in its accept loops, accepts every length, and ends the loops if descriptors run out. `install`
replaces the following, before `rospy.init_node`. This is the only place that modifies rospy itself:

* ``rosgraph.xmlrpc.ThreadingXMLRPCServer``: a `HandshakeServer` reads requests, and only complete ones are parsed.
* ``rospy.impl.tcpros_base.TCPServer``: a `HandshakeServer` reads headers. rospy handles topics, this module services.
* ``rospy.impl.tcpros_base.read_ros_handshake_header`` and ``TCPROSTransportProtocol.read_messages``: data from
  publishers is limited.
* ``rospy.impl.tcpros_pubsub.ServerProxy``: the answers of publishers to calls are limited too (see also `connector`).
"""

from __future__ import annotations

import functools
import io
import re
import socket
import struct
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any

import genmsg.msgs
import genpy.message
import numpy as np
import rosgraph.xmlrpc
import rospy
from rosgraph.network import decode_ros_handshake_header, write_ros_handshake_header
from rospy.exceptions import TransportTerminated
from rospy.impl import tcpros_base, tcpros_pubsub, tcpros_service
from rospy.impl.registration import get_service_manager
from rospy.msg import deserialize_messages

from rosafe.interface import MAX_SEQUENCE, MAX_STRING
from rosafe.ros1.transport import handshake_server, master
from rosafe.ros1.transport.buffer_list import BufferList
from rosafe.ros1.transport.handshake_server import HandshakeRejected, HandshakeServer, keep_alive
from rosafe.ros1.transport.log_throttle import ThrottledLog
from rosafe.ros1.transport.publisher import send_pieces

HEADER_BYTES = 65536  # a TCPROS header, which contains the definition of a message
HTTP_HEADER_BYTES = 16384
BODY_BYTES = 2**18  # an XML-RPC request; the longest one is a list of publishers
# Requests up to this length, and audio messages up to this much above their limit, are read even if they are invalid,
# so that the error can name the parameter.
ERROR_REPLY_MARGIN = 2**20
DATA_BYTES = 2**30  # a message without a closer limit, such as one that is plotted or recorded
LONG_BYTES, LONG_REQUESTS = 65536, 16  # at most 16 requests that are longer than 64 KiB are read at a time
REQUEST_SECONDS = 10.0  # from the first byte of a service request to the last
ANSWER_SECONDS = 60.0  # for a client to read an answer
KEEP_SECONDS = 60.0  # that an HTTP connection may be idle
CALLER_CHARACTERS = 1024  # in the name of a peer
LOG_SECONDS = 60.0  # in which one problem of one peer is logged once

_LENGTH = struct.Struct("<I")
_LONG = threading.BoundedSemaphore(LONG_REQUESTS)
_EVENTS = ThrottledLog(rospy.logwarn, LOG_SECONDS)


def install() -> None:
    """Replace rospy's servers by those of this module, and raise the limit of descriptors."""
    handshake_server.raise_limit()
    rosgraph.xmlrpc.ThreadingXMLRPCServer = XmlRpcServer
    tcpros_base.TCPServer = TcprosServer
    tcpros_base.read_ros_handshake_header = read_header
    tcpros_base.TCPROSTransportProtocol.read_messages = _read_messages
    tcpros_pubsub.ServerProxy = master.proxy


def _report(server: str, peer: str, problem: str, kind: str = "") -> None:
    """Log one line about a problem of a peer; further problems of the same kind are counted.

    `kind` is required if the peer can influence the text, because the peer could otherwise fill the log.
    """
    line = f"{server}: {peer}: {problem[:300]}" if peer else f"{server}: {problem}"
    _EVENTS(line, kind=f"{server} {peer} {kind or re.sub('[0-9]+', '#', problem)}")


# --- TCPROS: incoming connections -------------------------------------------------------------------------------


class TcprosServer(tcpros_base.TCPServer):
    """The port that subscribers and service clients connect to."""

    def run(self) -> None:
        """Serve until the socket is closed; that may be before this thread begins."""
        listener = self.server_sock
        try:
            server = HandshakeServer(listener, _header_size, _parse_header, functools.partial(_report, "TCPROS"))
        except OSError:
            if listener.fileno() >= 0:
                raise
        else:
            server.run()


def _header_size(data: bytes | bytearray) -> int | None:
    """Return the size of a header with its length prefix; None if it is incomplete."""
    if len(data) < _LENGTH.size:
        return None
    (size,) = _LENGTH.unpack_from(data)
    if size > HEADER_BYTES:
        raise HandshakeRejected(f"header: expected at most {HEADER_BYTES} bytes, got {size}; this is not ROS")
    total = _LENGTH.size + size
    return total if len(data) >= total else None


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
            _report("TCPROS", address[0], problem, "header")


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
        reader = _Requests(sock, rest, max(ERROR_REPLY_MARGIN, max_size(service.request_class)))
        try:
            while True:
                data = reader.next(persistent)
                if data is None:
                    return None
                _answer(sock, service, data, header)
                if not persistent:
                    return None
        except HandshakeRejected as refusal:
            _report(service.resolved_name, address[0], f"{refusal}; disconnected")
        return None


class _Requests:
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


# --- TCPROS: data from publishers -------------------------------------------------------------------------------


def read_header(sock: socket.socket, buffer: io.BytesIO, size: int) -> dict[str, str]:
    """Return the header of a publisher; the data after it remains in `buffer`. rospy's version accepts any length."""
    data = bytearray()
    try:
        while (end := _header_size(data)) is None:
            part = sock.recv(size)
            if not part:
                raise HandshakeRejected("the connection ended before the header was complete")
            data += part
    except HandshakeRejected as refusal:
        _report("TCPROS", sock.getpeername()[0], str(refusal))
        raise
    buffer.seek(0)  # after a lost connection it contains the rest of a message
    buffer.truncate()
    buffer.write(data[end:])
    return dict(decode_ros_handshake_header(bytes(data[:end])))


def _read_messages(self: Any, buffer: io.BytesIO, messages: list[Any], sock: socket.socket) -> None:
    """Read complete messages; TransportTerminated if the next one is too long. Replaces rospy's method.

    If no message may be dropped, and the class `accepts_buffers`, the rest of a message is received without rospy's
    buffer, from which it would be copied twice.
    """
    data_class = self.recv_data_class
    direct = self.queue_size is None and getattr(data_class, "accepts_buffers", False)
    if not direct:
        deserialize_messages(buffer, messages, data_class, queue_size=self.queue_size)
        if buffer.tell() < _LENGTH.size:
            return
    (size,) = _LENGTH.unpack_from(buffer.getbuffer())
    if buffer.tell() - _LENGTH.size >= size:
        deserialize_messages(buffer, messages, data_class)
        return
    limit = max_message_size(data_class)
    if size > limit:
        problem = f"message: expected at most {limit} bytes, got {size}; the publisher was disconnected"
        _report(self.resolved_name, sock.getpeername()[0], problem)
        raise TransportTerminated(problem)
    if direct:
        messages.append(data_class().deserialize(_read_rest(buffer, size, sock)))


def _read_rest(buffer: io.BytesIO, size: int, sock: socket.socket) -> memoryview:
    """Return the message of `size` bytes that begins in `buffer`, which is empty then."""
    data = np.empty(size, np.uint8).data
    at = buffer.tell() - _LENGTH.size
    data[:at] = buffer.getbuffer()[_LENGTH.size : _LENGTH.size + at]
    while at < size:
        try:
            received = sock.recv_into(data[at:], 0, socket.MSG_WAITALL)
        except OSError as problem:
            raise TransportTerminated(str(problem)) from None
        if not received:
            raise TransportTerminated("the publisher has disconnected")
        at += received
    buffer.seek(0)
    buffer.truncate()
    return data.toreadonly()


# --- lengths ----------------------------------------------------------------------------------------------------

_WIDTHS = {"time": 8, "duration": 8, "bool": 1, "byte": 1, "char": 1, "float32": 4, "float64": 8}
_WIDTHS.update({f"{u}int{bits}": bits // 8 for u in ("", "u") for bits in (8, 16, 32, 64)})


# Messages that consist of the texts and lists of a request, and messages without texts and lists.
_REQUESTS = re.compile(r"\w+/\w+Action(Goal|Result|Feedback)|actionlib_msgs/\w+|rosgraph_msgs/Clock")


def max_message_size(message_class: Any) -> int:
    """Return the bytes of the longest message of a topic that is accepted."""
    if hasattr(message_class, "longest_sequence"):
        return max_size(message_class) + ERROR_REPLY_MARGIN
    return max_size(message_class) if _REQUESTS.fullmatch(message_class._type) else DATA_BYTES


@functools.cache
def max_size(message_class: Any) -> int:
    """Return the bytes of the longest valid message or request.

    Strings have up to MAX_STRING characters, and sequences up to MAX_SEQUENCE elements or the `longest_sequence` of
    the class.
    """
    max_length = getattr(message_class, "longest_sequence", MAX_SEQUENCE)
    return sum(_max_field_size(kind, max_length) for kind in message_class._slot_types)


def _max_field_size(kind: str, max_length: int) -> int:
    element, is_array, count = genmsg.msgs.parse_type(kind)
    if is_array:
        size = _max_field_size(element, max_length)
        return _LENGTH.size + max_length * size if count is None else count * size
    if kind == "string":
        return _LENGTH.size + 4 * MAX_STRING
    if kind in _WIDTHS:
        return _WIDTHS[kind]
    return sum(_max_field_size(inner, max_length) for inner in genpy.message.get_message_class(kind)._slot_types)


# --- XML-RPC ----------------------------------------------------------------------------------------------------

_BLANK_LINE = re.compile(rb"\r?\n\r?\n")
_CONTENT_LENGTH = re.compile(rb"^content-length[ \t]*:[ \t]*([0-9]+)[ \t]*\r?$", re.IGNORECASE | re.MULTILINE)


class XmlRpcServer(rosgraph.xmlrpc.ThreadingXMLRPCServer):
    """The port that the master and subscribers call."""

    def serve_forever(self, poll_interval: float = 0.5) -> None:
        """Serve until the socket is closed."""
        report = functools.partial(_report, "XML-RPC")
        self._handshake_server = HandshakeServer(self.socket, _request_size, self._enter, report)
        self._handshake_server.run()

    def register_multicall_functions(self) -> None:
        """Register none: nodes do not need them, and a short request could produce an answer of gigabytes."""

    def _enter(self, sock: socket.socket, address: Any, opening: bytes, rest: bytes) -> None:
        """Answer one request, and wait for the next one if the client keeps the connection."""
        try:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            handler = _Request(sock, address, self, opening)
            sock.settimeout(REQUEST_SECONDS)
            sock.sendall(handler.wfile.getvalue())
        except Exception as problem:
            if not isinstance(problem, OSError):  # an OSError: the client has disconnected, or does not read
                _report("XML-RPC", address[0], f"{type(problem).__name__}: {problem}", "request")
            sock.close()
        else:
            if handler.close_connection:
                self.shutdown_request(sock)
            else:
                self._handshake_server.adopt_idle(sock, address, rest, KEEP_SECONDS)


class _Request(rosgraph.xmlrpc.SilenceableXMLRPCRequestHandler):
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
