"""Activities: requests that live until they end, are stopped or are replaced. No ROS in here."""

from __future__ import annotations

import errno
import itertools
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

from rosafe.declarations.text import join_names
from rosafe.interface import MAX_ACTIVITIES, ComponentError, Service

Handler = Callable[["Activity", dict[str, Any]], None]

LOAD_SECONDS = 1.0  # the load is that of so much time at least; over less, one cycle would look like overload


class Activity:
    """One request under way.

    Its handler runs in a thread of its own, says `running()` once it does what it was asked for, watches
    `stop_requested`, returns for a normal end and raises ComponentError for any other.
    """

    def __init__(self, number: int, service: Service, replaced: Callable[[Activity], list[Activity]]) -> None:
        self.id = number
        self.service = service
        self.stop_requested = threading.Event()
        self.stopped_by = ""
        self.error: ComponentError | None = None
        self.warning = ""  # for the requester, where it is granted all the same; to be set before it is `running`
        self.begun = threading.Event()  # running, or ended without (`error` tells why)
        self.ended = threading.Event()
        self._replaced = replaced

    def running(self) -> None:
        """Tell those who wait for it that the activity does what was asked for."""
        self.begun.set()

    def interrupt(self, by: str) -> None:
        """Ask the activity to end; `by` is the service that did so (the first one counts)."""
        if not self.stop_requested.is_set():
            self.stopped_by = by
            self.stop_requested.set()

    def interrupt_waiting(self) -> None:
        """Interrupt those activities that this one replaces which do not run yet."""
        for activity in self._replaced(self):
            if not activity.begun.is_set():
                activity.interrupt(self.service.name)

    def interrupt_others(self) -> None:
        """End all activities that this one replaces, and wait until they have ended."""
        replaced = self._replaced(self)
        for activity in replaced:
            activity.interrupt(self.service.name)
        for activity in replaced:
            activity.ended.wait()

    def raise_if_interrupted(self) -> None:
        """For handlers that have not come to `running` yet: ``::genom::interrupted`` where they were told to end."""
        if self.stop_requested.is_set():
            raise ComponentError("::genom::interrupted", by=self.stopped_by)


def too_many(task: str) -> ComponentError:
    """The exception of a task that has no slot left."""
    what = f"{task} has {MAX_ACTIVITIES - 1} activities, as many as it takes: end some first"
    return ComponentError("::genom::too_many_activities", what)


class TaskStatistics:
    """What one task of the component measured of itself: cycles, their duration, and its load.

    The load is the time spent in cycles per time gone by; several processors of one task can make it more than 1.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.cycles = 0
        self.last = self.longest = self.total = 0.0
        self.load = self.load_max = 0.0
        self._busy = 0.0
        self._since = self._start = time.monotonic()
        self._busy_total = 0.0
        self._lock = threading.Lock()

    def cycle(self, seconds: float) -> None:
        """Count one cycle of work that took `seconds`."""
        with self._lock:
            self.cycles += 1
            self.last = seconds
            self.longest = max(self.longest, seconds)
            self.total += seconds
            self._busy += seconds
            self._busy_total += seconds

    def snapshot(self) -> dict[str, Any]:
        """The `rusage` member of genom_state: timings in seconds, and the load of the last second or so."""
        with self._lock:
            now = time.monotonic()
            if now - self._since >= LOAD_SECONDS:
                self.load = self._busy / (now - self._since)
                self.load_max = max(self.load_max, self.load)
                self._busy, self._since = 0.0, now
            average = self.total / self.cycles if self.cycles else 0.0
            return {
                "cycles": self.cycles % 2**32,
                "timings": {"last": self.last, "max": self.longest, "avg": average},
                "load": {
                    "last": self.load,
                    "max": self.load_max,
                    "avg": self._busy_total / max(now - self._start, 1e-9),
                },
            }


class Activities:
    """All live activities of one component.

    Parameters
    ----------
    tasks : iterable of str
        Names of the component's tasks; each takes `MAX_ACTIVITIES` less its permanent one.
    changed : callable
        Called after every beginning and end.
    crashed : callable
        Called with (activity, exception) where a handler failed in a way that no interface exception names.
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
        self._lock = threading.Lock()

    def start(
        self, service: Service, handler: Handler, values: dict[str, Any], on_end: Callable[[Activity], None] | None
    ) -> Activity:
        """Begin an activity; its thread calls `on_end` at its end, before anybody who waits for that goes on.

        Raises ``::genom::too_many_activities`` where its task has no slot left, and ``::genom::syserr`` (EAGAIN) where
        the system has no thread left.
        """
        with self._lock:
            if self._full(service):
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

    def _full(self, service: Service) -> bool:
        return sum(a.service.task == service.task for a in self._live.values()) >= MAX_ACTIVITIES - 1

    def full(self, service: Service) -> bool:
        """Whether the task of `service` has no slot left."""
        with self._lock:
            return self._full(service)

    def _run(
        self,
        activity: Activity,
        handler: Handler,
        values: dict[str, Any],
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
        except Exception as problem:  # a fault of ours: the node lives on, the requester and the log are told
            self._crashed(activity, problem)
            error = ComponentError("::genom::unkex", what=f"{type(problem).__name__}: {problem}"[:127])
        with self._lock:
            del self._live[activity.id]
        activity.error = error
        activity.begun.set()
        try:
            if on_end is not None:
                on_end(activity)
        finally:  # whoever waits for the end finds that the requester was told
            activity.ended.set()
            self._changed()

    def _replaced(self, newcomer: Activity) -> list[Activity]:
        return [a for a in self.live() if a.id < newcomer.id and a.service.name in newcomer.service.interrupts]

    def live(self) -> list[Activity]:
        """The live activities in the order of their numbers."""
        with self._lock:
            return sorted(self._live.values(), key=lambda a: a.id)

    def find(self, number: int) -> Activity:
        """The live activity `number`, or ``::genom::no_such_activity``."""
        with self._lock:
            try:
                return self._live[number]
            except KeyError:
                known = join_names([str(one) for one in sorted(self._live)])
                raise ComponentError("::genom::no_such_activity", f"no activity {number}; there are: {known}") from None

    def interrupt(self, which: Iterable[Activity], by: str) -> None:
        """Ask each of `which` to end."""
        for activity in which:
            activity.interrupt(by)

    def interrupt_named(self, names: Iterable[str], by: str, wait: float) -> None:
        """End the activities of the services `names`, and wait for them up to `wait` seconds in all."""
        wanted = set(names)
        chosen = [a for a in self.live() if a.service.name in wanted]
        self.interrupt(chosen, by)
        deadline = time.monotonic() + wait
        for activity in chosen:
            activity.ended.wait(max(0.0, deadline - time.monotonic()))
