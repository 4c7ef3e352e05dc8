"""Latched topics with an independent queue and thread for each subscriber, so that publishing never blocks.

rospy's publisher copies every message into a buffer, and its queue has one message for any topic. Here a message is
serialized once for all subscribers, without copying samples, and only if there is a subscriber. The thread of each
subscriber sends directly from the processors' blocks to the socket. The queue of each subscriber is limited: a
subscriber that reads slowly or not at all misses old messages and does not delay others.
"""

from __future__ import annotations

import os
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import rospy
from rospy import topics
from rospy.impl.registration import Registration, get_topic_manager

# Limits of one subscriber's queue. Windows overlap: the next message of a long port replaces a lost one, and the newest
# one suffices. Messages of short ports are small, and several can be queued.
MAX_QUEUED = 32
MAX_QUEUED_BYTES = 16_000_000
DIRECT_BYTES = 2**16  # a message up to this length is sent directly, without the thread, if the system accepts it
_LENGTH = struct.Struct("<I")
_MAX_PIECES = os.sysconf("SC_IOV_MAX")  # of one sendmsg


class BufferList:
    """A serialized message as buffers for one `sendmsg`. The buffers are not copied and must not change."""

    def __init__(self) -> None:
        self.pieces: list[Any] = []
        self.size = 0  # bytes

    def write(self, data: Any, /) -> None:
        """Append the bytes of a contiguous buffer."""
        size = len(data) if isinstance(data, (bytes, bytearray)) else data.nbytes
        if size:
            self.pieces.append(data)
            self.size += size


class Publisher(rospy.Publisher):
    """A latched topic; its messages must not be changed once they are published.

    Parameters
    ----------
    name : str
        Name of the topic.
    data_class : type
        A message class of `rosafe.ros1.component.serialization`, or a generated one without Header.
    """

    def __init__(self, name: str, data_class: Any) -> None:
        manager, topic = get_topic_manager(), rospy.resolve_name(name)
        with manager.lock:  # otherwise rospy would create its own kind of topic
            if manager.get_publisher_impl(topic) is None:
                manager._add(_Topic(topic, data_class), manager.pubs, Registration.PUB)
            super().__init__(name, data_class, latch=True, queue_size=1)

    @property
    def has_subscribers(self) -> bool:
        """Whether there is a subscriber."""
        topic = self.impl
        return topic is not None and bool(topic.connections)

    def publish_newest(self, newest: NewestMessage) -> None:
        """Publish the message `newest.build()`. Without subscribers it is built when the first one connects."""
        topic = self.impl
        if topic is not None:
            # A subscriber that connects now gets the latched message after it has been added to the connections.
            if topic.latch is newest and not topic.connections:
                return
            topic.acquire()  # a new subscriber waits for this lock before it gets the latched message
            try:
                topic.latch = newest
                if topic.connections:
                    topic.publish(newest.build())
            finally:
                topic.release()


class NewestMessage(NamedTuple):
    """The newest message of a topic, which is built only if there is a subscriber.

    `build` may be called at any time and from any thread.
    """

    build: Callable[[], Any]


class _Topic(topics._PublisherImpl):
    """The implementation of a topic that rospy uses for a Publisher, with a `_Sender` for each connection."""

    def __init__(self, name: str, data_class: Any) -> None:
        super().__init__(name, data_class)
        self.on_change: Callable[[], None] = lambda: None  # called when a subscriber has connected or disconnected

    def set_queue_size(self, queue_size: int) -> None:
        """Do not create rospy's queue and its thread: each sender has its own."""

    def add_connection(self, connection: Any) -> bool:
        """Add a subscriber and send it the latched message."""
        # Complete messages are written at once, so delaying the last bytes (Nagle's algorithm) has no advantage.
        connection.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sender = _Sender(connection)
        try:
            return super().add_connection(sender)
        except Exception:
            if not self.closed:
                raise
            return False
        finally:
            self.on_change()
            if self.closed:  # meanwhile; rospy would leave the subscriber waiting
                sender.end()

    def remove_connection(self, connection: Any) -> None:
        """Remove a subscriber; rospy's method also notifies listeners, which are not used, and fails at shutdown."""
        topics._TopicImpl.remove_connection(self, connection)
        self.on_change()

    def publish(self, message: Any, connection_override: Any = None) -> None:
        """Keep `message` for later subscribers, and send it to the present ones (or to one connection)."""
        if self.closed:
            if rospy.is_shutdown():
                return
            raise rospy.ROSException(f"publish() to {self.resolved_name}, which is closed")
        if isinstance(message, NewestMessage):
            message = message.build()
        self.latch = message
        senders = self.connections if connection_override is None else [connection_override]
        if senders:
            if getattr(message, "_has_header", False):
                self.seq += 1
                message.header.seq = self.seq
            written = BufferList()
            message.serialize(written)
            self._offer(written, senders)

    def send(self, written: BufferList) -> bool:
        """Send a message to all subscribers without keeping it for later ones; return whether there are subscribers."""
        senders = self.connections
        if senders:
            self._offer(written, senders)
        return bool(senders)

    def _offer(self, written: BufferList, senders: list[Any]) -> None:
        self.message_data_sent += _LENGTH.size + written.size  # for getBusStats; counted once, as in rospy
        for sender in senders:
            sender.offer(written)


class _Sender:
    """The connection to one subscriber, and the thread that sends to it."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._message_queued = threading.Condition()
        self._queue: deque[BufferList] = deque(maxlen=MAX_QUEUED)
        self._rest = b""  # the rest of a partially sent message
        self._sending = False
        threading.Thread(target=self._run, name=f"to {connection.endpoint_id}", daemon=True).start()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)  # rospy uses it as the connection

    def set_cleanup_callback(self, callback: Callable[[Any], None]) -> None:
        """Set the callback that notifies rospy when the connection is closed."""

        def closed(_: Any) -> None:
            try:
                callback(self)
            finally:
                self._connection.set_cleanup_callback(None)  # a reference cycle, also with the topic
                self._wake()

        self._connection.set_cleanup_callback(closed)
        if self._connection.done:  # by a message to a subscriber that has left, while rospy adds it
            closed(self._connection)

    def end(self) -> None:
        """Close the connection, whether or not it is registered in rospy."""
        self._connection.close()
        self._wake()

    def _wake(self) -> None:
        with self._message_queued:
            self._message_queued.notify()

    def offer(self, written: BufferList) -> None:
        """Queue a message; it is dropped if too many newer ones follow before it is sent.

        A short one is sent directly if the queue is empty: waking the thread takes more time than the call.
        """
        with self._message_queued:
            idle = not (self._queue or self._rest or self._sending)
            if idle and written.size <= DIRECT_BYTES and self._send_at_once(written):
                return
            self._queue.append(written)
            while len(self._queue) > 1 and sum(w.size for w in self._queue) > MAX_QUEUED_BYTES:
                self._queue.popleft()
            self._message_queued.notify()

    def _send_at_once(self, written: BufferList) -> bool:
        """Send a message and return True; return False if the subscriber reads too slowly or has disconnected."""
        pieces = [_LENGTH.pack(written.size), *written.pieces]
        if len(pieces) > _MAX_PIECES:
            return False
        try:
            sent = self._connection.socket.sendmsg(pieces, (), socket.MSG_DONTWAIT)
        except (OSError, AttributeError):  # the thread handles the cause
            return False
        if sent < _LENGTH.size + written.size:
            self._rest = b"".join(pieces)[sent:]
            self._message_queued.notify()
        self._count(written)
        return True

    def _run(self) -> None:
        try:
            while True:
                with self._message_queued:
                    self._sending = False
                    self._message_queued.wait_for(lambda: self._queue or self._rest or self._connection.done)
                    if self._connection.done:
                        return
                    rest, self._rest = self._rest, b""
                    written = None if rest else self._queue.popleft()
                    self._sending = True
                self._send(rest, written)
                del written  # it references blocks
        except OSError as problem:
            rospy.logdebug(f"{self._connection.name}: {self._connection.endpoint_id} has disconnected: {problem}")
        finally:
            self._queue.clear()
            self._connection.close()

    def _send(self, rest: bytes, written: BufferList | None) -> None:
        sock = self._connection.socket
        if sock is None:  # closed meanwhile
            return
        if written is None:
            sock.sendall(rest)
        else:
            send_pieces(sock, [_LENGTH.pack(written.size), *written.pieces])
            self._count(written)

    def _count(self, written: BufferList) -> None:
        self._connection.stat_bytes += _LENGTH.size + written.size
        self._connection.stat_num_msg += 1


def send_pieces(sock: socket.socket, pieces: Sequence[Any]) -> None:
    """Send contiguous buffers in order; OSError if the other side has disconnected."""
    for first in range(0, len(pieces), _MAX_PIECES):
        batch = pieces[first : first + _MAX_PIECES]
        sent = sock.sendmsg(batch)
        if sent < sum(memoryview(piece).nbytes for piece in batch):  # interrupted, for example by a signal
            sock.sendall(memoryview(b"".join(batch))[sent:])
