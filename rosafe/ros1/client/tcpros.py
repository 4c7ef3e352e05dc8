"""TCPROS clients as coroutines: service calls on pooled connections, and the latest message of a latched topic.

rospy's clients block a thread until the component answers. These have time limits, can be cancelled, and serve hundreds
of callers on one thread.
"""

from __future__ import annotations

import asyncio
import importlib
import io
import json
import os
import struct
import weakref
from collections.abc import Mapping
from typing import Any

import genpy
import rosgraph.network

from rosafe.declarations import plugins
from rosafe.interface import KINDS, PLUGINS, ComponentError
from rosafe.ros1.client import installed_components
from rosafe.ros1.client.asyncio_tools import run_shared
from rosafe.ros1.client.errors import bad_value, middleware_error
from rosafe.ros1.client.graph import Graph, NotRegisteredError
from rosafe.ros1.component import explicit_defaults
from rosafe.ros1.transport.handshake_server import keep_alive

CONNECT_SECONDS = 3.0
MAX_CONNECTIONS = 4  # at the same time per service or type of topic; rospy's nodes accept few new ones at a time
MAX_MESSAGE = 2**30  # bytes of a message, or of an answer with outputs
MAX_TEXT = 256 * 1024  # bytes of a header, which includes the definition of a type, or of an error
SAMPLE_SECONDS = 0.3  # a latched message arrives immediately; after this time the topic has none yet
MESSAGE_SECONDS = 30.0  # from the first bytes of a message to the last
READ_BUFFER = 2**20
LARGE = 64 * 1024  # bytes; a longer message is decoded on a thread, because one with structures may take seconds

_LENGTH = struct.Struct("<I")
_INVALID_DATA = (asyncio.IncompleteReadError, rosgraph.network.ROSHandshakeException, ValueError, struct.error)


class ConnectionRejected(Exception):
    """The peer answered with an error, whose text this is, or not according to the protocol."""


class TcprosConnection:
    """One TCPROS connection after the exchange of headers."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, header: Mapping[str, str]) -> None:
        self._reader = reader
        self._writer = writer
        self.header = header

    @classmethod
    async def open(cls, address: tuple[str, int], header: Mapping[str, str]) -> TcprosConnection:
        """Connect and exchange headers; raises OSError, ConnectionRejected or TimeoutError."""
        try:
            async with asyncio.timeout(CONNECT_SECONDS):
                reader, writer = await asyncio.open_connection(*address, limit=READ_BUFFER)
                try:
                    keep_alive(writer.get_extra_info("socket"), idle=15, interval=5, count=3)
                    writer.write(rosgraph.network.encode_ros_handshake_header(header))
                    answer = await _read_frame(reader, MAX_TEXT)
                    fields = rosgraph.network.decode_ros_handshake_header(_LENGTH.pack(len(answer)) + answer)
                    if "error" in fields:
                        raise ConnectionRejected(fields["error"])
                except BaseException:
                    writer.close()
                    raise
                return cls(reader, writer, fields)
        except _INVALID_DATA as problem:
            raise ConnectionRejected(f"not a ROS node: {problem}") from None

    @property
    def reusable(self) -> bool:
        """Whether the connection is open at both ends."""
        return not (self._writer.is_closing() or self._reader.at_eof())

    async def closed(self) -> None:
        """Wait until the peer closes the connection."""
        try:
            while await self._reader.read(READ_BUFFER):
                continue
        except OSError:
            return

    def close(self) -> None:
        self._writer.close()

    async def request(self, payload: bytes, limit: int) -> bytearray:
        """Call the service and return an answer of up to `limit` bytes; ConnectionRejected for an error."""
        self._writer.write(_LENGTH.pack(len(payload)) + payload)
        good = await self._reader.readexactly(1) == b"\1"
        answer = await _read_frame(self._reader, limit if good else MAX_TEXT)
        if not good:
            raise ConnectionRejected(answer.decode("utf-8", "replace"))
        return answer

    async def message(self) -> bytearray | None:
        """Return the latched message of a topic; None if it has none yet."""
        try:
            length = await asyncio.wait_for(self._reader.readexactly(4), SAMPLE_SECONDS)
        except TimeoutError:
            return None
        return await asyncio.wait_for(_read_body(self._reader, length, MAX_MESSAGE), MESSAGE_SECONDS)


async def _read_frame(reader: asyncio.StreamReader, limit: int) -> bytearray:
    """Read a length and return as many bytes."""
    return await _read_body(reader, await reader.readexactly(4), limit)


async def _read_body(reader: asyncio.StreamReader, prefix: bytes, limit: int) -> bytearray:
    (length,) = _LENGTH.unpack(prefix)
    if length > limit:
        raise ConnectionRejected(f"message: expected at most {limit} bytes, got {length}")
    frame = bytearray()  # it grows with the data received, so that a wrong length allocates no memory
    while len(frame) < length:
        data = await reader.read(length - len(frame))
        if not data:
            raise asyncio.IncompleteReadError(bytes(frame[:64]), length)
        frame += data
    return frame


async def decode(message: Any, data: bytearray) -> Any:
    """Return `message` with the members in `data`; a long message is decoded on a thread."""
    if len(data) < LARGE:
        return message.deserialize(data)
    return await asyncio.to_thread(message.deserialize, data)


async def connect_service(graph: Graph, instance: str, header: Mapping[str, str]) -> TcprosConnection:
    """Connect to the service of `instance` that `header` names, at its last address or the one that the master has.

    Raises NotRegisteredError, ConnectionRejected or OSError, and ComponentError if the master is needed and does not
    answer.
    """
    known = graph.known_address(instance)
    failure: Exception | None = None
    if known is not None:
        try:
            return await TcprosConnection.open(known, header)
        except (ConnectionRejected, OSError) as problem:
            failure = problem
    address = await graph.service_address(header["service"])
    if failure is not None and address == known:
        raise failure
    connection = await TcprosConnection.open(address, header)
    graph.note_reachable(instance, address)
    return connection


# --- services ---------------------------------------------------------------------------------------------------


class ServiceClient:
    """Calls one service of one component instance, on pooled connections."""

    def __init__(self, graph: Graph, package: str, instance: str, service: str) -> None:
        self._graph = graph
        self._instance = instance
        self.name = f"{graph.resolve(instance)}/{service}"
        definition = getattr(importlib.import_module(f"{package}.srv"), service)
        self._request_class = getattr(importlib.import_module(f"{package}.srv"), f"{service}Request")
        self._response_class = installed_components.response_class(package, service)
        self._header = {
            "service": self.name,
            "md5sum": definition._md5sum,
            "type": definition._type,
            "callerid": graph.name,
            "persistent": "1",
            **explicit_defaults.HEADER,
        }
        outputs = self._response_class.__slots__[2:]  # after genom_success and genom_exdetail
        self._limit = MAX_MESSAGE if outputs else MAX_TEXT
        # The plugin that this request belongs to; both the component and this process need it.
        self._plugin = next((kind for kind in PLUGINS if KINDS[kind].request == service), "")
        self._slots = asyncio.Semaphore(MAX_CONNECTIONS)
        self._idle: list[TcprosConnection] = []

    async def check(self) -> None:
        """Raise ComponentError if the component cannot be reached."""
        async with self._slots:
            self._return_to_pool(await self.connect())

    async def connect(self) -> TcprosConnection:
        """Return a connection to the service; ComponentError if the component cannot be reached."""
        while self._idle:
            connection = self._idle.pop()
            if connection.reusable:
                return connection
            connection.close()
        try:
            return await connect_service(self._graph, self._instance, self._header)
        except NotRegisteredError:
            if self._plugin and await self._graph.is_service(f"{self._graph.resolve(self._instance)}/connect_port"):
                raise self._without_plugin() from None
            raise not_running(self._instance, self.name) from None
        except ConnectionRejected as problem:
            if self._plugin and "is not a provider of" in str(problem):
                raise self._without_plugin() from None
            if "md5sums do not match" in str(problem):
                what = f"the plugin {self._plugin}" if self._plugin else "rosafe"
                raise middleware_error(
                    f"{self._instance} was started with another version of {what} than this program: the parameters of "
                    f"{self.name} differ; use the same version for both, and restart them"
                ) from None
            raise middleware_error(f"{self.name}: {problem}") from None
        except TimeoutError:
            raise middleware_error(f"{self._instance} does not answer: no connection to {self.name}") from None
        except OSError as problem:
            why = os.strerror(problem.errno or 0)
            what = f"{self._instance} is not running any more, though it is still registered at the master ({why})"
            raise middleware_error(what) from None

    def _without_plugin(self) -> ComponentError:
        return middleware_error(
            f"{self._instance} was started without the plugin {self._plugin}; set {plugins.FOLDERS} and restart it"
        )

    def _return_to_pool(self, connection: TcprosConnection) -> None:
        """Keep a connection for another call if it is still open."""
        if connection.reusable:
            self._idle.append(connection)
        else:
            connection.close()

    async def call(self, values: Mapping[str, Any], timeout: float) -> Any:
        """Return the response, which may contain arrays, to a request with `values`.

        Raises ComponentError ``::genom::mwerr`` if no valid response arrives.
        """
        buffer = io.BytesIO()
        try:
            installed_components.fill(self._request_class(), values).serialize(buffer)
        except UnicodeEncodeError:  # bytes of a command line that are not UTF-8
            raise bad_value(f"{self.name}: contains an unpaired UTF-16 surrogate") from None
        try:
            answer = await asyncio.wait_for(self._ask(buffer.getvalue()), timeout)
        except TimeoutError:
            raise middleware_error(f"{self._instance} did not answer {self.name} within {timeout:g} s") from None
        try:
            return await decode(self._response_class(), answer)
        except genpy.DeserializationError as problem:
            raise middleware_error(f"{self.name}: the response cannot be decoded: {problem}") from None

    async def _ask(self, request: bytes) -> bytearray:
        async with self._slots:
            connection = await self.connect()
            try:
                answer = await connection.request(request, self._limit)
            except BaseException as problem:
                connection.close()
                if isinstance(problem, ConnectionRejected):
                    raise middleware_error(f"{self.name}: {problem}") from None
                if isinstance(problem, (asyncio.IncompleteReadError, OSError)):
                    raise middleware_error(f"{self._instance} ended before it answered {self.name}") from None
                raise
            self._return_to_pool(connection)
            return answer

    def close(self) -> None:
        for connection in self._idle:
            connection.close()
        self._idle.clear()


# --- topics -----------------------------------------------------------------------------------------------------


class TopicReader:
    """Reads the latest message of latched topics of one message type."""

    def __init__(self, graph: Graph, instance: str, message_class: Any) -> None:
        self._graph = graph
        self._instance = instance
        self._class = message_class
        self._slots = asyncio.Semaphore(MAX_CONNECTIONS)
        self._reads: dict[str, asyncio.Task[Any]] = {}  # that have not started yet
        # A node of rospy closes a connection when another one with the same caller id and topic is opened.
        self._locks: weakref.WeakValueDictionary[str, asyncio.Lock] = weakref.WeakValueDictionary()

    async def read(self, topic: str) -> Any:
        """Return the message, None if the topic has none yet; NotRegisteredError if the component has no such topic.

        Callers that wait for a free connection share one message, which is read when a connection is free.
        """
        if topic not in self._reads:
            self._reads[topic] = run_shared(self._read(topic))
        return await asyncio.shield(self._reads[topic])

    async def _read(self, topic: str) -> Any:
        async with self._locks.setdefault(topic, asyncio.Lock()), self._slots:
            del self._reads[topic]
            # Check at the node first: a connection for a topic that it does not have makes it log kilobytes.
            address = await self._graph.topic_address(topic, self._instance)
            try:
                return await self._fetch(address, topic)
            except (ConnectionRejected, genpy.DeserializationError) as problem:
                raise middleware_error(f"{topic}: {problem}") from None
            except (TimeoutError, OSError, asyncio.IncompleteReadError) as problem:
                why = type(problem).__name__
                raise middleware_error(f"{self._instance} does not publish {topic} any more ({why})") from None

    async def _fetch(self, address: tuple[str, int], topic: str) -> Any:
        header = {
            "topic": topic,
            "type": self._class._type,
            "md5sum": self._class._md5sum,
            "callerid": self._graph.name,
            "tcp_nodelay": "1",
            "message_definition": self._class._full_text,
        }
        connection = await TcprosConnection.open(address, header)
        try:
            data = await connection.message()
        finally:
            connection.close()
        return None if data is None else await decode(self._class(), data)


def not_running(instance: str, service: str) -> ComponentError:
    """Return the error of a component whose service is not registered."""
    return middleware_error(f"{instance} is not running: {service} is not registered")


def component_exception(exdetail: str) -> ComponentError:
    """Return the exception that a component reports in `genom_exdetail`."""
    try:
        body = json.loads(exdetail)
    except (ValueError, RecursionError):
        body = exdetail
    if isinstance(body, dict) and isinstance(body.get("ex"), str):
        detail, what = body.get("detail"), body.get("what")
        known = {str(name): value for name, value in detail.items()} if isinstance(detail, dict) else {}
        error = ComponentError(body["ex"], what if isinstance(what, str) else str(known.get("what", "")))
        error.detail = known  # not passed as keywords, because the names are arbitrary
        return error
    return ComponentError("::genom::unkex", what=str(body)[:127])
