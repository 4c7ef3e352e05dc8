"""Limits of the data that a node receives: headers, and messages of the publishers that the master lists.

rospy accepts every length. `install` replaces its functions that read headers and messages, and limits the answers of
publishers to calls, in time and length.
"""

from __future__ import annotations

import functools
import io
import re
import socket
import struct
from typing import Any

import genmsg.msgs
import genpy.message
import numpy as np
import rospy
from rosgraph.network import decode_ros_handshake_header
from rospy.exceptions import TransportTerminated
from rospy.impl import masterslave, tcpros_base, tcpros_pubsub
from rospy.msg import deserialize_messages

from rosafe.interface import MAX_SEQUENCE, MAX_STRING
from rosafe.ros1.transport import master
from rosafe.ros1.transport.handshake_server import HandshakeRejected
from rosafe.system.log_throttle import ThrottledLog

HEADER_BYTES = 65536  # a TCPROS header, which contains the definition of a message
# Requests up to this length, and audio messages up to this much above their limit, are read even if they are invalid,
# so that the error can name the parameter.
ERROR_REPLY_MARGIN = 2**20
DATA_BYTES = 2**30  # a message without a closer limit, such as one that is plotted or recorded
LOG_SECONDS = 60.0  # in which one problem of one peer is logged once

_LENGTH = struct.Struct("<I")
_EVENTS = ThrottledLog(rospy.logwarn, LOG_SECONDS)


def install() -> None:
    """Replace rospy's functions by those of this module."""
    tcpros_base.read_ros_handshake_header = _read_header
    tcpros_base.TCPROSTransportProtocol.read_messages = read_messages
    tcpros_pubsub.ServerProxy = master.proxy
    masterslave.xmlrpcapi = lambda uri, cache=True: master.proxy(uri)


def report(server: str, peer: str, problem: str, kind: str = "") -> None:
    """Log one line about a problem of a peer; further problems of the same kind are counted.

    `kind` is required if the peer can influence the text, because the peer could otherwise fill the log.
    """
    line = f"{server}: {peer}: {problem[:300]}" if peer else f"{server}: {problem}"
    _EVENTS(line, kind=f"{server} {peer} {kind or re.sub('[0-9]+', '#', problem)}")


def header_size(data: bytes | bytearray) -> int | None:
    """Return the size of a header with its length prefix; None if it is incomplete."""
    if len(data) < _LENGTH.size:
        return None
    (size,) = _LENGTH.unpack_from(data)
    if size > HEADER_BYTES:
        raise HandshakeRejected(f"header: expected at most {HEADER_BYTES} bytes, got {size}; this is not ROS")
    total = _LENGTH.size + size
    return total if len(data) >= total else None


def _read_header(sock: socket.socket, buffer: io.BytesIO, size: int) -> dict[str, str]:
    """Return the header of a publisher; the data after it remains in `buffer`. rospy's version accepts any length."""
    data = bytearray()
    try:
        while (end := header_size(data)) is None:
            part = sock.recv(size)
            if not part:
                raise HandshakeRejected("the connection ended before the header was complete")
            data += part
    except HandshakeRejected as refusal:
        report("TCPROS", sock.getpeername()[0], str(refusal))
        raise
    buffer.seek(0)  # after a lost connection it contains the rest of a message
    buffer.truncate()
    buffer.write(data[end:])
    return dict(decode_ros_handshake_header(bytes(data[:end])))


def read_messages(self: Any, buffer: io.BytesIO, messages: list[Any], sock: socket.socket) -> None:
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
        report(self.resolved_name, sock.getpeername()[0], problem)
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
