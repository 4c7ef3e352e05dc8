"""Requests of a component: activities, which run until they end, are stopped or are replaced; and the handlers of all.

This module contains no ROS.
"""

from __future__ import annotations

import errno
import itertools
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

from rosafe.declarations.errors import forget_frames
from rosafe.declarations.text import join_names
from rosafe.interface import MAX_ACTIVITIES, ComponentError, ComponentSpec, Service

STOP_WAIT = 2.0  # seconds that Stop waits for the activities that it interrupts

Values = dict[str, Any]
Handler = Callable[["Activity", Values], None]


class Activity:
    """A request in progress.

    Its handler runs in a thread of its own. It calls `running()` when the activity is running, checks
    `stop_requested`, returns at a normal end, and raises ComponentError otherwise.
    """

    def __init__(self, number: int, service: Service, replaced: Callable[[Activity], list[Activity]]) -> None:
        self.id = number
        self.service = service
        self.stop_requested = threading.Event()
        self.stopped_by = ""
        self.error: ComponentError | None = None
        self.warning = ""  # for the client of a request that is accepted; must be set before `running()`
        self.begun = threading.Event()  # running, or ended before (`error` is the reason)
        self.ended = threading.Event()
        self._replaced = replaced

    def running(self) -> None:
        """Mark the activity as running, and notify the threads that wait for this."""
        self.begun.set()

    def interrupt(self, by: str) -> None:
        """Request the activity to end. `by` is the service that requests it; only the first one counts."""
        if not self.stop_requested.is_set():
            self.stopped_by = by
            self.stop_requested.set()

    def interrupt_waiting(self) -> None:
        """Interrupt the activities that this one replaces and that are not running yet."""
        for activity in self._replaced(self):
            if not activity.begun.is_set():
                activity.interrupt(self.service.name)

    def interrupt_others(self) -> None:
        """End all activities that this one replaces, and wait until they have ended."""
        _interrupt_and_wait(self._replaced(self), self.service.name)

    def raise_if_interrupted(self) -> None:
        """Raise ``::genom::interrupted`` if the end was requested. For handlers that have not called `running` yet."""
        if self.stop_requested.is_set():
            raise ComponentError("::genom::interrupted", by=self.stopped_by)


def _interrupt_and_wait(activities: list[Activity], by: str, seconds: float = 1e9) -> None:
    deadline = time.monotonic() + seconds
    for activity in activities:
        activity.interrupt(by)
    for activity in activities:
        activity.ended.wait(max(0.0, deadline - time.monotonic()))


def too_many(task: str) -> ComponentError:
    """The exception of a task that has no slot left."""
    what = f"{task} has {MAX_ACTIVITIES - 1} activities, which is the limit: end some first"
    return ComponentError("::genom::too_many_activities", what)


def unexpected_error(problem: BaseException) -> ComponentError:
    """The exception of a request whose handler failed unexpectedly."""
    return ComponentError("::genom::unkex", what=f"{type(problem).__name__}: {problem}"[:127])


class Activities:
    """All running activities of a component.

    Parameters
    ----------
    tasks : iterable of str
        Names of the component's tasks. Each accepts `MAX_ACTIVITIES` minus its permanent one.
    changed : callable
        Called after each start and end.
    crashed : callable
        Called with (activity, exception) if a handler raises an exception that the interface does not declare.
    """

    def __init__(
        self,
        tasks: Iterable[str],
        changed: Callable[[], None],
        crashed: Callable[[Activity, BaseException], None],
    ) -> None:
        self.tasks = tuple(tasks)
        self._changed = changed
        self._crashed = crashed
        self._numbers = itertools.count(1)
        self._live: dict[int, Activity] = {}
        self._lock = threading.RLock()

    def start(
        self, service: Service, handler: Handler, values: Values, on_end: Callable[[Activity], None] | None
    ) -> Activity:
        """Start an activity. Its thread calls `on_end` at its end, before threads that wait for the end continue.

        Raises ``::genom::too_many_activities`` if the limit of its task is reached, and ``::genom::syserr`` (EAGAIN) if
        the system cannot start a thread.
        """
        with self._lock:
            if self.full(service):
                raise too_many(service.task)
            activity = Activity(next(self._numbers) % 2**32, service, self._replaced)
            self._live[activity.id] = activity
        thread = threading.Thread(
            target=self._run,
            args=(activity, handler, values, on_end),
            name=f"{service.name}-{activity.id}",
            daemon=True,
        )
        try:
            thread.start()
        except RuntimeError as problem:
            with self._lock:
                del self._live[activity.id]
            raise ComponentError("::genom::syserr", str(problem), code=errno.EAGAIN) from None
        return activity

    def full(self, service: Service) -> bool:
        """Return whether the task of `service` has reached its limit."""
        with self._lock:
            return sum(a.service.task == service.task for a in self._live.values()) >= MAX_ACTIVITIES - 1

    def _run(
        self,
        activity: Activity,
        handler: Handler,
        values: Values,
        on_end: Callable[[Activity], None] | None,
    ) -> None:
        self._changed()
        error: ComponentError | None = None
        try:
            activity.raise_if_interrupted()
            handler(activity, values)
        except ComponentError as problem:
            error = problem
        except MemoryError as problem:
            self._crashed(activity, problem)
            error = ComponentError("::genom::syserr", "there is not enough memory for it", code=errno.ENOMEM)
        except Exception as problem:  # a fault of ours: the node continues; it is reported to the client and the log
            self._crashed(activity, problem)
            error = unexpected_error(problem)
        with self._lock:
            del self._live[activity.id]
        if error is not None:
            forget_frames(error)
        activity.error = error
        activity.begun.set()
        try:
            if on_end is not None:
                on_end(activity)
        finally:  # after the client has been notified
            activity.ended.set()
            self._changed()

    def _replaced(self, newcomer: Activity) -> list[Activity]:
        return [a for a in self.live() if a.id < newcomer.id and a.service.name in newcomer.service.interrupts]

    def live(self) -> list[Activity]:
        """Return the running activities in the order of their numbers."""
        with self._lock:
            return sorted(self._live.values(), key=lambda a: a.id)

    def find(self, number: int) -> Activity:
        """Return the running activity `number`. Raises ``::genom::no_such_activity``."""
        with self._lock:
            try:
                return self._live[number]
            except KeyError:
                known = join_names([str(one) for one in sorted(self._live)])
                raise ComponentError("::genom::no_such_activity", f"no activity {number}; there are: {known}") from None

    def interrupt_named(self, names: Iterable[str], by: str, wait: float) -> None:
        """End the activities of the services `names`, and wait for them up to `wait` seconds in total."""
        services = set(names)
        _interrupt_and_wait([a for a in self.live() if a.service.name in services], by, wait)


# --- handlers ---------------------------------------------------------------------------------------------------


class _ServedRequest(NamedTuple):
    handler: Callable[..., Any]
    check: Callable[[Values], Values]
    lock: AbstractContextManager[Any]  # held while a function runs


class RequestDispatcher:
    """The handlers of a component's requests, and the rules by which they are called.

    Parameters
    ----------
    component : ComponentSpec
        The table of the interface.
    activities : Activities
        The running activities.
    finished : threading.Event
        When it is set, no activity starts any more.
    bad_value : callable
        Converts the ValueError of a rejected argument to the component's exception.
    """

    def __init__(
        self,
        component: ComponentSpec,
        activities: Activities,
        finished: threading.Event,
        bad_value: Callable[[ValueError], ComponentError],
    ) -> None:
        self.activities = activities
        self._component = component
        self._finished = finished
        self._bad_value = bad_value
        self._registered: dict[str, _ServedRequest] = {}
        self._function_lock = threading.Lock()

    def add_activity(self, name: str, handler: Handler, check: Callable[[Values], Values] | None = None) -> None:
        """Let `handler(activity, values)` serve the activity `name`; `check` replaces the interface's check."""
        service = self._component.service(name)
        self._registered[name] = _ServedRequest(handler, check or service.check, nullcontext())

    def add_function(self, name: str, handler: Callable[[Values], Values | None], waits: bool) -> None:
        """Let `handler(values)` serve the function `name`. Only those that wait for other nodes run concurrently."""
        lock = nullcontext() if waits else self._function_lock
        self._registered[name] = _ServedRequest(handler, self._component.service(name).check, lock)

    def unhandled(self) -> list[str]:
        """Return the names of the services without a handler."""
        return sorted({service.name for service in self._component.on_graph} - self._registered.keys())

    def start(
        self, service: Service, request: Any, literal: bool, on_end: Callable[[Activity], None] | None = None
    ) -> Activity:
        """Start an activity. `literal` means that a zero in `request` does not stand for the default."""
        if self._finished.is_set():
            raise ComponentError("::genom::disallowed", "the component is shutting down")
        values = self._checked(service, request, literal)
        return self.activities.start(service, self._registered[service.name].handler, values, on_end)

    def run_activity(self, service: Service, request: Any, literal: bool) -> Activity:
        """Start an activity and return it when it is running."""
        activity = self.start(service, request, literal)
        activity.begun.wait()
        if activity.error is not None:
            raise activity.error
        return activity

    def call_function(self, service: Service, request: Any, literal: bool) -> Values:
        """Return the outputs of a function when the activities that it interrupts have ended."""
        registered = self._registered[service.name]
        with registered.lock:
            outputs = registered.handler(self._checked(service, request, literal)) or {}
        if service.interrupts:
            self.activities.interrupt_named(service.interrupts, service.name, wait=STOP_WAIT)
        return outputs

    def _checked(self, service: Service, request: Any, literal: bool) -> Values:
        try:
            return self._registered[service.name].check(service.from_ros(request, literal))
        except ValueError as problem:
            raise self._bad_value(problem) from None
