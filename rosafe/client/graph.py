"""The ROS graph as genomixd sees it: the master and nodes by XML-RPC, and a node of its own once one is needed.

All calls are coroutines with a time limit. A master that is away, or comes back empty, is an error while it lasts and
nothing more; where components were reached the last time, they are looked for without it.
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

from rosafe.client.asyncio_tools import run_shared
from rosafe.component import startup
from rosafe.interface import ComponentError

RPC_SECONDS = 3.0  # for one call of the master or of a node
NODE_SECONDS = 15.0  # for becoming a node of the graph
JOIN_SECONDS = 1.0  # between two tries of a server to become one
LOOK_SECONDS = 0.05  # between two looks at what the master knows, however many wait for that
MAX_CALLS = 8  # of the master at once
MAX_ANSWER = 16 * 2**20  # bytes of an answer of the master or a node
MAX_KNOWN = 1000  # components whose addresses are remembered

_FAILURES = (OSError, aiohttp.ClientError, ValueError)  # TimeoutError is an OSError


class NotRegisteredError(Exception):
    """The master, or a node, answered that there is no such thing."""


def middleware_error(what: str) -> ComponentError:
    """The error of a component or master that cannot be reached, or does not answer."""
    return ComponentError("::genom::mwerr", what=what)


class Graph:
    """The graph of the master at `uri`. Make it inside a running event loop; `close` it in the end.

    Parameters
    ----------
    uri : str
    program : str
        What the name of our node begins with, unless roslaunch gives another one.
    server : bool
        Whether `program` is the whole name, if no node of that name runs.
    """

    def __init__(self, uri: str, program: str = "genomixd", server: bool = False) -> None:
        self.uri = uri
        self._program = program
        self._server = server
        self.name = f"/{program}_{os.getpid()}_{int(time.time() * 1000)}"
        self.gone = asyncio.Event()  # set where our node was told to end, as by `rosnode kill`
        self._http = aiohttp.ClientSession(
            connector=aiohttp.TCPConnector(force_close=True, limit=0),
            timeout=aiohttp.ClientTimeout(total=RPC_SECONDS),
        )
        self._node: asyncio.Task[None] | None = None
        self.is_node = False  # set once that has started
        self._calls = asyncio.Semaphore(MAX_CALLS)
        self._look: asyncio.Task[set[str]] | None = None  # the next look at the services, which has not begun yet
        self._looking = asyncio.Lock()
        self._topics_cached_at = 0.0
        self._addresses: dict[str, tuple[str, int]] = {}  # where instances were reached the last time
        self._uris: dict[str, str] = {}  # and their nodes

    async def close(self) -> None:
        """Leave the graph."""
        if self._node is not None:
            self._node.cancel()
        if self.is_node:
            import rospy

            await asyncio.to_thread(rospy.signal_shutdown, f"{self._program} ends")
        await self._http.close()

    # --- XML-RPC ---

    async def master(self, method: str, *arguments: Any) -> Any:
        """The value of the master's `method`; Unknown where it has none, ComponentError where it does not answer."""
        try:
            async with asyncio.timeout(RPC_SECONDS), self._calls:
                return await self.node(self.uri, method, *arguments)
        except _FAILURES as problem:
            raise middleware_error(
                f"no ROS master at {self.uri} ({_reason(problem)}): start roscore first, or set ROS_MASTER_URI"
            ) from None

    async def node(self, uri: str, method: str, *arguments: Any) -> Any:
        """The value of `method` of the node (or master) at `uri`."""
        body = xmlrpc.client.dumps((self.name, *arguments), method)
        text = bytearray()
        async with self._http.post(uri, data=body.encode(), headers={"Content-Type": "text/xml"}) as response:
            async for part in response.content.iter_any():
                text += part
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
        """Host and port of the service `name`, or Unknown."""
        return _address(await self.master("lookupService", name))

    async def serves(self, name: str) -> bool:
        """Whether somebody serves `name`. One look at the master answers all who ask before it begins."""
        if self._look is None:
            self._look = run_shared(self._look_at_services())
        return name in await asyncio.shield(self._look)

    async def _look_at_services(self) -> set[str]:
        clock = asyncio.get_running_loop().time
        async with self._looking:
            await asyncio.sleep(self._topics_cached_at + LOOK_SECONDS - clock())
            self._look, self._topics_cached_at = None, clock()
            return {name for name, _ in (await self.master("getSystemState"))[2]}

    async def topics(self) -> dict[str, str]:
        """All topics that somebody publishes, with their types."""
        return dict(await self.master("getPublishedTopics", ""))

    async def published_by(self, instance: str) -> dict[str, str]:
        """All topics that the node `instance` publishes, with their types."""
        publishers, _, _ = await self.master("getSystemState")
        types = dict(await self.master("getTopicTypes"))
        return {topic: types.get(topic, "") for topic, nodes in publishers if f"/{instance}" in nodes}

    async def topic_address(self, topic: str, instance: str) -> tuple[str, int]:
        """Host and port where the node `instance` gives out `topic`, or Unknown. It is asked itself."""
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
            raise NotRegisteredError(f"nobody gives out {topic}")
        return str(protocol[1]), int(protocol[2])

    async def node_uri(self, instance: str) -> str:
        """Where the node `instance` takes XML-RPC, or Unknown; remembered."""
        uri = str(await self.master("lookupNode", f"/{instance}"))
        _remember(self._uris, instance, uri)
        return uri

    def known_address(self, instance: str) -> tuple[str, int] | None:
        """Where the services of `instance` were reached the last time."""
        return self._addresses.get(instance)

    def note_reachable(self, instance: str, address: tuple[str, int]) -> None:
        """The services of `instance` are there: all of a node are at one address."""
        _remember(self._addresses, instance, address)

    # --- our node ---

    def prepare(self) -> asyncio.Task[None]:
        """Begin to become a node, which takes a moment, unless that is under way or done."""
        if self._node is None or (self._node.done() and (self._node.cancelled() or self._node.exception())):
            self._node = asyncio.create_task(self._start_node())
        return self._node

    async def become_node(self) -> None:
        """Have a rospy node in this process, which actions need; ComponentError where there is no master."""
        try:
            await asyncio.wait_for(asyncio.shield(self.prepare()), NODE_SECONDS)
        except TimeoutError:
            raise middleware_error(f"cannot become a node of the graph at {self.uri} in {NODE_SECONDS:g} s") from None

    async def join(self) -> None:
        """Become a node as soon as there is a master."""
        while not (self.is_node or self.gone.is_set()):
            with contextlib.suppress(ComponentError):
                await self.become_node()
                return
            await asyncio.sleep(JOIN_SECONDS)

    async def _start_node(self) -> None:
        await self.master("getPid")  # rospy would wait for the master without end
        import rospy

        from rosafe.transport import registration

        loop = asyncio.get_running_loop()
        start = functools.partial(
            registration.init_node, self._program, startup.names_given(), not self._server, self._server
        )
        try:
            (await asyncio.to_thread(start)).up()
        except (rospy.ROSException, ValueError) as problem:
            if rospy.core.is_shutdown_requested():  # it cannot become one again
                self.gone.set()
            raise middleware_error(f"cannot become a node: {problem}") from None
        self.is_node, self.name = True, rospy.get_name()
        startup.log_to_stderr()
        rospy.on_shutdown(lambda: loop.is_closed() or loop.call_soon_threadsafe(self.gone.set))


def _remember(book: dict[str, Any], instance: str, value: Any) -> None:
    book.pop(instance, None)  # the newest are last
    book[instance] = value
    while len(book) > MAX_KNOWN:
        del book[next(iter(book))]


def _address(uri: str) -> tuple[str, int]:
    try:
        parts = urlsplit(uri)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if host is None or port is None:
        raise NotRegisteredError(f"{uri!r} is no address of a service")
    return host, port


def _reason(problem: BaseException) -> str:
    if isinstance(problem, asyncio.TimeoutError):
        return "no answer"
    number = getattr(problem, "errno", None)
    return os.strerror(number) if number else type(problem).__name__
