"""ROS' TCP protocol as coroutines: service calls on kept connections, and the newest message of a latched topic.

rospy's own clients block a thread for as long as a component does not answer; these have time limits, can be
cancelled, and serve hundreds of callers from one thread.
"""

from __future__ import annotations

import asyncio
import importlib
import io
import json
import os
import socket
import struct
from collections.abc import Mapping
from typing import Any

import genpy
import rosgraph.network

from rosafe.client import installed_components
from rosafe.client.asyncio_tools import run_shared
from rosafe.client.graph import Graph, NotRegisteredError, middleware_error
from rosafe.client.values import bad_value
from rosafe.component import explicit_defaults
from rosafe.declarations import plugins
from rosafe.interface import KINDS, PLUGINS, ComponentError

CONNECT_SECONDS = 3.0
CONNECTIONS = 4  # at once per service or type of topic; rospy's nodes take few new ones at a time
MAX_MESSAGE = 2**30  # bytes of a message or an answer that holds something
MAX_TEXT = 256 * 1024  # bytes of a header, with the definition of a type in it, or of an error
SAMPLE_SECONDS = 0.3  # a latched message comes at once; where none comes there is none yet
MESSAGE_SECONDS = 30.0  # for the rest of it
READ_BUFFER = 2**20
LARGE = 64 * 1024  # bytes of a message that is decoded on a thread: one with structures may take seconds

_LENGTH = struct.Struct("<I")
_GARBAGE = (asyncio.IncompleteReadError, rosgraph.network.ROSHandshakeException, ValueError, struct.error)


class ConnectionRejected(Exception):
    """The other side answered the connection with an error; the text is its own."""


class TcprosConnection:
    """One TCPROS connection after the exchange of headers."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, header: Mapping[str, str]) -> None:
        self._reader = reader
        self._writer = writer
        self.header = header

    @classmethod
    async def open(cls, address: tuple[str, int], header: Mapping[str, str]) -> TcprosConnection:
        """Connect and exchange headers; OSError, Refused or asyncio.TimeoutError."""

        async def attempt() -> TcprosConnection:
            reader, writer = await asyncio.open_connection(*address, limit=READ_BUFFER)
            try:
                _keep_alive(writer.get_extra_info("socket"))
                writer.write(rosgraph.network.encode_ros_handshake_header(header))
                answer = await _read_frame(reader, MAX_TEXT)
                fields = rosgraph.network.decode_ros_handshake_header(_LENGTH.pack(len(answer)) + answer)
                if "error" in fields:
                    raise ConnectionRejected(fields["error"])
            except BaseException:
                writer.close()
                raise
            return cls(reader, writer, fields)

        try:
            return await asyncio.wait_for(attempt(), CONNECT_SECONDS)
        except _GARBAGE as problem:
            raise ConnectionRejected(f"no ROS node: {problem}") from None

    @property
    def open_still(self) -> bool:
        """Whether the other side has neither closed nor sent anything unasked."""
        return not (self._writer.is_closing() or self._reader.at_eof())

    async def closed(self) -> None:
        """Wait until the other side closes the connection."""
        try:
            while await self._reader.read(READ_BUFFER):
                continue
        except OSError:
            return

    def close(self) -> None:
        self._writer.close()

    async def request(self, payload: bytes, limit: int) -> bytearray:
        """One service call, answered with up to `limit` bytes; Refused with the text of an answer that is an error."""
        self._writer.write(_LENGTH.pack(len(payload)) + payload)
        good = await self._reader.readexactly(1) == b"\1"
        answer = await _read_frame(self._reader, limit if good else MAX_TEXT)
        if not good:
            raise ConnectionRejected(answer.decode("utf-8", "replace"))
        return answer

    async def message(self) -> bytearray | None:
        """The latched message of a topic; None where it has none yet."""
        try:
            length = await asyncio.wait_for(self._reader.readexactly(4), SAMPLE_SECONDS)
        except TimeoutError:
            return None
        return await asyncio.wait_for(_read_body(self._reader, length, MAX_MESSAGE), MESSAGE_SECONDS)


def _keep_alive(sock: socket.socket) -> None:
    """Notice within half a minute that the other host is gone without a word."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 15)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 5)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)


async def _read_frame(reader: asyncio.StreamReader, limit: int) -> bytearray:
    """A length and as many bytes."""
    return await _read_body(reader, await reader.readexactly(4), limit)


async def _read_body(reader: asyncio.StreamReader, prefix: bytes, limit: int) -> bytearray:
    (length,) = _LENGTH.unpack(prefix)
    if length > limit:
        raise ConnectionRejected(f"a message of {length} bytes is more than genomixd takes")
    frame = bytearray()  # it grows as bytes come: what is only claimed takes no memory
    while len(frame) < length:
        part = await reader.read(length - len(frame))
        if not part:
            raise asyncio.IncompleteReadError(bytes(frame[:64]), length)
        frame += part
    return frame


async def decode(message: Any, data: bytearray) -> Any:
    """Return `message` filled from `data`; other requests go on meanwhile if that takes long."""
    if len(data) < LARGE:
        return message.deserialize(data)
    return await asyncio.to_thread(message.deserialize, data)


async def connect_service(graph: Graph, instance: str, header: Mapping[str, str]) -> TcprosConnection:
    """A connection to the service of `instance` that `header` names: where it was the last time, or the master says.

    Raises Unknown, Refused or OSError, and ComponentError where the master has to be asked and is not there.
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
    """Calls one service of one component instance, on connections that are kept."""

    def __init__(self, graph: Graph, package: str, instance: str, service: str) -> None:
        self._graph = graph
        self._instance = instance
        self.name = f"/{instance}/{service}"
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
        # The plugin whose request this is: it has to be there at both ends
        self._plugin = next((kind for kind in PLUGINS if KINDS[kind].request == service), "")
        self._slots = asyncio.Semaphore(CONNECTIONS)
        self._idle: list[TcprosConnection] = []

    async def check(self) -> None:
        """Return if the component can be reached, else raise ComponentError."""
        async with self._slots:
            self._return_to_pool(await self.connect())

    async def connect(self) -> TcprosConnection:
        """A connection to the service; ComponentError where the component cannot be reached."""
        while self._idle:
            connection = self._idle.pop()
            if connection.open_still:
                return connection
            connection.close()
        try:
            return await connect_service(self._graph, self._instance, self._header)
        except NotRegisteredError:
            if self._plugin and await self._graph.serves(f"/{self._instance}/connect_port"):
                raise self._without_plugin() from None
            raise middleware_error(f"{self._instance} is not running: nobody serves {self.name}") from None
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
            raise middleware_error(
                f"{self._instance} is not running any more, though the master still lists it ({why})"
            ) from None

    def _without_plugin(self) -> ComponentError:
        return middleware_error(
            f"{self._instance} was started without the plugin {self._plugin}; set {plugins.FOLDERS} and restart it"
        )

    def _return_to_pool(self, connection: TcprosConnection) -> None:
        """Take back a connection that is fit for another call."""
        if connection.open_still:
            self._idle.append(connection)
        else:
            connection.close()

    async def call(self, values: Mapping[str, Any], timeout: float) -> Any:
        """The response, with arrays in it, to a request made of `values`.

        Raises ComponentError: the component's own exception, or ``::genom::mwerr`` where none came.
        """
        buffer = io.BytesIO()
        try:
            installed_components.fill(self._request_class(), values).serialize(buffer)
        except UnicodeEncodeError:  # bytes of a command line that are no UTF-8
            raise bad_value(f"{self.name}: half a surrogate pair is no character") from None
        try:
            answer = await asyncio.wait_for(self._ask(buffer.getvalue()), timeout)
        except TimeoutError:
            raise middleware_error(f"{self._instance} did not answer {self.name} within {timeout:g} s") from None
        try:
            return await decode(self._response_class(), answer)
        except genpy.DeserializationError as problem:
            raise middleware_error(f"{self.name} answers garbage: {problem}") from None

    async def _ask(self, request: bytes) -> bytearray:
        async with self._slots:
            connection = await self.connect()
            try:
                answer = await connection.request(request, self._limit)
            except ConnectionRejected as problem:
                connection.close()
                raise middleware_error(f"{self.name}: {problem}") from None
            except (asyncio.IncompleteReadError, OSError):
                connection.close()
                raise middleware_error(f"{self._instance} ended before it answered {self.name}") from None
            except BaseException:
                connection.close()
                raise
            self._return_to_pool(connection)
            return answer

    def close(self) -> None:
        for connection in self._idle:
            connection.close()
        self._idle.clear()


# --- topics -----------------------------------------------------------------------------------------------------


class TopicReader:
    """Reads the newest message of latched topics of one type of message."""

    def __init__(self, graph: Graph, instance: str, message_class: Any) -> None:
        self._graph = graph
        self._instance = instance
        self._class = message_class
        self._slots = asyncio.Semaphore(CONNECTIONS)
        self._reads: dict[str, asyncio.Task[Any]] = {}  # that have not begun yet

    async def read(self, topic: str) -> Any:
        """The message, None where the topic has none yet, or Unknown where the component has no such topic.

        Those who ask while connections are few get the same message, one that is fetched after they asked.
        """
        if topic not in self._reads:
            self._reads[topic] = run_shared(self._read(topic))
        return await asyncio.shield(self._reads[topic])

    async def _read(self, topic: str) -> Any:
        async with self._slots:
            del self._reads[topic]
            # The node is asked first: one that is asked for a topic that it does not have logs kilobytes.
            address = await self._graph.topic_address(topic, self._instance)
            try:
                return await self._fetch(address, topic)
            except (ConnectionRejected, genpy.DeserializationError) as problem:
                raise middleware_error(f"{topic}: {problem}") from None
            except (TimeoutError, OSError, asyncio.IncompleteReadError) as problem:
                why = type(problem).__name__
                raise middleware_error(f"{self._instance} does not give out {topic} any more ({why})") from None

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


def component_exception(exdetail: str) -> ComponentError:
    """The exception that a component's `genom_exdetail` names."""
    try:
        body = json.loads(exdetail)
    except (ValueError, RecursionError):
        body = exdetail
    if isinstance(body, dict) and isinstance(body.get("ex"), str):
        detail, what = body.get("detail"), body.get("what")
        known = {str(name): value for name, value in detail.items()} if isinstance(detail, dict) else {}
        error = ComponentError(body["ex"], what if isinstance(what, str) else str(known.get("what", "")))
        error.detail = known  # whatever its members are called
        return error
    return ComponentError("::genom::unkex", what=str(body)[:127])
