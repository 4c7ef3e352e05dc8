"""Clients and what they asked for: sessions with their components, requests and listeners, and what these occupy."""

from __future__ import annotations

import asyncio
import functools
import itertools
import logging
import math
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, TypeVar

from rosafe.client.asyncio_tools import wait_any
from rosafe.client.component_client import NOTHING, ComponentClient, Value, names
from rosafe.client.errors import too_many
from rosafe.client.graph import Graph
from rosafe.genomix.activity_request import Request
from rosafe.interface import ComponentError, Service

MAX_SESSIONS = 1000
MAX_REQUESTS = 1000  # kept or under way, per session
MAX_LISTENERS = 8  # per session
MAX_EVENTS = 10_000  # waiting for one listener
MAX_KEPT = 512 * 2**20  # bytes of all requests and their results
MAX_COMPONENTS = 64  # per session
IDLE_SECONDS = 600.0  # a session without a listener ends so long after its last request
LINGER_SECONDS = 10.0  # a session that lost its last listener ends so long after
UNUSED_SECONDS = 600.0  # connections to a component that no session has loaded are kept so long
DEAD_SECONDS = 60.0  # what was loaded without a session is forgotten if it has not answered for so long
CHECK_SECONDS = 10.0  # between two checks of that
SWEEP_SECONDS = 1.0
ORDER_SECONDS = 5.0  # the next request of a session waits at most so long for the one before to be acknowledged

log = logging.getLogger("genomixd")
T = TypeVar("T")


class Session:
    """One client: the components it loaded, its requests, and those who listen to its events.

    The requests of a session that has a name go out in order: each once the one before is acknowledged, so that
    a script may ask for a processor and for its child in one breath. Those without a name share one session and wait
    for nobody.

    `owner` is the address of the client that began it, `kept` about how many bytes its requests occupy.
    """

    def __init__(self, name: str, sessions: Sessions, owner: str = "") -> None:
        self.name = name
        self.owner = owner
        self.kept = 0
        self.components: dict[str, ComponentClient] = {}
        self.requests: dict[str, Request] = {}
        self.listeners: list[asyncio.Queue[tuple[str, Any]]] = []
        self.busy = 0  # HTTP requests under way
        self.used_at = 0.0
        self._detached_running = 0  # requests under way of which nobody wants to know any more
        self._listened = False
        self._sessions = sessions
        self._turn = asyncio.Lock()
        self.touch()

    # --- life ---

    def touch(self) -> None:
        """Something happened: the session lives on for a while."""
        self.used_at = asyncio.get_running_loop().time()

    @property
    def idle(self) -> bool:
        """Whether no connection is about it at this moment."""
        return not (self.busy or self.listeners)

    @property
    def all_finished(self) -> bool:
        """Whether all its requests have ended."""
        return all(request.finished.is_set() for request in self.requests.values())

    @property
    def expired(self) -> bool:
        """Whether its client is gone, as far as one can tell.

        One that asks for the status now and then, and never listens, may be quiet as long as an activity runs.
        """
        linger = LINGER_SECONDS if self._listened else IDLE_SECONDS
        if not self.idle or asyncio.get_running_loop().time() <= self.used_at + linger:
            return False
        return self._listened or self.all_finished

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
        for request in list(self.requests.values()):
            self._forget(request)
        self.components.clear()
        await self._sessions.release()

    # --- components ---

    async def load(self, component: str, instance: str, name: str) -> dict[str, Any]:
        """Load a component, under `name` if given, and describe it."""
        proxy = await self._sessions.proxy(component, instance)
        name = name or proxy.instance
        old = self.components.get(name)
        if old is None and len(self.components) >= MAX_COMPONENTS:
            await self.unload(next(iter(self.components)))  # the next call of it loads it again
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

    async def component(self, name: str, instance: str) -> ComponentClient:
        """The component loaded under `name`; `instance`, or the one of that name, is loaded if need be."""
        if name not in self.components:
            await self.load(instance or name, instance, name)
        self.components[name] = proxy = self.components.pop(name)  # the one that was used last is last
        return proxy

    # --- requests ---

    async def call(self, proxy: ComponentClient, name: str, given: Any, element: str) -> Value:
        """Make a request, or read a port, and wait for what it returns."""
        port = proxy.port(name)
        if port is not None:
            return await proxy.read(port, element)
        service = proxy.service(name)
        values = proxy.arguments(service, given)
        return await self._in_turn(lambda _: proxy.call(service, values))

    def send(
        self,
        component: str,
        proxy: ComponentClient,
        name: str,
        given: Any,
        element: str,
        keep: bool = True,
        size: int = 0,
    ) -> Request:
        """Make a request that the client follows by its id, unless it does not want to `keep` it.

        `size` is about how many bytes its arguments occupy.
        """
        port = proxy.port(name)
        service = None if port is not None else proxy.service(name)
        values = {} if service is None else proxy.arguments(service, given)
        abortable = service is not None and service.activity
        request = Request(f"{component}::{next(self._sessions.numbers)}", abortable, size)
        self._add(request, keep)
        work: Callable[[], Awaitable[Value]]
        if service is not None:
            serve = functools.partial(self._serve, request, proxy, service, values)
            work = functools.partial[Awaitable[Value]](self._in_turn, serve)
        else:
            assert port is not None
            work = functools.partial(proxy.read, port, element)
        self._sessions.keep(asyncio.create_task(self._follow(request, work)))
        return request

    async def _follow(self, request: Request, work: Callable[[], Awaitable[Value]]) -> None:
        value, error = NOTHING, None
        try:
            value = await work()
        except ComponentError as problem:
            error = problem
        except Exception as problem:  # a fault of ours must not leave the client waiting
            log.exception("request %s", request.id)
            error = ComponentError("::genom::unkex", what=f"{type(problem).__name__}: {problem}"[:127])
        self._finish(request, value, error)

    async def _serve(
        self, request: Request, proxy: ComponentClient, service: Service, values: Mapping[str, Any], turn: _SendOrder
    ) -> Value:
        if not service.activity:
            return await proxy.call(service, values)
        request.raise_if_aborted()
        goal = await proxy.start(service, values)
        request.begun(goal)
        try:
            await goal.acknowledged.wait()
            request.warning = goal.warning
            request.acknowledged.set()
            turn.over()
            if not goal.ended.is_set() and request.id in self.requests:
                self.tell("request", request)
            await wait_any(goal.ended, request.forgotten)
        finally:
            goal.forget()
        if goal.error is not None:
            raise goal.error
        return proxy.result(service, goal)

    async def _in_turn(self, work: Callable[[_SendOrder], Awaitable[T]]) -> T:
        turn = _SendOrder()
        if self.name:
            await self._turn.acquire()
            turn = _SendOrder(self._turn)
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
        self._forget(self.request(number))

    # --- what requests occupy ---

    def _add(self, request: Request, keep: bool = True) -> None:
        while len(self.requests) + self._detached_running >= MAX_REQUESTS:
            if not self.drop_oldest():
                raise too_many(f"a session has at most {MAX_REQUESTS} requests under way")
        self._sessions.make_room(request)
        self._count_bytes(request.size)
        if keep:
            self.requests[request.id] = request
        else:
            self._detached_running += 1
            request.forgotten.set()

    def _finish(self, request: Request, value: Value, error: ComponentError | None) -> None:
        request.finish(value, error)
        if request.id not in self.requests:
            self._detached_running -= 1
            self._count_bytes(-request.size)
            return
        request.size += value.size
        self._count_bytes(value.size)
        self.tell("request", request)
        self._sessions.make_room(request)

    def _forget(self, request: Request) -> None:
        del self.requests[request.id]
        request.forgotten.set()
        if request.finished.is_set():
            self._count_bytes(-request.size)
            request.drop_output()
        else:
            self._detached_running += 1

    def drop_oldest(self, but: Request | None = None) -> bool:
        """Forget the oldest request that has ended, if there is one `but` the given one."""
        oldest = next((r for r in self.requests.values() if r.finished.is_set() and r is not but), None)
        if oldest is not None:
            self._forget(oldest)
        return oldest is not None

    def _count_bytes(self, size: int) -> None:
        self.kept += size
        self._sessions.kept += size


class _SendOrder:
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


class Sessions:
    """All sessions, and the components that they share. `kept` is about how many bytes all requests occupy."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.numbers = itertools.count(1)
        self.kept = 0
        self._sessions: dict[str, Session] = {}
        self._proxies: dict[str, ComponentClient] = {}
        self._tasks: set[asyncio.Task[Any]] = set()
        self.keep(asyncio.create_task(self._expire_loop()))
        self.keep(asyncio.create_task(self._check_components()))

    def keep(self, task: asyncio.Task[Any]) -> None:
        """Hold a task until it is done; asyncio does not."""
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # --- sessions ---

    def get(self, name: str, owner: str = "") -> Session:
        """The session `name`, new if need be, and then of the client at the address `owner`."""
        if name not in self._sessions:
            self._make_place(owner)
            self._sessions[name] = Session(name, self, owner)
        return self._sessions[name]

    def _make_place(self, owner: str) -> None:
        """End an idle session where there are too many: of this client, or else of the one that has most."""
        counts = Counter(session.owner for session in self._sessions.values())
        if counts[owner] >= MAX_SESSIONS // 2:
            crowd = owner
        elif counts.total() >= MAX_SESSIONS:
            crowd = counts.most_common(1)[0][0]
        else:
            return
        idle = [s for s in self._sessions.values() if s.owner == crowd and s.idle and s.name]
        idle.sort(key=lambda session: session.used_at)
        if not idle:
            raise too_many(f"{counts[crowd]} sessions are open")
        given_up = next((session for session in idle if session.all_finished), idle[0])
        del self._sessions[given_up.name]
        self.keep(asyncio.create_task(given_up.close()))

    async def stop(self, name: str) -> None:
        """End the session `name`; an unknown one has ended already."""
        session = self._sessions.pop(name, None)
        if session is not None:
            await session.close()

    def make_room(self, request: Request) -> None:
        """Forget results where all together are too large: the oldest of the session that has most, but not this one.

        ``::genomix::e_tooMany`` where there is no room for a new one.
        """
        new = 0 if request.finished.is_set() else request.size
        if self.kept + new <= MAX_KEPT:
            return
        sessions = set(self._sessions.values())
        while self.kept + new > MAX_KEPT and sessions:
            largest = max(sessions, key=lambda session: session.kept)
            if not largest.drop_oldest(but=request):
                sessions.remove(largest)
        if new and self.kept + new > MAX_KEPT:
            raise too_many(f"requests under way take {MAX_KEPT >> 20} MiB")

    # --- components ---

    async def proxy(self, component: str, instance: str) -> ComponentClient:
        """The proxy of a component that runs; the one that is in use, if there is one for the instance."""
        name, instance = names(component, instance)
        proxy = self._proxies.get(instance)
        if proxy is None:
            found = await ComponentClient.load(self.graph, instance)
            proxy = self._proxies.setdefault(instance, found)
        await proxy.check(name)
        proxy.prepare()
        return proxy

    async def release(self) -> None:
        """Close the proxies that no session has had loaded for long, once their last requests are answered."""
        used = {proxy for session in self._sessions.values() for proxy in session.components.values()}
        now = asyncio.get_running_loop().time()
        for instance, proxy in list(self._proxies.items()):
            if proxy in used or proxy.pending:
                proxy.used_at = now
            elif now > proxy.used_at + UNUSED_SECONDS:
                del self._proxies[instance]
                await proxy.close()

    async def _check_components(self) -> None:
        """Unload dead components from the session without a name, which never ends."""
        clock = asyncio.get_running_loop().time
        while True:
            await asyncio.sleep(CHECK_SECONDS)
            session = self._sessions.get("")
            if session is None:
                continue
            for name, proxy in list(session.components.items()):
                if proxy.pending or await proxy.is_reachable():
                    proxy.answered_at = clock()
                elif clock() > proxy.answered_at + DEAD_SECONDS and session.components.get(name) is proxy:
                    proxy.used_at = -math.inf  # `release` closes it at once
                    await session.unload(name)

    async def close(self) -> None:
        """End all sessions."""
        for name in list(self._sessions):
            await self.stop(name)
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.gather(*(proxy.close() for proxy in self._proxies.values()))

    async def _expire_loop(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_SECONDS)
            for name, session in list(self._sessions.items()):
                if session.expired:
                    await self.stop(name)
            await self.release()
