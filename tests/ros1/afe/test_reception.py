"""Reception of audio messages: the part of a message that rospy has not read yet is received without its buffer."""

from __future__ import annotations

import io
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import genpy
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rospy.exceptions import TransportTerminated

from rosafe.ros1.component import serialization
from rosafe.ros1.transport import received_data
from tests.harness import PATIENCE

AUDIO = "::binaudio::portStruct"
RECEIVE_BYTES = 4096


def serialized(message: Any) -> bytes:
    """Return a message with its length, as a publisher sends it."""
    written = io.BytesIO()
    message.serialize(written)
    return struct.pack("<I", len(written.getvalue())) + written.getvalue()


def audio(index: int, frames: int) -> Any:
    samples = np.arange(frames, dtype=np.int32) + index
    stamp = {"sec": index, "nsec": 1}
    return serialization.message_class("bass", AUDIO)(44100, 1, frames, index, samples, -samples, stamp)


@contextmanager
def sending(*data: bytes) -> Iterator[socket.socket]:
    """Send `data` from another thread, then close the connection; yield the socket of the receiver."""
    receiver, sender = socket.socketpair()

    def send() -> None:
        with sender:
            for part in filter(None, data):
                sender.sendall(part)

    thread = threading.Thread(target=send, daemon=True)
    receiver.settimeout(PATIENCE)
    with receiver:
        thread.start()
        yield receiver
    thread.join(PATIENCE)


def received(sock: socket.socket, data_class: Any, count: int, queue_size: int | None = None) -> list[Any]:
    """Receive messages as rospy's `receive_once`."""
    protocol = SimpleNamespace(recv_data_class=data_class, queue_size=queue_size, resolved_name="/test")
    buffer = io.BytesIO()
    found: list[Any] = []
    while len(found) < count:
        messages: list[Any] = []
        while not messages:
            if buffer.tell() >= 4:
                received_data.read_messages(protocol, buffer, messages, sock)
            if not messages:
                part = sock.recv(RECEIVE_BYTES)
                assert part, "the connection has ended"
                buffer.write(part)
        found += messages
    return found


@pytest.mark.parametrize("frames", [1, 100, 505, 506, 507, 5000, 100_000])
@pytest.mark.parametrize("cut", [1, 3, 4, 5, 4095, 4096, 4097, 10**6])
def test_messages_of_any_length_arrive_in_order(frames: int, cut: int) -> None:
    """Whatever the parts are in which the first bytes arrive."""
    data = b"".join(serialized(audio(index, frames)) for index in (1, 2, 3))
    data_class = serialization.tolerant_message_class("rosAFE", AUDIO, 2**20)
    with sending(data[:cut], data[cut:]) as sock:
        messages = received(sock, data_class, 3)
    assert [message.lastFrameIndex for message in messages] == [1, 2, 3]
    for index, message in enumerate(messages, 1):
        assert message.problem == "" and message.stamp.sec == index
        assert not message.left.flags.writeable
        np.testing.assert_array_equal(message.left, np.arange(frames) + index)
        np.testing.assert_array_equal(message.right, -message.left)


def test_a_publisher_that_disconnects_within_a_message() -> None:
    data = serialized(audio(1, 10_000))
    data_class = serialization.tolerant_message_class("rosAFE", AUDIO, 2**20)
    with sending(data[:-1]) as sock, pytest.raises(TransportTerminated, match="the publisher has disconnected"):
        received(sock, data_class, 1)


def test_generated_classes_are_read_by_rospy(monkeypatch: pytest.MonkeyPatch) -> None:
    """They cannot be read from a view of memory, whatever limits a process sets for them."""
    monkeypatch.setattr(genpy.Message, "longest_sequence", 2**26, raising=False)
    received_data.max_size.cache_clear()
    text = "x" * 10_000
    message = DiagnosticArray(status=[DiagnosticStatus(name=text)])
    with sending(serialized(message), serialized(message)) as sock:
        assert [found.status[0].name for found in received(sock, DiagnosticArray, 2)] == [text, text]
    received_data.max_size.cache_clear()


def test_a_bounded_queue_keeps_the_newest_messages() -> None:
    """Messages that are dropped are read by rospy, which drops them."""
    data = b"".join(serialized(audio(index, 100)) for index in range(1, 5))
    assert len(data) < RECEIVE_BYTES
    data_class = serialization.tolerant_message_class("rosAFE", AUDIO, 2**20)
    with sending(data) as sock:
        assert [message.lastFrameIndex for message in received(sock, data_class, 1, queue_size=1)] == [4]
