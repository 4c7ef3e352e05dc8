"""Latched topics whose subscribers take messages at their own pace, while the publisher goes on.

rospy's own publisher copies every message into a buffer of its own, and its queue is one message for all topics alike.
Here a message is gathered once for all subscribers, without copying samples, and only where there is a subscriber. Each
subscriber has a thread that sends, straight from the processors' blocks into the socket. What waits for a subscriber
is bounded: one that reads slowly or not at all misses old messages and holds up nobody.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import rospy
from rospy import topics
from rospy.impl.registration import Registration, get_topic_manager

from rosafe.transport.buffer_list import BufferList

# What may wait for one subscriber besides what is on its way. Windows overlap, so that a message of a long port is made
# up for by the next one, and the newest is enough; messages of short ports are small, and several can wait.
MAX_WAITING = 32
MAX_WAITING_BYTES = 16_000_000
SHORT_BYTES = 512  # of a message that is sent without a detour
_LENGTH = struct.Struct("<I")
_MAX_PIECES = os.sysconf("SC_IOV_MAX")  # of one sendmsg


class Publisher(rospy.Publisher):
    """A latched topic; its messages must not be changed once they are published.

    Parameters
    ----------
    name : str
        The topic.
    data_class : type
        A message class of `rosafe.component.serialization`, or a generated one without Header.
    """

    def __init__(self, name: str, data_class: Any) -> None:
        manager, topic = get_topic_manager(), rospy.resolve_name(name)
        with manager.lock:  # rospy makes its own kind of topic where it finds none
            if manager.get_publisher_impl(topic) is None:
                manager._add(_Topic(topic, data_class), manager.pubs, Registration.PUB)
            super().__init__(name, data_class, latch=True, queue_size=1)


class _Topic(topics._PublisherImpl):
    """What rospy has behind a Publisher, with senders for connections."""

    connection_poll: topics.Poller

    def __init__(self, name: str, data_class: Any) -> None:
        super().__init__(name, data_class)
        self.on_connection: Callable[[], None] = lambda: None  # there is one subscriber more
        self.connection_poll.poller.close()
        self.connection_poll = _Poller()

    def set_queue_size(self, queue_size: int) -> None:
        """Have no queue of rospy's, with a thread of its own: the senders have theirs."""

    def add_connection(self, connection: Any) -> bool:
        """Take on a subscriber; it gets the latched message."""
        # Messages are written whole, so nothing is gained by keeping back the last bytes of one.
        connection.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sender = _Sender(connection)
        try:
            return super().add_connection(sender)
        except Exception:
            if not self.closed:
                raise
            return False
        finally:
            self.on_connection()
            if self.closed:  # in this very moment; rospy would leave the subscriber waiting
                sender.end()

    def remove_connection(self, connection: Any) -> None:
        """Forget a subscriber; rospy would tell its listeners, which there are none of, and stumble at the end."""
        topics._TopicImpl.remove_connection(self, connection)

    def publish(self, message: Any, connection_override: Any = None) -> None:
        """Keep `message` for those who come later, and send it to those who are here (or to one connection)."""
        if self.closed:
            if rospy.is_shutdown():
                return
            raise rospy.ROSException(f"publish() to {self.resolved_name}, which is closed")
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
        """Send a message to all subscribers, but do not keep it for later ones; return whether there are any."""
        senders = self.connections
        if senders:
            self._offer(written, senders)
        return bool(senders)

    def _offer(self, written: BufferList, senders: list[Any]) -> None:
        self.message_data_sent += _LENGTH.size + written.size  # for getBusStats; once, as rospy counts it
        for sender in senders:
            sender.offer(written)


class _Poller(topics.Poller):
    """Looks for connections that have ended. Its file is closed with the topic.

    rospy's own refers to itself, so that the files of topics that are gone pile up until garbage is collected.
    """

    def __init__(self) -> None:
        self.poller = select.epoll()

    add_fd = topics.Poller.add_epoll
    remove_fd = topics.Poller.remove_epoll
    error_iter = topics.Poller.error_epoll_iter


class _Sender:
    """The connection to one subscriber, and the thread that sends to it."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._turn = threading.Condition()
        self._waiting: deque[BufferList] = deque(maxlen=MAX_WAITING)
        self._rest = b""  # of a message that was sent in part
        self._sending = False
        threading.Thread(target=self._run, name=f"to {connection.endpoint_id}", daemon=True).start()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)  # to rospy it is the connection

    def set_cleanup_callback(self, callback: Callable[[Any], None]) -> None:
        """Let rospy know when the connection is closed."""

        def closed(_: Any) -> None:
            try:
                callback(self)
            finally:
                self._wake()

        self._connection.set_cleanup_callback(closed)

    def end(self) -> None:
        """Close the connection, whether rospy knows it or not."""
        self._connection.close()
        self._wake()

    def _wake(self) -> None:
        with self._turn:
            self._turn.notify()

    def offer(self, written: BufferList) -> None:
        """Send a message when there is time, unless too many newer ones come before.

        A short one is sent at once if nothing is ahead of it: to wake the thread takes ten times as long.
        """
        with self._turn:
            idle = not (self._waiting or self._rest or self._sending)
            if idle and written.size <= SHORT_BYTES and self._send_at_once(written):
                return
            self._waiting.append(written)
            while len(self._waiting) > 1 and sum(w.size for w in self._waiting) > MAX_WAITING_BYTES:
                self._waiting.popleft()
            self._turn.notify()

    def _send_at_once(self, written: BufferList) -> bool:
        """Return whether the message was sent; False if the subscriber reads too slowly, or has left."""
        sock, data = self._connection.socket, b"".join([_LENGTH.pack(written.size), *written.pieces])
        try:
            sent = sock.send(data, socket.MSG_DONTWAIT)
        except (OSError, AttributeError):  # the thread finds out what it is
            return False
        self._rest = data[sent:]
        if self._rest:
            self._turn.notify()
        self._count(written)
        return True

    def _run(self) -> None:
        try:
            while True:
                with self._turn:
                    self._sending = False
                    self._turn.wait_for(lambda: self._waiting or self._rest or self._connection.done)
                    if self._connection.done:
                        return
                    rest, self._rest = self._rest, b""
                    written = None if rest else self._waiting.popleft()
                    self._sending = True
                self._send(rest, written)
                del written  # it holds on to blocks
        except OSError as problem:
            rospy.logdebug(f"{self._connection.name}: {self._connection.endpoint_id} has left: {problem}")
        finally:
            self._waiting.clear()
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
    """Send contiguous buffers, one after the other; OSError where the other side has left."""
    for first in range(0, len(pieces), _MAX_PIECES):
        batch = pieces[first : first + _MAX_PIECES]
        sent = sock.sendmsg(batch)
        if sent < sum(memoryview(piece).nbytes for piece in batch):  # a signal came in between, or the like
            sock.sendall(memoryview(b"".join(batch))[sent:])
