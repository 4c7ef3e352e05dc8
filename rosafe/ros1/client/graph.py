"""Access to the ROS graph: XML-RPC calls of the master and of nodes, and a node in this process when one is needed.

All calls are coroutines with a time limit. If the master is unreachable or has restarted without its registrations,
calls fail only as long as that lasts; components are meanwhile contacted at their last known addresses.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import os
import time
import xmlrpc.client
from typing import Any
from urllib.parse import urlsplit
from xml.parsers.expat import ExpatError

import aiohttp
import rosgraph.names

from rosafe.interface import ComponentError
from rosafe.ros1.client.asyncio_tools import run_shared
from rosafe.ros1.client.errors import middleware_error
from rosafe.ros1.component import startup

RPC_SECONDS = 3.0  # for one call of the master or of a node
NODE_SECONDS = 15.0  # to become a node of the graph
JOIN_SECONDS = 1.0  # between two attempts of a server to become one
POLL_SECONDS = 0.05  # between two requests for the master's state, for all callers together
MAX_CALLS = 8  # of the master at a time
MAX_ANSWER = 16 * 2**20  # bytes of an answer of the master or a node
MAX_KNOWN = 1000  # components whose addresses are cached

_FAILURES = (OSError, aiohttp.ClientError, ValueError)  # TimeoutError is an OSError


class NotRegisteredError(Exception):
    """The master or a node answered that the requested name is not registered."""


class Graph:
    """The graph of the master at `uri`. Create it in a running event loop, and `close` it at the end.

    Parameters
    ----------
    uri : str
        Address of the master.
    program : str
        Prefix of the name of this process's node, unless roslaunch sets the name.
    server : bool
        Whether `program` is the complete name, if no node of that name runs.
    """

    def __init__(self, uri: str, program: str = "genomixd", server: bool = False) -> None:
        self.uri = uri
        self._namespace = rosgraph.names.get_ros_namespace()  # ROS_NAMESPACE or __ns, with a slash at its end
        self._program = program
        self._server = server
        self.name = f"/{program}_{os.getpid()}_{int(time.time() * 1000)}"
        self.gone = asyncio.Event()  # set when this process's node was asked to end, for example by `rosnode kill`
        self._http = aiohttp.ClientSession(
            connector=aiohttp.TCPConnector(force_close=True, limit=0),
            timeout=aiohttp.ClientTimeout(total=RPC_SECONDS),
        )
        self._node: asyncio.Task[None] | None = None
        self.is_node = False  # set once the node has started
        self._calls = asyncio.Semaphore(MAX_CALLS)
        self._next_poll: asyncio.Task[set[str]] | None = None  # the next poll of the services, which has not begun yet
        self._poll_lock = asyncio.Lock()
        self._polled_at = 0.0
        self._addresses: dict[str, tuple[str, int]] = {}  # last known addresses of the services of instances
        self._uris: dict[str, str] = {}  # last known addresses of their nodes

    async def close(self) -> None:
        """Leave the graph."""
        self.gone.set()  # otherwise `join` may try again, without a session
        if self._node is not None:
            self._node.cancel()
        if self.is_node:
            import rospy

            await asyncio.to_thread(rospy.signal_shutdown, f"{self._program} ends")
        await self._http.close()

    # --- names ---

    def resolve(self, name: str) -> str:
        """Return the full name of a node; a relative name is in the namespace of this process."""
        return str(rosgraph.names.ns_join(self._namespace, name))

    def shorten(self, name: str) -> str:
        """Return the shortest name that `resolve` maps to the full name of `name`."""
        return self.resolve(name).removeprefix(self._namespace)

    # --- XML-RPC ---

    async def master(self, method: str, *arguments: Any) -> Any:
        """Return the value of the master's `method`.

        Raises NotRegisteredError if there is none, and ComponentError if the master does not answer.
        """
        try:
            async with asyncio.timeout(RPC_SECONDS), self._calls:
                return await self.node(self.uri, method, *arguments)
        except _FAILURES as problem:
            raise middleware_error(
                f"no ROS master at {self.uri} ({_reason(problem)}): start roscore first, or set ROS_MASTER_URI"
            ) from None

    async def node(self, uri: str, method: str, *arguments: Any) -> Any:
        """Return the value of `method` of the node or master at `uri`."""
        body = xmlrpc.client.dumps((self.name, *arguments), method)
        text = bytearray()
        async with self._http.post(uri, data=body.encode(), headers={"Content-Type": "text/xml"}) as response:
            async for data in response.content.iter_any():
                text += data
                if len(text) > MAX_ANSWER:
                    raise OSError(errno.EMSGSIZE, os.strerror(errno.EMSGSIZE))
        try:
            values: Any = xmlrpc.client.loads(text.decode())[0]
            code, message, value = values[0]
        except (ExpatError, xmlrpc.client.Error, ValueError, TypeError, IndexError):
            raise OSError(errno.EPROTO, os.strerror(errno.EPROTO)) from None
        if code != 1:
            raise NotRegisteredError(message)
        return value

    async def service_address(self, name: str) -> tuple[str, int]:
        """Return host and port of the service `name`, or raise NotRegisteredError."""
        uri = await self.master("lookupService", name)
        with contextlib.suppress(ValueError):
            parts = urlsplit(uri)
            if parts.hostname is not None and parts.port is not None:
                return parts.hostname, parts.port
        raise NotRegisteredError(f"expected the address of a service, got {uri!r}")

    async def is_service(self, name: str) -> bool:
        """Return whether the service `name` is registered. All calls that wait for a poll share it."""
        if self._next_poll is None:
            self._next_poll = run_shared(self._poll_services())
        return name in await asyncio.shield(self._next_poll)

    async def _poll_services(self) -> set[str]:
        clock = asyncio.get_running_loop().time
        async with self._poll_lock:
            await asyncio.sleep(self._polled_at + POLL_SECONDS - clock())
            self._next_poll, self._polled_at = None, clock()
            return {name for name, _ in (await self.master("getSystemState"))[2]}

    async def topics(self) -> dict[str, str]:
        """Return all published topics with their types."""
        return dict(await self.master("getPublishedTopics", ""))

    async def published_by(self, instance: str) -> dict[str, str]:
        """Return all topics that the node `instance` publishes, with their types."""
        publishers, _, _ = await self.master("getSystemState")
        types = dict(await self.master("getTopicTypes"))
        return {topic: types.get(topic, "") for topic, nodes in publishers if self.resolve(instance) in nodes}

    async def topic_address(self, topic: str, instance: str) -> tuple[str, int]:
        """Return host and port at which the node `instance` publishes `topic`, or raise NotRegisteredError.

        The answer comes from the node itself.
        """
        known = self._uris.get(instance)
        if known is not None:
            with contextlib.suppress(*_FAILURES):
                return await self._topic_at(known, topic)
        try:
            return await self._topic_at(await self.node_uri(instance), topic)
        except _FAILURES as problem:
            raise middleware_error(f"{instance} does not answer ({_reason(problem)})") from None

    async def _topic_at(self, uri: str, topic: str) -> tuple[str, int]:
        protocol = await self.node(uri, "requestTopic", topic, [["TCPROS"]])
        if len(protocol) != 3 or protocol[0] != "TCPROS":
            raise NotRegisteredError(f"{topic} is not published")
        return str(protocol[1]), int(protocol[2])

    async def node_uri(self, instance: str) -> str:
        """Return and cache the XML-RPC address of the node `instance`, or raise NotRegisteredError."""
        uri = str(await self.master("lookupNode", self.resolve(instance)))
        _remember(self._uris, instance, uri)
        return uri

    def known_address(self, instance: str) -> tuple[str, int] | None:
        """Return the last known address of the services of `instance`."""
        return self._addresses.get(instance)

    def note_reachable(self, instance: str, address: tuple[str, int]) -> None:
        """Cache the address of `instance`; all services of a node have the same address."""
        _remember(self._addresses, instance, address)

    # --- the node in this process ---

    def prepare(self) -> asyncio.Task[None]:
        """Begin to become a node, unless that is in progress or done."""
        if self._node is None or (self._node.done() and (self._node.cancelled() or self._node.exception())):
            self._node = asyncio.create_task(self._start_node())
        return self._node

    async def become_node(self) -> None:
        """Start a rospy node in this process, which actions need; ComponentError if the master does not answer."""
        try:
            await asyncio.wait_for(asyncio.shield(self.prepare()), NODE_SECONDS)
        except TimeoutError:
            raise middleware_error(f"cannot become a node of the graph at {self.uri} in {NODE_SECONDS:g} s") from None

    async def join(self) -> None:
        """Become a node as soon as the master answers."""
        while not (self.is_node or self.gone.is_set()):
            with contextlib.suppress(ComponentError):
                await self.become_node()
                return
            await asyncio.sleep(JOIN_SECONDS)

    async def _start_node(self) -> None:
        await self.master("getPid")  # rospy would wait for the master without a time limit
        import rospy

        from rosafe.ros1.transport import registration

        loop = asyncio.get_running_loop()
        start = functools.partial(
            registration.init_node, self._program, startup.remappings_given(), not self._server, self._server
        )
        try:
            (await asyncio.to_thread(start)).up()
        except (rospy.ROSException, ValueError) as problem:
            if rospy.core.is_shutdown_requested():  # a process can become a node only once
                self.gone.set()
            raise middleware_error(f"cannot become a node: {problem}") from None
        self.is_node, self.name = True, rospy.get_name()
        startup.log_to_stderr()
        rospy.on_shutdown(lambda: loop.is_closed() or loop.call_soon_threadsafe(self.gone.set))


def _remember(cache: dict[str, Any], instance: str, value: Any) -> None:
    cache.pop(instance, None)  # the newest entries are last
    cache[instance] = value
    while len(cache) > MAX_KNOWN:
        del cache[next(iter(cache))]


def _reason(problem: BaseException) -> str:
    if isinstance(problem, asyncio.TimeoutError):
        return "no answer"
    number = getattr(problem, "errno", None)
    return os.strerror(number) if number else type(problem).__name__
