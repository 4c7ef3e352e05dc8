"""Latched topics whose subscribers get the newest message, each at its own pace, while the publisher goes on.

rospy's own publisher serialises in `publish`, in the caller's thread, before it knows whether a subscriber can take the
message. Here each subscriber has a thread that takes the newest message when the last one is sent: a message of which
nobody will see anything costs nothing, a subscriber that reads slowly or not at all misses messages and holds up
nobody, and the samples go from the processors' blocks into the socket without a copy in between.
"""

from __future__ import annotations

import os
import socket
import struct
import threading
from collections.abc import Callable, Sequence
from typing import Any

import genpy
import rospy
from rospy import topics
from rospy.impl.registration import Registration, get_topic_manager

from rosafe.ros.wire import Gather

_LENGTH = struct.Struct("<I")
_MAX_PIECES = os.sysconf("SC_IOV_MAX")  # of one sendmsg


class Publisher(rospy.Publisher):
    """A latched topic; its messages must not be changed once they are published.

    Parameters
    ----------
    name : str
        The topic.
    data_class : type
        A message class of `rosafe.ros.wire`, or a generated one without Header.
    """

    def __init__(self, name: str, data_class: Any) -> None:
        manager, topic = get_topic_manager(), rospy.resolve_name(name)
        with manager.lock:  # rospy makes its own kind of topic where it finds none
            if manager.get_publisher_impl(topic) is None:
                manager._add(_Topic(topic, data_class), manager.pubs, Registration.PUB)
            super().__init__(name, data_class, latch=True, queue_size=1)


class _Topic(topics._PublisherImpl):
    """What rospy has behind a Publisher, with senders for connections."""

    def set_queue_size(self, queue_size: int) -> None:
        """Have no queue: every sender has room for the newest message, and rospy adds no thread of its own to it."""

    def add_connection(self, connection: Any) -> bool:
        """Take on a subscriber; it gets the latched message."""
        # Messages are written whole, so nothing is gained by keeping back the last bytes of one.
        connection.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return super().add_connection(_Sender(connection))

    def publish(self, message: Any, connection_override: Any = None) -> None:
        """Keep `message` for those who come later, and offer it to those who are here (or to one connection)."""
        if self.closed:
            if rospy.is_shutdown():
                return
            raise rospy.ROSException(f"publish() to {self.resolved_name}, which is closed")
        self.latch = message
        for sender in self.connections if connection_override is None else [connection_override]:
            sender.offer(message)


class _Sender:
    """The connection to one subscriber, and the thread that sends it what is newest."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._turn = threading.Condition()
        self._newest: Any = None
        threading.Thread(target=self._run, name=f"to {connection.endpoint_id}", daemon=True).start()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)  # to rospy it is the connection

    def set_cleanup_callback(self, callback: Callable[[Any], None]) -> None:
        """Let rospy know when the connection is closed."""

        def closed(_: Any) -> None:
            callback(self)
            with self._turn:
                self._turn.notify()

        self._connection.set_cleanup_callback(closed)

    def offer(self, message: Any) -> None:
        """Send `message` when there is time, unless a newer one comes before."""
        with self._turn:
            self._newest = message
            self._turn.notify()

    def _run(self) -> None:
        while True:
            with self._turn:
                self._turn.wait_for(lambda: self._newest is not None or self._connection.done)
                message, self._newest = self._newest, None
            sock = self._connection.socket  # None once it is closed
            if self._connection.done or sock is None:
                return
            try:
                self._send(sock, message)
            except genpy.SerializationError as problem:
                rospy.logerr(f"{self._connection.name}: {problem}")
            except OSError as problem:
                rospy.logdebug(f"{self._connection.name}: {self._connection.endpoint_id} has left: {problem}")
                self._connection.close()
            del message  # it holds on to blocks

    def _send(self, sock: socket.socket, message: Any) -> None:
        out = Gather()
        message.serialize(out)
        send_pieces(sock, [_LENGTH.pack(out.size), *out.pieces])
        self._connection.stat_bytes += _LENGTH.size + out.size
        self._connection.stat_num_msg += 1


def send_pieces(sock: socket.socket, pieces: Sequence[Any]) -> None:
    """Send contiguous buffers, none of them empty, one after the other; OSError where the other side has left."""
    views = [memoryview(piece).cast("B") for piece in pieces]
    done = 0
    while done < len(views):
        sent = sock.sendmsg(views[done : done + _MAX_PIECES])
        while done < len(views) and sent >= len(views[done]):
            sent -= len(views[done])
            done += 1
        if sent:
            views[done] = views[done][sent:]
