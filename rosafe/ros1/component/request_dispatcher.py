"""Dispatch of requests to the handlers of a component, for services, actions and calls from within the node."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import rospy

from rosafe.interface import ComponentError, ComponentSpec, Service
from rosafe.ros1.component.activities import Activities, Activity, Handler

STOP_WAIT = 2.0  # seconds that Stop waits for the activities that it interrupts

Values = dict[str, Any]


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


def report_error(service: Service, problem: ComponentError) -> str:
    """Log the error of a request, and return its exdetail for the client."""
    rospy.logwarn(f"{service.name}: {problem.ex}" + (f": {problem}" if str(problem) != problem.ex else ""))
    return problem.exdetail
