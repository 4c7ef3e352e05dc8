"""Sessions without a server and a graph: their duration, number and memory."""

from __future__ import annotations

import asyncio
import gc
import weakref
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
import pytest

from rosafe.interface import BASS, ROSAFE, ComponentError, Service
from rosafe.ros1.client.component_client import ComponentClient, Value
from rosafe.ros1.client.graph import Graph
from rosafe.web.genomix import sessions
from rosafe.web.genomix.formats import JSON
from rosafe.web.genomix.sessions import REQUEST_BYTES, Request, Session, Sessions
from tests.harness import in_loop


class Component(ComponentClient):
    """A bass whose functions return a given number of bytes when `may_answer` is set."""

    def __init__(self) -> None:
        super().__init__(Graph("http://127.0.0.1:9"), BASS, "bass")
        self.may_answer = asyncio.Event()
        self.may_answer.set()
        self.answers: weakref.WeakSet[Value] = weakref.WeakSet()
        self.size = 0
        self.called: list[str] = []

    def arguments(self, service: Service, text_args: Any) -> dict[str, Any]:
        return {}

    async def call(self, service: Service, values: Mapping[str, Any]) -> Value:
        self.called.append(service.name)
        await self.may_answer.wait()
        value = Value(ROSAFE, (("data", "sequence<double>"),), {"data": np.zeros(self.size // 8)})
        self.answers.add(value)
        return value


@asynccontextmanager
async def new_sessions() -> AsyncIterator[tuple[Sessions, Component]]:
    """Provide sessions, and a component."""
    component = Component()
    every = Sessions(component.graph)
    yield every, component
    component.may_answer.set()
    await every.close()
    await component.graph.close()


def send(session: Session, component: Component, keep: bool = True, size: int = 0) -> Request:
    """Send a function that takes `size` bytes of arguments."""
    return session.send("bass", component.prepare_call("ListDevices", {}, ""), keep, size)


async def wait_until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.005)


# --- duration -----------------------------------------------------------------------------------------


@in_loop(new_sessions)
async def test_sessions_end_after_their_clients_have_disconnected(
    every: Sessions, component: Component, /, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sessions, "SWEEP_SECONDS", 0.01)
    monkeypatch.setattr(sessions, "LINGER_SECONDS", 0.05)
    monkeypatch.setattr(sessions, "IDLE_SECONDS", 0.1)
    component.may_answer.clear()
    idle, listening, busy, following = (every.get(name) for name in ("idle", "listening", "busy", "following"))
    queue = listening.listen()
    busy.busy += 1
    request = send(following, component)
    await wait_until(lambda: every.get("idle") is not idle)
    assert every.get("listening") is listening
    assert every.get("busy") is busy
    assert every.get("following") is following
    listening.leave(queue)
    await wait_until(lambda: every.get("listening") is not listening)
    assert every.get("busy") is busy
    component.may_answer.set()
    await request.finished.wait()
    await wait_until(lambda: every.get("following") is not following)


@in_loop(new_sessions)
async def test_a_session_without_listeners_expires_later_than_one_that_listened(
    every: Sessions, component: Component, /
) -> None:
    polling, listened = every.get("polling"), every.get("listened")
    listened.leave(listened.listen())
    for session in (polling, listened):
        session.used_at -= (sessions.LINGER_SECONDS + sessions.IDLE_SECONDS) / 2
    assert (polling.expired, listened.expired) == (False, True)
    polling.used_at -= sessions.IDLE_SECONDS
    assert polling.expired


@in_loop(new_sessions)
async def test_the_longest_idle_session_of_the_largest_client_ends(
    every: Sessions, component: Component, /, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sessions, "MAX_SESSIONS", 8)
    shared, mine = every.get("", "me"), every.get("mine", "me")
    component.may_answer.clear()
    crowd = [every.get("c0", "crowd")]
    send(crowd[0], component)
    crowd += [every.get(f"c{number}", "crowd") for number in range(1, 4)]
    crowd[1].listen()
    crowd[2].touch()  # c3 is idle for longer
    every.get("c4", "crowd")
    assert set(every._sessions) == {"", "mine", "c0", "c1", "c2", "c4"}
    every.get("c5", "crowd")
    assert set(every._sessions) == {"", "mine", "c0", "c1", "c4", "c5"}
    others = [every.get(f"o{number}", "other") for number in range(2)]
    every.get("n", "new")  # it is full now, and the crowd has most
    assert set(every._sessions) == {"", "mine", "c0", "c1", "c5", "o0", "o1", "n"}
    for name in ("c6", "c7"):
        every.get(name, "crowd")
    assert "c0" in every._sessions  # its request has not ended
    for session in (every.get("c7", "crowd"), every.get("c1"), *others, shared, mine):
        session.busy += 1
    every.get("c8", "crowd")
    assert "c0" not in every._sessions  # no finished session is left
    every.get("c8").busy += 1
    send(every.get("c7"), component)
    with pytest.raises(ComponentError, match="sessions are open"):
        for number in range(9, 12):
            every.get(f"c{number}", "crowd").busy += 1
    assert every.get("") is shared and every.get("mine") is mine


# --- memory of requests ---------------------------------------------------------------------------------------


@in_loop(new_sessions)
async def test_unfetched_results_are_limited(
    every: Sessions, component: Component, /, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The oldest results of the largest session are dropped; the newest one remains, whatever its size."""
    monkeypatch.setattr(sessions, "MAX_KEPT", 100_000 + 7 * REQUEST_BYTES)
    one, other = every.get("one"), every.get("other")

    async def result(session: Session, size: int) -> str:
        component.size = size
        request = send(session, component)
        await request.finished.wait()
        await asyncio.sleep(0)
        return request.id

    small = await result(other, 1000)
    first, second, third = [await result(one, 40_000) for _ in range(3)]
    assert list(one.requests) == [second, third]
    huge = await result(other, 1_000_000)
    assert (list(one.requests), list(other.requests)) == ([], [huge])
    assert every.kept == other.kept > 1_000_000
    last = await result(one, 10)
    assert (list(one.requests), list(other.requests)) == ([last], [])
    assert small != first
    one.clean(last)
    assert every.kept == one.kept == other.kept == 0


@in_loop(new_sessions)
async def test_events_keep_no_results(
    every: Sessions, component: Component, /, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Large results are not kept for a listener that does not read; its events contain their size."""
    session = every.get("s")
    deaf = session.listen()
    for component.size in (10, 5000, 100_000):
        request = send(session, component)
        await request.finished.wait()
        await asyncio.sleep(0)
        session.clean(request.id)
    gc.collect()
    assert [value.size for value in component.answers] == [72]
    statuses = ["".join(deaf.get_nowait()[1].pieces(JSON)).partition('"status":')[2] for _ in range(3)]
    assert statuses == ['"done","output":{"data":[0.0]}}', '"done","large":5064}', '"done","large":100064}']


@pytest.mark.parametrize("keep", [True, False])
@in_loop(new_sessions)
async def test_requests_in_progress_are_limited(
    every: Sessions, component: Component, /, monkeypatch: pytest.MonkeyPatch, keep: bool
) -> None:
    """Detached and cleaned requests count until they have ended."""
    monkeypatch.setattr(sessions, "MAX_REQUESTS", 10)
    monkeypatch.setattr(sessions, "MAX_KEPT", 17 * REQUEST_BYTES)
    component.may_answer.clear()
    one, other = every.get("one"), every.get("other")
    for _ in range(10):
        request = send(one, component, keep)
        if keep:
            one.clean(request.id)
    with pytest.raises(ComponentError, match="a session has at most 10 requests in progress"):
        send(one, component, keep)
    for _ in range(6):
        send(other, component, keep)
    with pytest.raises(ComponentError, match="requests in progress occupy"):
        send(other, component, keep, size=REQUEST_BYTES + 1)
    send(other, component, keep)
    with pytest.raises(ComponentError, match="requests in progress occupy"):
        send(every.get("third"), component, keep)
    component.may_answer.set()
    await wait_until(lambda: len(component.called) == 17)
    await wait_until(lambda: every.kept == sum(request.size for request in other.requests.values()))
    assert len(other.requests) == 7 * keep
    send(one, component, keep)


@in_loop(new_sessions)
async def test_requests_in_progress_are_not_forgotten(
    every: Sessions, component: Component, /, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only finished requests are forgotten for new ones."""
    monkeypatch.setattr(sessions, "MAX_REQUESTS", 4)
    session = every.get("")
    component.may_answer.clear()
    running = [send(session, component) for _ in range(3)]
    await wait_until(lambda: len(component.called) == 3)
    component.may_answer = asyncio.Event()
    component.may_answer.set()
    ended = [send(session, component)]
    for _ in range(3):
        await ended[-1].finished.wait()
        ended.append(send(session, component))
    assert list(session.requests.values()) == [*running, ended[-1]]
    await ended[-1].finished.wait()
    component.may_answer.clear()
    running.append(send(session, component))
    with pytest.raises(ComponentError, match="a session has at most 4 requests in progress"):
        send(session, component)
    assert list(session.requests.values()) == running
    for request in running:
        session.request(request.id).forgotten.set()


# --- in which order ---------------------------------------------------------------------------------------------


@in_loop(new_sessions)
async def test_a_request_waits_for_the_previous_one(
    every: Sessions, component: Component, /, monkeypatch: pytest.MonkeyPatch
) -> None:
    for session, called in ((every.get(""), 2), (every.get("named"), 1)):
        component.called.clear()
        component.may_answer.clear()
        requests = [send(session, component) for _ in range(2)]
        for _ in range(50):
            await asyncio.sleep(0)
        assert len(component.called) == called  # requests without a session name are not ordered
        component.may_answer.set()
        for request in requests:
            await request.finished.wait()


@in_loop(new_sessions)
async def test_a_request_waits_for_a_limited_time(
    every: Sessions, component: Component, /, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sessions, "ORDER_SECONDS", 0.1)
    component.may_answer.clear()
    requests = [send(every.get("named"), component) for _ in range(2)]
    await wait_until(lambda: len(component.called) == 2)
    assert not any(request.finished.is_set() for request in requests)


@in_loop(new_sessions)
async def test_requests_of_ended_sessions_are_forgotten(every: Sessions, component: Component, /) -> None:
    component.may_answer.clear()
    session = every.get("s")
    request = send(session, component)
    await every.stop("s")
    assert every.kept == REQUEST_BYTES
    component.may_answer.set()
    await request.finished.wait()
    await wait_until(lambda: every.kept == 0)


@in_loop(new_sessions)
async def test_a_dead_component_without_a_session_is_forgotten(
    every: Sessions, component: Component, /, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also its connections, unless a session has loaded it or it answers again in time."""
    monkeypatch.setattr(sessions, "CHECK_SECONDS", 0.005)
    alive, closed = True, []

    async def is_reachable() -> bool:
        return alive

    async def close() -> None:
        closed.append(True)

    monkeypatch.setattr(component, "is_reachable", is_reachable)
    monkeypatch.setattr(component, "close", close)
    shared, named = every.get(""), every.get("named")
    every._clients["bass"] = shared.components["ears"] = named.components["bass"] = component
    queue = named.listen(), shared.listen()
    before = component.answered_at
    await wait_until(lambda: component.answered_at > before)
    alive = False
    monkeypatch.setattr(sessions, "DEAD_SECONDS", 0.02)
    await wait_until(lambda: not shared.components)
    assert queue[1].get_nowait() == ("unload", {"component": "ears"})
    assert named.components and queue[0].empty() and not closed and every._clients
    shared.components["ears"] = component
    await named.unload("bass")
    await wait_until(lambda: bool(closed))
    assert not (shared.components or every._clients)


# --- events -----------------------------------------------------------------------------------------------------


@in_loop(new_sessions)
async def test_a_listener_that_reads_nothing_is_dropped(
    every: Sessions, _: Component, /, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sessions, "MAX_EVENTS", 3)
    session = every.get("s")
    deaf, attentive = session.listen(), session.listen()
    heard = []
    for number in range(5):
        session.notify("request", number)
        heard.append(attentive.get_nowait())
    assert [deaf.get_nowait() for _ in range(4)] == [("request", 0), ("request", 1), ("request", 2), ("quit", "")]
    assert deaf.empty()
    assert heard == [("request", number) for number in range(5)]
