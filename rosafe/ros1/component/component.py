"""A component on the ROS graph, as GenoM generates them: services, actions, ports, genom_state and diagnostics.

This is common to `rosAFE` and `bass`. A node registers its handlers at a `ComponentNode`; names, types and rules come
from the interface table.
"""

from __future__ import annotations

import functools
import importlib
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import rosgraph
import rospy

from rosafe import interface
from rosafe.declarations.text import short_repr
from rosafe.interface import ComponentError
from rosafe.ros1.component.action_server import GoalHandler, StatusPublisher, report_error
from rosafe.ros1.component.activities import (
    STOP_WAIT,
    Activities,
    Activity,
    Handler,
    RequestDispatcher,
    Values,
    unexpected_error,
)
from rosafe.ros1.component.explicit_defaults import has_explicit_defaults, warning_exdetail
from rosafe.ros1.component.state_publisher import Diagnostics, StatePublisher
from rosafe.ros1.transport import master, registration
from rosafe.ros1.transport.publisher import Publisher
from rosafe.tree.health import TaskStatistics

UP_SECONDS = 10.0  # to register a node that starts at the master
SEND_SECONDS = 0.1  # for responses and results: rospy sends them on its own threads, and does not report when


class ComponentNode:
    """The ROS side of a component. Create it after `rospy.init_node`; call `start` when all handlers are registered.

    Parameters
    ----------
    component : ComponentSpec
        The table of the interface.
    bad_value : callable
        Converts the ValueError of a rejected argument to the component's exception.
    """

    def __init__(self, component: interface.ComponentSpec, bad_value: Callable[[ValueError], ComponentError]) -> None:
        self.component = component
        self.name = rospy.get_name()
        self.finished = threading.Event()
        self.activities = Activities(component.tasks, self._state_changed, _log_crash)
        self.meters = {task: TaskStatistics(task) for task in component.tasks}
        self.diagnostics = Diagnostics(self.finished)
        self._state = StatePublisher(component, self.activities, self.meters, self.finished)
        self._dispatcher = RequestDispatcher(component, self.activities, self.finished, bad_value)
        self._registrar = registration.registrar()
        self._statuses = StatusPublisher(self.finished)
        self._connectors: dict[str, Callable[[str], None]] = {}  # by input port
        self._connecting = threading.Lock()
        self.function("connect_port", self._connect_port, waits=True)
        self.function("connect_service", self._connect_service)
        self.function("abort_activity", self._abort_activity)
        self.function("kill", self._kill)

    # --- for the node ---

    def activity(self, name: str, handler: Handler, check: Callable[[Values], Values] | None = None) -> None:
        """Let `handler(activity, values)` serve the activity `name`.

        `check(values)` replaces the interface's check of all values, and raises ComponentError or ValueError. The
        handler has to check the values that `check` does not.
        """
        self._dispatcher.add_activity(name, handler, check)

    def function(self, name: str, handler: Callable[[Values], Values | None], waits: bool = False) -> None:
        """Let `handler(values)` serve the function `name`; it returns the outputs by name, and optionally a `warning`.

        Functions run one at a time, except those that wait (`waits`) for other nodes, such as the master.
        """
        self._dispatcher.add_function(name, handler, waits)

    def input_port(self, name: str, connect: Callable[[str], None]) -> None:
        """Let `connect(topic)` connect the input port `name` to a topic that is published."""
        self._connectors[name] = connect

    def advertise(self, port: str, message_class: Any, element: str = "") -> Publisher:
        """Return the latched publisher of an output port, or of one element of a multiple port.

        It is registered at the master asynchronously: see `settle`.
        """
        topic = f"{self.name}/{self.component.port(port).name}" + (f"/{element}" if element else "")
        return Publisher(topic, message_class)

    def call_service(self, name: str, values: Mapping[str, Any]) -> dict[str, Any]:
        """Execute service `name` with explicit `values`: a zero does not mean the default.

        An activity is running when this returns. Raises ComponentError.
        """
        service = self.component.service(name)
        request = SimpleNamespace(**values)
        if service.activity:
            self._dispatcher.run_activity(service, request, literal=True)
            return {}
        return self._dispatcher.call_function(service, request, literal=True)

    def settle(self) -> None:
        """Wait until all changes are registered at the master, for a limited time, and not for a dead master."""
        self._registrar.settle()

    def start(self) -> None:
        """Offer all services and actions, and start to publish genom_state and /diagnostics."""
        missing = self._dispatcher.unhandled()
        if missing:
            raise RuntimeError(f"no handler for {', '.join(missing)}")
        services, messages = (importlib.import_module(f"{self.component.name}.{kind}") for kind in ("srv", "msg"))
        state = self.advertise("genom_state", messages.genom_state_component)
        for service in self.component.on_graph:
            serve = self._serve_activity if service.activity else self._serve_function
            response = getattr(services, f"{service.name}Response")
            name = f"{self.name}/{service.name}"
            rospy.Service(name, getattr(services, service.name), functools.partial(serve, service, response))
            if service.activity:
                GoalHandler(service, name, messages, self._dispatcher, self._statuses)
        for task in (functools.partial(self._state.run, state), self.diagnostics.run, self._statuses.run):
            threading.Thread(target=task, daemon=True).start()
        self._registrar.settle(UP_SECONDS)

    def shutdown(self, by: str) -> None:
        """End all activities and wait for them for a limited time; `by` is named in their exceptions."""
        self.finished.set()
        self._state.changed()
        self.diagnostics.changed()
        self.activities.interrupt_named((s.name for s in self.component.activities), by, wait=STOP_WAIT)
        time.sleep(SEND_SECONDS)

    # --- services ---

    def _serve_activity(self, service: interface.Service, response: Any, request: Any) -> Any:
        try:
            activity = self._dispatcher.run_activity(service, request, has_explicit_defaults(request))
        except ComponentError as problem:
            return response(False, report_error(service, problem))
        return response(True, warning_exdetail(request, activity.warning))

    def _serve_function(self, service: interface.Service, response: Any, request: Any) -> Any:
        changes = self._registrar.changes
        try:
            outputs = self._dispatcher.call_function(service, request, has_explicit_defaults(request))
        except ComponentError as problem:
            return response(genom_success=False, genom_exdetail=report_error(service, problem))
        except Exception as problem:  # a fault of ours must reach the caller and the log, and not end the node
            rospy.logerr(f"{service.name}: {traceback.format_exc()}")
            return response(genom_success=False, genom_exdetail=unexpected_error(problem).exdetail)
        if self._registrar.changes != changes:
            self._registrar.settle()
        self._state_changed()
        complete = outputs.pop("response", None)  # a handler may create the response itself, with arrays
        if complete is not None:
            return complete
        exdetail = warning_exdetail(request, outputs.pop("warning", ""))
        return response(genom_success=True, genom_exdetail=exdetail, **outputs)

    def _connect_port(self, values: Values) -> None:
        local, remote = values["local"], values["remote"]
        if local not in self._connectors:
            known = ", ".join(sorted(self._connectors)) or "none"
            raise ComponentError("::genom::no_such_inport", f"no input port {short_repr(local)}; there are: {known}")
        if not remote or not rosgraph.names.is_legal_name(remote):
            raise ComponentError("::genom::no_such_outport", f"remote: expected a topic name, got {short_repr(remote)}")
        topic = rospy.resolve_name(remote)
        try:
            published = master.published_topics(master.uri(), self.name)
        except master.MasterError as problem:
            raise ComponentError("::genom::port_io", str(problem)) from None
        if topic not in published:
            raise ComponentError("::genom::no_such_outport", f"{topic} is not published; see `rostopic list`")
        expected = interface.ros_type(self.component.port(local).idl)
        if published[topic].split("/")[-1] not in (expected, "*"):
            raise ComponentError("::genom::port_io", f"{topic}: expected type {expected}, got {published[topic]}")
        with self._connecting:
            self._connectors[local](topic)

    def _connect_service(self, values: Values) -> None:
        raise ComponentError("::genom::no_such_remote", f"{self.component.name} has no remote services")

    def _abort_activity(self, values: Values) -> None:
        self.activities.find(values["activity"]).interrupt("abort_activity")

    def _kill(self, values: Values) -> None:
        threading.Timer(SEND_SECONDS, self.finished.set).start()

    def _state_changed(self) -> None:
        self._state.changed()


def _log_crash(activity: Activity, problem: BaseException) -> None:
    text = "".join(traceback.format_exception(problem))
    rospy.logerr(f"{activity.service.name} (activity {activity.id}): {text}")
