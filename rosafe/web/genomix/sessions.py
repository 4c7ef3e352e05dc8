"""Sessions of HTTP clients: their components, requests and event listeners, with limits on number and memory."""

from __future__ import annotations

import asyncio
import errno
import itertools
import logging
import math
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator
from typing import Any, TypeVar

from rosafe.interface import ComponentError
from rosafe.ros1.client.actions import Goal
from rosafe.ros1.client.asyncio_tools import wait_any
from rosafe.ros1.client.component_client import NOTHING, Call, ComponentClient, Value, names
from rosafe.ros1.client.errors import cannot_load, too_many
from rosafe.ros1.client.graph import Graph
from rosafe.web.genomix.formats import Syntax

MAX_SESSIONS = 1000
MAX_REQUESTS = 1000  # kept or in progress, per session
MAX_LISTENERS = 8  # per session
MAX_EVENTS = 10_000  # queued for one listener
MAX_KEPT = 512 * 2**20  # bytes of all requests and their results
MAX_COMPONENTS = 64  # per session
IDLE_SECONDS = 600.0  # from the last request of a session without listeners to its end
LINGER_SECONDS = 10.0  # from the last event listener of a session to its end
UNUSED_SECONDS = 600.0  # during which connections are kept to a component that no session has loaded
DEAD_SECONDS = 60.0  # without an answer, until a component loaded without a session is unloaded
CHECK_SECONDS = 10.0  # between two checks of such components
SWEEP_SECONDS = 1.0
REQUEST_BYTES = 4096  # size of a request without arguments and results
EVENT_BYTES = 65_536  # larger results are not included in events and the status
KEPT_BYTES = 1024  # smaller results remain in queued events
ORDER_SECONDS = 5.0  # maximum time that a request waits for the acknowledgement of the previous one of its session

log = logging.getLogger("genomixd")
T = TypeVar("T")


class Request:
    """One request that a client follows by its id. `status` is ``sent``, ``done`` or ``error``.

    Only activities are `abortable`. `size` is the approximate size of the request in bytes.
    """

    def __init__(self, number: str, abortable: bool = False, size: int = 0) -> None:
        self.id = number
        self.size = REQUEST_BYTES + size
        self.status = "sent"
        self.value: Value = NOTHING
        self.output_size = 0
        self._output_included = True  # in events and the status
        self.error: ComponentError | None = None
        self.warning = ""  # of the component that has accepted the request
        self.acknowledged = asyncio.Event()
        self.finished = asyncio.Event()
        self.forgotten = asyncio.Event()  # no client follows it
        self._abortable = abortable
        self._aborted = False
        self._goal: Goal | None = None

    def abort(self) -> None:
        """Ask the activity to end, or not to begin; ``::genom::syserr`` (EAGAIN) for a function in progress."""
        if self.finished.is_set():
            return
        if not self._abortable:
            why = f"{self.id} is not an activity, and cannot be aborted"
            raise ComponentError("::genom::syserr", why, code=errno.EAGAIN)
        self._aborted = True
        if self._goal is not None:
            self._goal.cancel()

    def raise_if_aborted(self) -> None:
        """Raise ``::genom::interrupted`` if the request was aborted before it was sent."""
        if self._aborted:
            raise ComponentError("::genom::interrupted", by="client")

    def begun(self, goal: Goal) -> None:
        """Note that the component has received the request."""
        self._goal = goal
        if self._aborted:
            goal.cancel()

    def finish(self, value: Value, error: ComponentError | None) -> None:
        """Record the end."""
        self.value, self.error, self.output_size = value, error, value.size
        self.warning = self.warning or value.warning
        self._output_included = self.output_size <= EVENT_BYTES
        self.status = "done" if error is None else "error"
        self.acknowledged.set()
        self.finished.set()

    def drop_output(self) -> None:
        """Free the memory of a large output. Queued events then contain only its size."""
        if self.output_size > KEPT_BYTES:
            self.value, self._output_included = NOTHING, False

    def pieces(self, syntax: Syntax) -> Iterator[Any]:
        """Yield the status: id, status, warning, and output or exception, if there are any."""
        status: dict[str, Any] = {"id": self.id, "status": self.status}
        has_output = self.status == "done" and self._output_included
        if self.warning:
            status["warning"] = self.warning
        if self.error is not None:
            status["exception"] = self.error.body
        elif self.status == "done" and not has_output:
            status["large"] = self.output_size
        members = (syntax.key(index, name) + syntax.plain(value) for index, (name, value) in enumerate(status.items()))
        yield syntax.open("struct")
        yield syntax.join(members)
        if has_output:
            yield syntax.key(len(status), "output")
            yield from syntax.structure(*self.value.content)
        yield syntax.close("struct")


class Session:
    """One client: its loaded components, its requests, and the listeners for its events.

    The requests of a named session are sent in order, each when the previous one is acknowledged, so that a script may
    request a processor and its child without waiting. Clients without a session name share one session, whose requests
    are not ordered.

    `owner` is the address of the client that started the session, `kept` the approximate size of its requests in bytes.
    """

    def __init__(self, name: str, sessions: Sessions, owner: str = "") -> None:
        self.name = name
        self.owner = owner
        self.kept = 0
        self.components: dict[str, ComponentClient] = {}
        self.requests: dict[str, Request] = {}
        self.listeners: list[asyncio.Queue[tuple[str, Any]]] = []
        self.busy = 0  # HTTP requests in progress
        self.used_at = 0.0
        self._detached_running = 0  # requests in progress that the client does not follow
        self._listened = False
        self._sessions = sessions
        self._acknowledged = asyncio.Event()  # the latest request that is sent in order
        self._acknowledged.set()
        self.touch()

    # --- life ---

    def touch(self) -> None:
        """Restart the time until the session expires."""
        self.used_at = asyncio.get_running_loop().time()

    @property
    def idle(self) -> bool:
        """Whether no connection uses it at present."""
        return not (self.busy or self.listeners)

    @property
    def all_finished(self) -> bool:
        """Whether all its requests have ended."""
        return all(request.finished.is_set() for request in self.requests.values())

    @property
    def expired(self) -> bool:
        """Whether the client is presumed to have disconnected.

        A client that polls the status and never listens may be silent while an activity runs.
        """
        linger = LINGER_SECONDS if self._listened else IDLE_SECONDS
        if not self.idle or asyncio.get_running_loop().time() <= self.used_at + linger:
            return False
        return self._listened or self.all_finished

    def listen(self) -> asyncio.Queue[tuple[str, Any]]:
        """Return a queue of all further events: (name, request or text)."""
        if len(self.listeners) >= MAX_LISTENERS:
            raise too_many(f"a session has at most {MAX_LISTENERS} listeners")
        queue: asyncio.Queue[tuple[str, Any]] = asyncio.Queue()
        self.listeners.append(queue)
        self._listened = True
        return queue

    def leave(self, queue: asyncio.Queue[tuple[str, Any]]) -> None:
        """Remove a listener."""
        if queue in self.listeners:
            self.listeners.remove(queue)
        self.touch()

    def notify(self, event: str, data: Any) -> None:
        """Put an event into the queues of all listeners."""
        for queue in self.listeners[:]:
            if queue.qsize() < MAX_EVENTS:
                queue.put_nowait((event, data))
            else:  # the client has stopped reading
                self.listeners.remove(queue)
                queue.put_nowait(("quit", ""))

    async def close(self) -> None:
        """End the session. Its activities continue."""
        self.notify("quit", "")
        for request in list(self.requests.values()):
            self._forget(request)
        self.components.clear()
        await self._sessions.release()

    # --- components ---

    async def load(self, component: str, instance: str, name: str) -> dict[str, Any]:
        """Load a component, under `name` unless that is empty, and return its description."""
        client = await self._sessions.component_client(component, instance)
        name = name or client.instance.strip("/").replace("/", "_")
        if name not in self.components and len(self.components) >= MAX_COMPONENTS:
            await self.unload(next(iter(self.components)))  # its next call loads it again
        self.components[name] = client
        return client.describe(name)

    async def unload(self, name: str) -> None:
        """Unload a component."""
        try:
            del self.components[name]
        except KeyError:
            raise cannot_load(f"{name[:80]!r} is not loaded") from None
        self.notify("unload", {"component": name})
        await self._sessions.release()

    async def component(self, name: str, instance: str) -> ComponentClient:
        """Return the component loaded under `name`; load `instance`, or the one of that name, if it is another one."""
        loaded = self.components.get(name)
        if loaded is None or (instance and self._sessions.graph.resolve(instance.rstrip("/")) != loaded.node):
            await self.load(instance or name, instance, name)
        self.components[name] = client = self.components.pop(name)  # the most recently used one is last
        return client

    # --- requests ---

    async def call(self, call: Call) -> Value:
        """Carry out a request and return its result."""
        return await self._in_order(call, lambda _: call.run())

    def send(self, component: str, call: Call, keep: bool = True, size: int = 0) -> Request:
        """Start a request, which the client follows by its id if `keep` is true.

        `component` is the name in the id, `size` the approximate size of the arguments in bytes.
        """
        request = Request(f"{component}::{next(self._sessions.numbers)}", call.is_activity, size)
        self._add(request, keep)
        self._sessions.keep(asyncio.create_task(self._follow(request, call)))
        return request

    async def _follow(self, request: Request, call: Call) -> None:
        value, error = NOTHING, None
        try:
            value = await self._in_order(call, lambda acknowledged: self._run(request, call, acknowledged))
        except ComponentError as problem:
            error = problem
        except Exception as problem:  # an internal error must not leave the client waiting
            log.exception("request %s", request.id)
            error = ComponentError("::genom::unkex", what=f"{type(problem).__name__}: {problem}"[:127])
        self._finish(request, value, error)

    async def _run(self, request: Request, call: Call, acknowledged: asyncio.Event) -> Value:
        if not call.is_activity:
            return await call.run()
        request.raise_if_aborted()
        goal = await call.start()
        request.begun(goal)
        try:
            await goal.acknowledged.wait()
            request.warning = goal.warning
            request.acknowledged.set()
            acknowledged.set()
            if not goal.ended.is_set() and request.id in self.requests:
                self.notify("request", request)
            await wait_any(goal.ended, request.forgotten)
        finally:
            goal.forget()
        if goal.error is not None:
            raise goal.error
        return call.result(goal)

    async def _in_order(self, call: Call, work: Callable[[asyncio.Event], Coroutine[Any, Any, T]]) -> T:
        """Return the result of `work`, for a named session after its previous request. Ports are read at once.

        `work` may set the event if the request is acknowledged before its end.
        """
        acknowledged = asyncio.Event()
        try:
            if self.name and call.service is not None:
                previous, self._acknowledged = self._acknowledged, acknowledged
                await previous.wait()
                asyncio.get_running_loop().call_later(ORDER_SECONDS, acknowledged.set)
            return await work(acknowledged)
        finally:
            acknowledged.set()

    def request(self, number: str) -> Request:
        """Return the request with the id `number`."""
        try:
            return self.requests[number]
        except KeyError:
            raise ComponentError("::genomix::e_noSuchRequest", what=f"no request {number[:80]!r}") from None

    def clean(self, number: str) -> None:
        """Forget a request; its activity continues."""
        self._forget(self.request(number))

    # --- memory of requests ---

    def _add(self, request: Request, keep: bool = True) -> None:
        while len(self.requests) + self._detached_running >= MAX_REQUESTS:
            if not self.drop_oldest():
                raise too_many(f"a session has at most {MAX_REQUESTS} requests in progress")
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
        self.notify("request", request)
        self._sessions.make_room(request)

    def _forget(self, request: Request) -> None:
        del self.requests[request.id]
        request.forgotten.set()
        if request.finished.is_set():
            self._count_bytes(-request.size)
            request.drop_output()
        else:
            self._detached_running += 1

    def drop_oldest(self, except_for: Request | None = None) -> bool:
        """Forget the oldest finished request `except_for` the given one; return whether there is one."""
        oldest = next((r for r in self.requests.values() if r.finished.is_set() and r is not except_for), None)
        if oldest is not None:
            self._forget(oldest)
        return oldest is not None

    def _count_bytes(self, size: int) -> None:
        self.kept += size
        self._sessions.kept += size


class Sessions:
    """All sessions, and the components that they share. `kept` is the approximate size of all requests in bytes."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.numbers = itertools.count(1)
        self.kept = 0
        self._sessions: dict[str, Session] = {}
        self._clients: dict[str, ComponentClient] = {}  # by instance
        self._tasks: set[asyncio.Task[Any]] = set()
        self.keep(asyncio.create_task(self._expire_loop()))
        self.keep(asyncio.create_task(self._check_components()))

    def keep(self, task: asyncio.Task[Any]) -> None:
        """Keep a reference to a task until it is done, because asyncio does not."""
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # --- sessions ---

    def get(self, name: str, owner: str = "") -> Session:
        """Return the session `name`; create it for the client at the address `owner` if there is none."""
        if name not in self._sessions:
            self._make_place(owner)
            self._sessions[name] = Session(name, self, owner)
        return self._sessions[name]

    def _make_place(self, owner: str) -> None:
        """End an idle session if there are too many: of this client, or otherwise of the one with most sessions."""
        counts = Counter(session.owner for session in self._sessions.values())
        if counts[owner] >= MAX_SESSIONS // 2:
            affected = owner
        elif counts.total() >= MAX_SESSIONS:
            affected = counts.most_common(1)[0][0]
        else:
            return
        idle = [s for s in self._sessions.values() if s.owner == affected and s.idle and s.name]
        idle.sort(key=lambda session: session.used_at)
        if not idle:
            raise too_many(f"{counts[affected]} sessions are open")
        ended = next((session for session in idle if session.all_finished), idle[0])
        del self._sessions[ended.name]
        self.keep(asyncio.create_task(ended.close()))

    async def stop(self, name: str) -> None:
        """End the session `name`, unless it has ended already."""
        session = self._sessions.pop(name, None)
        if session is not None:
            await session.close()

    def make_room(self, request: Request) -> None:
        """Forget results if all together are too large: the oldest of the largest session, except that of `request`.

        Raises ``::genomix::e_tooMany`` if there is not enough memory for a new request.
        """
        new = 0 if request.finished.is_set() else request.size
        if self.kept + new <= MAX_KEPT:
            return
        sessions = set(self._sessions.values())
        while self.kept + new > MAX_KEPT and sessions:
            largest = max(sessions, key=lambda session: session.kept)
            if not largest.drop_oldest(except_for=request):
                sessions.remove(largest)
        if new and self.kept + new > MAX_KEPT:
            raise too_many(f"requests in progress occupy {MAX_KEPT >> 20} MiB")

    # --- components ---

    async def component_client(self, component: str, instance: str) -> ComponentClient:
        """Return the client of a running component, which all sessions share."""
        name, instance = await names(self.graph, component, instance)
        client = self._clients.get(instance)
        if client is None:
            loaded = await ComponentClient.load(self.graph, instance)
            client = self._clients.setdefault(instance, loaded)
        await client.check(name)
        client.prepare()
        return client

    async def release(self) -> None:
        """Close clients that were not loaded in any session for `UNUSED_SECONDS` and have no pending requests."""
        used = {client for session in self._sessions.values() for client in session.components.values()}
        now = asyncio.get_running_loop().time()
        for instance, client in list(self._clients.items()):
            if client in used or client.pending:
                client.used_at = now
            elif now > client.used_at + UNUSED_SECONDS:
                del self._clients[instance]
                await client.close()

    async def _check_components(self) -> None:
        """Unload components that do not answer from the session without a name, which never expires."""
        clock = asyncio.get_running_loop().time
        while True:
            await asyncio.sleep(CHECK_SECONDS)
            session = self._sessions.get("")
            if session is None:
                continue
            for name, client in list(session.components.items()):
                if client.pending or await client.is_reachable():
                    client.answered_at = clock()
                elif clock() > client.answered_at + DEAD_SECONDS and session.components.get(name) is client:
                    client.used_at = -math.inf  # `release` closes it immediately
                    await session.unload(name)

    async def close(self) -> None:
        """End all sessions."""
        for name in list(self._sessions):
            await self.stop(name)
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.gather(*(client.close() for client in self._clients.values()))

    async def _expire_loop(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_SECONDS)
            for name, session in list(self._sessions.items()):
                if session.expired:
                    await self.stop(name)
            await self.release()
