"""Clients and what they asked for: sessions with their components, requests with their results, and events."""

from __future__ import annotations

import asyncio
import errno
import functools
import itertools
import logging
from collections.abc import Awaitable, Callable, Iterator, Mapping
from typing import Any, TypeVar

from rosafe.genomix import packed
from rosafe.genomix.actions import Goal
from rosafe.genomix.graph import Graph
from rosafe.genomix.proxy import NOTHING, Proxy, Value, names
from rosafe.genomix.syntax import Syntax, plain
from rosafe.interface import ComponentError, Service

MAX_SESSIONS = 1000
MAX_REQUESTS = 1000  # kept per session
MAX_LISTENERS = 8  # per session
MAX_EVENTS = 10_000  # waiting for one listener
MAX_KEPT = 512 * 2**20  # bytes of results kept per session
MAX_COMPONENTS = 64  # per session
MAX_LOADING = 8  # at the same time
IDLE_SECONDS = 600.0  # a session without a listener ends so long after its last request
LINGER_SECONDS = 10.0  # a session that lost its last listener ends so long after
SWEEP_SECONDS = 1.0
ORDER_SECONDS = 5.0  # the next request of a session waits at most so long for the one before to be acknowledged
EVENT_BYTES = 65_536  # larger results are not part of events and of the status

log = logging.getLogger("genomixd")
T = TypeVar("T")


class Request:
    """One request that a client follows by its id. `status` is ``sent``, ``done`` or ``error``.

    `abortable` are activities only.
    """

    def __init__(self, number: str, abortable: bool = False) -> None:
        self.id = number
        self.status = "sent"
        self.value: Value = NOTHING
        self.error: ComponentError | None = None
        self.acknowledged = asyncio.Event()
        self.finished = asyncio.Event()
        self.forgotten = asyncio.Event()  # nobody is interested in its end
        self._abortable = abortable
        self._aborted = False
        self._goal: Goal | None = None

    def abort(self) -> None:
        """Ask the activity to end, or not to begin; ``::genom::syserr`` (EAGAIN) for a function under way."""
        if self.finished.is_set():
            return
        if not self._abortable:
            raise ComponentError("::genom::syserr", code=errno.EAGAIN)
        self._aborted = True
        if self._goal is not None:
            self._goal.cancel()

    def may_begin(self) -> None:
        """Raise ``::genom::interrupted`` where the request was aborted before it was sent."""
        if self._aborted:
            raise ComponentError("::genom::interrupted", by="client")

    def begun(self, goal: Goal) -> None:
        """It is in the component's hands."""
        self._goal = goal
        if self._aborted:
            goal.cancel()

    def finish(self, value: Value, error: ComponentError | None) -> None:
        """Record the end."""
        self.value, self.error = value, error
        self.status = "done" if error is None else "error"
        self.acknowledged.set()
        self.finished.set()

    def pieces(self, form: Syntax) -> Iterator[str]:
        """The status as text: id, status, and output or exception once there is one."""
        yield form.open("struct")
        yield form.key(0, "id") + form.string(self.id) + form.key(1, "status") + form.string(self.status)
        if self.error is not None:
            yield form.key(2, "exception") + plain(form, error_body(self.error))
        elif self.status == "done" and self.value.size <= EVENT_BYTES:
            yield form.key(2, "output")
            yield from self.value.pieces(form)
        elif self.status == "done":
            yield form.key(2, "large") + str(self.value.size)
        yield form.close("struct")

    def packed(self) -> Iterator[bytes]:
        """The status as `pieces` tells it, packed."""
        yield packed.STRUCTURE
        yield packed.member("id") + packed.plain(self.id) + packed.member("status") + packed.plain(self.status)
        if self.error is not None:
            yield packed.member("exception") + packed.plain(error_body(self.error))
        elif self.status == "done" and self.value.size <= EVENT_BYTES:
            yield packed.member("output")
            yield from self.value.packed()
        elif self.status == "done":
            yield packed.member("large") + packed.plain(self.value.size)
        yield packed.END


def error_body(error: ComponentError) -> dict[str, Any]:
    """An exception as clients get it."""
    return {"ex": error.ex, **({"detail": error.detail} if error.detail else {})}


class Session:
    """One client: the components it loaded, its requests, and those who listen to its events.

    The requests of a session that has a name go out in order: each once the one before is acknowledged, so that
    a script may ask for a processor and for its child in one breath. Those without a name share one session and wait
    for nobody.
    """

    def __init__(self, name: str, sessions: Sessions) -> None:
        self.name = name
        self.components: dict[str, Proxy] = {}
        self.requests: dict[str, Request] = {}
        self.listeners: list[asyncio.Queue[tuple[str, Any]]] = []
        self.busy = 0  # HTTP requests under way
        self.ends_at = 0.0
        self._listened = False
        self._sessions = sessions
        self._turn = asyncio.Lock()
        self.touch()

    # --- life ---

    def touch(self) -> None:
        """Something happened: the session lives on for a while."""
        linger = LINGER_SECONDS if self._listened else IDLE_SECONDS
        self.ends_at = asyncio.get_running_loop().time() + linger

    @property
    def over(self) -> bool:
        """Whether its client is gone, as far as one can tell.

        One that asks for the status now and then, and never listens, may be quiet as long as an activity runs.
        """
        if self.busy or self.listeners or asyncio.get_running_loop().time() <= self.ends_at:
            return False
        return self._listened or all(request.finished.is_set() for request in self.requests.values())

    def listen(self) -> asyncio.Queue[tuple[str, Any]]:
        """A queue of all events from now on: (name, request or text)."""
        if len(self.listeners) >= MAX_LISTENERS:
            raise too_many(f"a session has at most {MAX_LISTENERS} listeners")
        queue: asyncio.Queue[tuple[str, Any]] = asyncio.Queue()
        self.listeners.append(queue)
        self._listened = True
        return queue

    def leave(self, queue: asyncio.Queue[tuple[str, Any]]) -> None:
        """A listener is gone."""
        if queue in self.listeners:
            self.listeners.remove(queue)
        self.touch()

    def tell(self, event: str, data: Any) -> None:
        """Put an event into the queues of all listeners."""
        for queue in self.listeners[:]:
            if queue.qsize() < MAX_EVENTS:
                queue.put_nowait((event, data))
            else:  # a client that does not read any more
                self.listeners.remove(queue)
                queue.put_nowait(("quit", ""))

    async def close(self) -> None:
        """End the session. Activities that it began go on."""
        self.tell("quit", "")
        for request in self.requests.values():
            request.forgotten.set()
        for name in list(self.components):
            await self.unload(name)

    # --- components ---

    async def load(self, component: str, instance: str, name: str) -> dict[str, Any]:
        """Load a component, under `name` if given, and describe it."""
        proxy = await self._sessions.proxy(component, instance)
        name = name or proxy.instance
        old = self.components.get(name)
        if old is None and len(self.components) >= MAX_COMPONENTS:
            raise too_many(f"a session loads at most {MAX_COMPONENTS} components")
        self.components[name] = proxy
        return proxy.describe(name)

    async def unload(self, name: str) -> None:
        """Forget a component."""
        try:
            del self.components[name]
        except KeyError:
            raise ComponentError("::genomix::e_load", what=f"{name[:80]!r} is not loaded") from None
        self.tell("unload", {"component": name})
        await self._sessions.release()

    async def component(self, name: str, instance: str) -> Proxy:
        """The component loaded under `name`; `instance`, or the one of that name, is loaded if need be."""
        if name not in self.components:
            await self.load(instance or name, instance, name)
        return self.components[name]

    # --- requests ---

    async def call(self, proxy: Proxy, name: str, given: Any, element: str) -> Value:
        """Make a request, or read a port, and wait for what it returns."""
        port = proxy.port(name)
        if port is not None:
            return await proxy.read(port, element)
        service = proxy.service(name)
        values = proxy.arguments(service, given)
        return await self._in_turn(lambda _: proxy.call(service, values))

    def send(self, component: str, proxy: Proxy, name: str, given: Any, element: str, keep: bool) -> Request:
        """Make a request that the client follows by its id, unless it does not want to `keep` it."""
        port = proxy.port(name)
        service = None if port is not None else proxy.service(name)
        values = {} if service is None else proxy.arguments(service, given)
        if keep:
            self._make_room()
        request = Request(f"{component}::{next(self._sessions.numbers)}", service is not None and service.activity)
        if keep:
            self.requests[request.id] = request
        else:
            request.forgotten.set()
        work: Awaitable[Value]
        if service is not None:
            work = self._in_turn(functools.partial(self._serve, request, proxy, service, values))
        else:
            assert port is not None
            work = proxy.read(port, element)
        self._sessions.keep(asyncio.create_task(self._follow(request, work)))
        return request

    async def _follow(self, request: Request, work: Awaitable[Value]) -> None:
        value, error = NOTHING, None
        try:
            value = await work
        except ComponentError as problem:
            error = problem
        except Exception as problem:  # a fault of ours must not leave the client waiting
            log.exception("request %s", request.id)
            error = ComponentError("::genom::unkex", what=f"{type(problem).__name__}: {problem}"[:127])
        request.finish(value, error)
        if request.id in self.requests:
            self.tell("request", request)
            self.drop_large()

    async def _serve(
        self, request: Request, proxy: Proxy, service: Service, values: Mapping[str, Any], turn: _Turn
    ) -> Value:
        if not service.activity:
            return await proxy.call(service, values)
        request.may_begin()
        goal = await proxy.start(service, values)
        request.begun(goal)
        try:
            await goal.acknowledged.wait()
            request.acknowledged.set()
            turn.over()
            if not goal.ended.is_set() and request.id in self.requests:
                self.tell("request", request)
            await _first(goal.ended, request.forgotten)
        finally:
            goal.forget()
        if goal.error is not None:
            raise goal.error
        return NOTHING

    async def _in_turn(self, work: Callable[[_Turn], Awaitable[T]]) -> T:
        turn = _Turn()
        if self.name:
            await self._turn.acquire()
            turn = _Turn(self._turn)
        try:
            return await work(turn)
        finally:
            turn.over()

    def request(self, number: str) -> Request:
        """The request of that id."""
        try:
            return self.requests[number]
        except KeyError:
            raise ComponentError("::genomix::e_noSuchRequest", what=f"no request {number[:80]!r}") from None

    def clean(self, number: str) -> None:
        """Forget a request; what it started goes on."""
        self.request(number).forgotten.set()
        del self.requests[number]

    def _make_room(self) -> None:
        while len(self.requests) >= MAX_REQUESTS:
            oldest = next((r.id for r in self.requests.values() if r.finished.is_set()), None)
            if oldest is None:
                raise too_many(f"a session has at most {MAX_REQUESTS} requests under way")
            del self.requests[oldest]

    def drop_large(self) -> None:
        """Forget the oldest results where all together are too large."""
        large = [(r, r.value.size) for r in self.requests.values() if r.value is not NOTHING]
        excess = sum(size for _, size in large) - MAX_KEPT
        for request, size in large[:-1]:
            if excess <= 0:
                return
            del self.requests[request.id]
            excess -= size


async def _first(*events: asyncio.Event) -> None:
    """Wait until one of the events is set."""
    waits = [asyncio.create_task(event.wait()) for event in events]
    try:
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in waits:
            task.cancel()


class _Turn:
    """A session's right to send, given back once; after a while by itself."""

    def __init__(self, lock: asyncio.Lock | None = None) -> None:
        self._lock = lock
        self._timer = asyncio.get_running_loop().call_later(ORDER_SECONDS, self.over) if lock is not None else None

    def over(self) -> None:
        if self._lock is not None:
            self._lock.release()
            self._lock = None
        if self._timer is not None:
            self._timer.cancel()


def too_many(what: str) -> ComponentError:
    """The error of a bound that is reached."""
    return ComponentError("::genomix::e_tooMany", what=what)


class Sessions:
    """All sessions, and the components that they share."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.numbers = itertools.count(1)
        self._sessions: dict[str, Session] = {}
        self._proxies: dict[str, Proxy] = {}
        self._loading = asyncio.Semaphore(MAX_LOADING)
        self._tasks: set[asyncio.Task[Any]] = set()
        self.keep(asyncio.create_task(self._sweep()))

    def keep(self, task: asyncio.Task[Any]) -> None:
        """Hold a task until it is done; asyncio does not."""
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def get(self, name: str) -> Session:
        """The session `name`, new if need be."""
        if name not in self._sessions:
            if len(self._sessions) >= MAX_SESSIONS:
                raise too_many(f"{MAX_SESSIONS} sessions are open")
            self._sessions[name] = Session(name, self)
        return self._sessions[name]

    async def stop(self, name: str) -> None:
        """End the session `name`; an unknown one has ended already."""
        session = self._sessions.pop(name, None)
        if session is not None:
            await session.close()

    async def proxy(self, component: str, instance: str) -> Proxy:
        """The proxy of a component that runs; the one that is in use, if there is one for the instance."""
        name, instance = names(component, instance)
        if instance not in self._proxies:
            async with self._loading:
                if instance not in self._proxies:
                    self._proxies[instance] = await Proxy.load(self.graph, instance)
        proxy = self._proxies[instance]
        await proxy.check(name)
        self.graph.prepare()
        return proxy

    async def release(self) -> None:
        """Close the proxies that no session has loaded any more, once their last requests are answered."""
        used = {proxy for session in self._sessions.values() for proxy in session.components.values()}
        for instance, proxy in list(self._proxies.items()):
            if proxy not in used and not proxy.pending:
                del self._proxies[instance]
                await proxy.close()

    async def close(self) -> None:
        """End all sessions."""
        for name in list(self._sessions):
            await self.stop(name)
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_SECONDS)
            for name, session in list(self._sessions.items()):
                if session.over:
                    await self.stop(name)
            await self.release()
