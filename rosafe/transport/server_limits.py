"""What listens in a node, and how much it takes: rospy's two servers on doors, and a bound on every incoming length.

A node listens on two TCP ports of rospy's choice, on all interfaces unless ROS_IP or ROS_HOSTNAME is a loopback
address: XML-RPC (the slave API: who asks for topics, the master) and TCPROS (subscribers and service clients). It also
connects to the publishers that the master names, and reads what they send.

rospy reads openings in its accept loops, believes every length, and ends the loops where descriptors run out. `install`
puts these in place of it, before `rospy.init_node`; this is the only place where rospy itself is changed:

* ``rosgraph.xmlrpc.ThreadingXMLRPCServer``: a `HandshakeServer` reads requests; only complete ones are parsed.
* ``rospy.impl.tcpros_base.TCPServer``: a `HandshakeServer` reads headers; rospy gets topics, services are served here.
* ``rospy.impl.tcpros_base.read_ros_handshake_header`` and ``TCPROSTransportProtocol.read_messages``: what publishers
  send to our subscribers is bounded.
* ``rospy.impl.tcpros_pubsub.ServerProxy``: their answers to calls are bounded too (see also `connector`).
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
import rosgraph.xmlrpc
import rospy
from rosgraph.network import decode_ros_handshake_header, write_ros_handshake_header
from rospy.exceptions import TransportTerminated
from rospy.impl import tcpros_base, tcpros_pubsub, tcpros_service
from rospy.impl.registration import get_service_manager
from rospy.msg import deserialize_messages

from rosafe.interface import MAX_SEQUENCE, MAX_STRING
from rosafe.transport import handshake_server, master
from rosafe.transport.buffer_list import BufferList
from rosafe.transport.handshake_server import HandshakeRejected, HandshakeServer
from rosafe.transport.log_throttle import ThrottledLog
from rosafe.transport.publisher import send_pieces

HEADER_BYTES = 65536  # of a TCPROS header; it holds the definition of a message
HTTP_HEADER_BYTES = 16384
BODY_BYTES = 2**18  # of an XML-RPC request; the longest is a list of publishers
ERROR_REPLY_MARGIN = 2**20  # of a service request, or of sound beyond its bound: a slip gets its error by name
DATA_BYTES = 2**30  # of a message that no rule bounds more closely, such as what is plotted or recorded
LONG_BYTES, LONG_REQUESTS = 65536, 16  # of requests longer than this so many are read at a time
REQUEST_SECONDS = 10.0  # from the first byte of a service request to the last
ANSWER_SECONDS = 60.0  # for a client to take an answer
KEEP_SECONDS = 60.0  # that an HTTP connection may be idle
CALLER_CHARACTERS = 1024  # in the name that a peer gives itself
LOG_SECONDS = 60.0  # in which the log has one line about one fault of one peer

_LENGTH = struct.Struct("<I")
_LONG = threading.BoundedSemaphore(LONG_REQUESTS)
_EVENTS = ThrottledLog(rospy.logwarn, LOG_SECONDS)


def install() -> None:
    """Put the servers and bounds of this file in place of rospy's, and raise the limit of descriptors."""
    handshake_server.raise_limit()
    rosgraph.xmlrpc.ThreadingXMLRPCServer = XmlRpcServer
    tcpros_base.TCPServer = TcprosServer
    tcpros_base.read_ros_handshake_header = read_header
    tcpros_base.TCPROSTransportProtocol.read_messages = _read_messages
    tcpros_pubsub.ServerProxy = master.proxy


def _report(server: str, peer: str, what: str, kind: str = "") -> None:
    """One line about one kind of fault of one peer; others of the kind are counted.

    The kind is to be named where the peer has a say in the text, else it could fill the log.
    """
    line = f"{server}: {peer}: {what[:300]}" if peer else f"{server}: {what}"
    _EVENTS(line, kind=f"{server} {peer} {kind or re.sub('[0-9]+', '#', what)}")


# --- TCPROS: whoever connects -----------------------------------------------------------------------------------


class TcprosServer(tcpros_base.TCPServer):
    """The port that subscribers and service clients connect to."""

    def run(self) -> None:
        """Serve until the socket is closed."""
        HandshakeServer(self.server_sock, _header_size, _parse_header, functools.partial(_report, "TCPROS")).run()


def _header_size(data: bytes | bytearray) -> int | None:
    """The bytes of a header with its length; None where more must come."""
    if len(data) < _LENGTH.size:
        return None
    (size,) = _LENGTH.unpack_from(data)
    if size > HEADER_BYTES:
        raise HandshakeRejected(f"a header of {size} bytes, which is not ROS")
    whole = _LENGTH.size + size
    return whole if len(data) >= whole else None


def _parse_header(sock: socket.socket, address: Any, opening: bytes, rest: bytes) -> None:
    """Give a connection to the topic or the service that its header names."""
    try:
        _keep_alive(sock)
        sock.settimeout(ANSWER_SECONDS)
        header = decode_ros_handshake_header(opening)
        problem = _route_connection(sock, address, header, rest)
        if problem:
            write_ros_handshake_header(sock, {"error": problem})
    except OSError:
        sock.close()  # it has left
        return
    except Exception as fault:  # rospy's of many kinds, and its handlers fail where a topic is closed meanwhile
        problem = f"{type(fault).__name__}: {fault}"
    if problem:
        sock.close()
        if not rospy.core.is_shutdown_requested():
            _report("TCPROS", address[0], problem, "header")


def _route_connection(sock: socket.socket, address: Any, header: Mapping[str, str], rest: bytes) -> str | None:
    """What is wrong with the header; nothing where the connection is taken (or was served and closed)."""
    if rospy.core.is_shutdown_requested():
        return "node shutting down"
    caller = header.get("callerid", "")
    if not caller.isprintable() or len(caller) > CALLER_CHARACTERS:
        return "callerid is no name"  # it would be shown by rosnode info
    if "topic" in header:
        return tcpros_base._tcpros_server.topic_connection_handler(sock, address, header)
    if "service" in header:
        return _serve(sock, address, header, rest)
    return "no topic or service name detected"


def _keep_alive(sock: socket.socket) -> None:
    """Notice within two minutes that the other host is gone without a word."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in ((socket.TCP_KEEPIDLE, 60), (socket.TCP_KEEPINTVL, 10), (socket.TCP_KEEPCNT, 6)):
        sock.setsockopt(socket.IPPROTO_TCP, option, value)


# --- TCPROS: services -------------------------------------------------------------------------------------------


def _serve(sock: socket.socket, address: Any, header: Mapping[str, str], rest: bytes) -> str | None:
    """Serve a service client, to the end of its connection; what is wrong with its header where it is refused."""
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
        reader = _Requests(sock, rest, max(ERROR_REPLY_MARGIN, largest(service.request_class)))
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
    """Reads the requests of one client, each of bounded length and, once begun, within bounded time."""

    def __init__(self, sock: socket.socket, rest: bytes, limit: int) -> None:
        self._sock = sock
        self._rest = rest
        self._limit = limit

    def next(self, persistent: bool) -> bytes | None:
        """The bytes of the next request; None where the client has left. A `persistent` one may take its time."""
        if not self._rest and persistent:
            self._sock.settimeout(None)
            self._rest = self._sock.recv(_LENGTH.size)
        until = time.monotonic() + REQUEST_SECONDS
        prefix = self._take(_LENGTH.size, until)
        if prefix is None:
            return None
        (size,) = _LENGTH.unpack(prefix)
        if size > self._limit:
            raise HandshakeRejected(f"a request of {size} bytes, at most {self._limit} make sense")
        if size <= LONG_BYTES:
            return self._take(size, until)
        if not _LONG.acquire(timeout=REQUEST_SECONDS):
            raise HandshakeRejected("too many long requests at a time")
        try:
            return self._take(size, until)
        finally:
            _LONG.release()

    def _take(self, size: int, until: float) -> bytes | None:
        data = bytearray(self._rest[:size])
        self._rest = self._rest[size:]
        while len(data) < size:
            left = until - time.monotonic()
            try:
                self._sock.settimeout(max(left, 1e-3))
                part = self._sock.recv(size - len(data))
            except TimeoutError:
                raise HandshakeRejected(f"no whole request within {REQUEST_SECONDS:g} s") from None
            if not part:
                return None
            data += part
        return bytes(data)


def _answer(sock: socket.socket, service: Any, data: bytes, header: Mapping[str, str]) -> None:
    """Serve one request, as rospy would, but without a copy of what the response holds."""
    written = BufferList()
    try:
        try:
            request = service.request_class().deserialize(data)
        except Exception as problem:  # genpy's of several kinds
            raise rospy.ServiceException(f"it cannot be read: {problem}") from None
        request._connection_header = header
        response = tcpros_service.convert_return_to_response(service.handler(request), service.response_class)
        response.serialize(written)
        prefix = b"\1"
    except Exception as problem:  # the client is told, whatever it is, and the node goes on
        if isinstance(problem, rospy.ServiceException):
            text = f"service cannot process request: {problem}"
        else:
            text = f"error processing request: {problem}"
            service.error_handler(problem, *sys.exc_info())
        prefix, written = b"\0", BufferList()
        written.write(text.encode("utf-8", "replace"))
    sock.settimeout(ANSWER_SECONDS)
    send_pieces(sock, [prefix + _LENGTH.pack(written.size), *written.pieces])


# --- TCPROS: what publishers send -------------------------------------------------------------------------------


def read_header(sock: socket.socket, buffer: io.BytesIO, size: int) -> dict[str, str]:
    """The header that a publisher answers with, in place of rospy's, which believes any length; the rest stays."""
    data = bytearray()
    try:
        while (end := _header_size(data)) is None:
            part = sock.recv(size)
            if not part:
                raise HandshakeRejected("the connection ended before there was a header")
            data += part
    except HandshakeRejected as refusal:
        _report("TCPROS", sock.getpeername()[0], str(refusal))
        raise
    buffer.seek(0)  # after a connection that was lost it holds the rest of a message
    buffer.truncate()
    buffer.write(data[end:])
    return dict(decode_ros_handshake_header(bytes(data[:end])))


def _read_messages(self: Any, buffer: io.BytesIO, messages: list[Any], sock: socket.socket) -> None:
    """Read what has come whole, in place of rospy's; TransportTerminated where what follows is too long."""
    deserialize_messages(buffer, messages, self.recv_data_class, queue_size=self.queue_size)
    at = buffer.tell()
    if at < _LENGTH.size:
        return
    buffer.seek(0)
    (size,) = _LENGTH.unpack(buffer.read(_LENGTH.size))
    buffer.seek(at)
    limit = bound(self.recv_data_class)
    if size > limit:
        what = f"a message of {size} bytes, at most {limit} make sense; its publisher was disconnected"
        _report(self.resolved_name, sock.getpeername()[0], what)
        raise TransportTerminated(what)


# --- lengths ----------------------------------------------------------------------------------------------------

_WIDTHS = {"time": 8, "duration": 8, "bool": 1, "byte": 1, "char": 1}
_WIDTHS.update({f"{u}int{bits}": bits // 8 for u in ("", "u") for bits in (8, 16, 32, 64)})
_WIDTHS.update(float32=4, float64=8)


# What is made of a request's texts and lists, and what has neither.
_REQUESTS = re.compile(r"\w+/\w+Action(Goal|Result|Feedback)|actionlib_msgs/\w+|rosgraph_msgs/Clock")


def bound(message_class: Any) -> int:
    """The bytes of the longest message of a topic that is taken."""
    if hasattr(message_class, "longest_sequence"):
        return largest(message_class) + ERROR_REPLY_MARGIN
    return largest(message_class) if _REQUESTS.fullmatch(message_class._type) else DATA_BYTES


@functools.cache
def largest(message_class: Any) -> int:
    """The bytes of the longest message or request that makes sense.

    Texts have up to MAX_STRING characters, and sequences up to MAX_SEQUENCE elements or as many as the class'
    `longest_sequence` says.
    """
    longest = getattr(message_class, "longest_sequence", MAX_SEQUENCE)
    return sum(_largest(kind, longest) for kind in message_class._slot_types)


def _largest(kind: str, longest: int) -> int:
    element, is_array, count = genmsg.msgs.parse_type(kind)
    if is_array:
        size = _largest(element, longest)
        return _LENGTH.size + longest * size if count is None else count * size
    if kind == "string":
        return _LENGTH.size + 4 * MAX_STRING
    if kind in _WIDTHS:
        return _WIDTHS[kind]
    return sum(_largest(inner, longest) for inner in genpy.message.get_message_class(kind)._slot_types)


# --- XML-RPC ----------------------------------------------------------------------------------------------------

_BLANK_LINE = re.compile(rb"\r?\n\r?\n")
_CONTENT_LENGTH = re.compile(rb"^content-length[ \t]*:[ \t]*([0-9]+)[ \t]*\r?$", re.IGNORECASE | re.MULTILINE)


class XmlRpcServer(rosgraph.xmlrpc.ThreadingXMLRPCServer):
    """The port that the master and whoever wants a topic call."""

    def serve_forever(self, poll_interval: float = 0.5) -> None:
        """Serve until the socket is closed."""
        self._door = HandshakeServer(self.socket, _request_size, self._enter, functools.partial(_report, "XML-RPC"))
        self._door.run()

    def register_multicall_functions(self) -> None:
        """Have none: nobody uses them with nodes, and a short request could ask for gigabytes."""

    def _enter(self, sock: socket.socket, address: Any, opening: bytes, rest: bytes) -> None:
        """Answer one request, and wait for the next one if the client likes."""
        try:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            handler = _Request(sock, address, self, opening)
            sock.settimeout(REQUEST_SECONDS)
            sock.sendall(handler.wfile.getvalue())
        except Exception as problem:
            if not isinstance(problem, OSError):  # else it has left, or does not read
                _report("XML-RPC", address[0], f"{type(problem).__name__}: {problem}", "request")
            sock.close()
        else:
            if handler.close_connection:
                self.shutdown_request(sock)
            else:
                self._door.adopt_idle(sock, address, rest, KEEP_SECONDS)


class _Request(rosgraph.xmlrpc.SilenceableXMLRPCRequestHandler):
    """One request that has been read already."""

    def __init__(self, sock: socket.socket, address: Any, server: XmlRpcServer, opening: bytes) -> None:
        self._opening = opening
        super().__init__(sock, address, server)

    def setup(self) -> None:
        """Read from what is here, and keep the answer."""
        self.rfile: Any = io.BytesIO(self._opening)
        self.wfile: Any = io.BytesIO()

    def handle(self) -> None:
        """Only this one: the next may be long in coming."""
        self.close_connection = True
        self.handle_one_request()

    def finish(self) -> None:
        """Leave the answer to be sent."""

    def decode_request_content(self, data: bytes) -> bytes | None:
        """As it is: packed, a short request may be long."""
        if self.headers.get("content-encoding", "identity").lower() == "identity":
            return data
        self.send_response(501, "content encodings are not supported")
        self.send_header("Content-length", "0")
        self.end_headers()
        return None


def _request_size(data: bytes | bytearray) -> int | None:
    """The bytes of an HTTP request; None where more must come."""
    end = _BLANK_LINE.search(data, 0, HTTP_HEADER_BYTES)
    if end is None:
        if len(data) > HTTP_HEADER_BYTES:
            raise HandshakeRejected(
                "an HTTP request whose headers have no end", _http_error("431 Header Fields Too Large")
            )
        return None
    lengths = [int(text[:20]) for text in _CONTENT_LENGTH.findall(data, 0, end.end())]
    if lengths and max(lengths) > BODY_BYTES:
        raise HandshakeRejected(f"an HTTP request of {max(lengths)} bytes", _http_error("413 Content Too Large"))
    size = end.end() + (lengths[0] if lengths else 0)
    return size if len(data) >= size else None


def _http_error(status: str) -> bytes:
    return f"HTTP/1.1 {status}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n".encode()
