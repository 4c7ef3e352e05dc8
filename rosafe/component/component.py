"""A component on the ROS graph, as GenoM makes them: services, actions, ports, genom_state and diagnostics.

Everything that `rosAFE` and `bass` have in common. A node gives its handlers to `ComponentNode`; names, types and
rules come from the interface table.
"""

from __future__ import annotations

import hashlib
import importlib
import itertools
import os
import re
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from types import SimpleNamespace
from typing import Any

import diagnostic_updater
import rosgraph
import rospy
from actionlib_msgs.msg import GoalStatus

from rosafe import interface
from rosafe.component import explicit_defaults, malloc_tuning
from rosafe.component.action_server import StatusPublisher
from rosafe.component.activities import Activities, Activity, Handler, TaskStatistics, too_many
from rosafe.declarations.parameter import short_repr
from rosafe.interface import ComponentError
from rosafe.transport import master, registration
from rosafe.transport.publisher import Publisher
from rosafe.transport.self_check import SelfCheck
from rosafe.version import VERSION

STATE_PERIOD = 0.9  # seconds between two genom_state messages at the most; the contract is 1
BURST_SECONDS = 0.005  # what changes within this makes one message, not one each
DIAGNOSTICS_PERIOD = 1.0  # s; sooner if there is news
DIAGNOSTICS_PAUSE = 0.1  # s between two messages at least
TRIM_ROUNDS = 20  # of diagnostics between two times that freed memory is given back to the system
UP_SECONDS = 10.0  # until the master knows a node that starts
ACCEPT_SECONDS = 2.0  # a goal is accepted once its activity runs, or after this: longer than InputProc waits for sound
STOP_WAIT = 2.0  # seconds that Stop waits for what it ends
SEND_SECONDS = 0.1  # rospy sends answers and results on threads of its own, and does not tell when it has


class ComponentNode:
    """The ROS side of one component. Make it after `rospy.init_node`; call `start` once all handlers are in.

    Parameters
    ----------
    component : interface.Component
        The table to follow.
    bad_value : callable
        Turns the ValueError of a refused argument into the component's exception.
    """

    def __init__(self, component: interface.ComponentSpec, bad_value: Callable[[ValueError], ComponentError]) -> None:
        self.component = component
        self.name = rospy.get_name()
        self.finished = threading.Event()
        self.activities = Activities(component.tasks, self._state_changed, self._log_crash)
        self.meters = {task: TaskStatistics(task) for task in component.tasks}
        self.diagnostics = diagnostic_updater.Updater()
        self.diagnostics.setHardwareID("none")
        self._pulse = SelfCheck(self.finished)
        self.diagnostics.add("calls", self._pulse.health)
        self._bad_value = bad_value
        self._srv = importlib.import_module(f"{component.name}.srv")
        self._msg = importlib.import_module(f"{component.name}.msg")
        self._handlers: dict[str, Callable[..., Any]] = {}
        self._checks: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {}
        self._connectors: dict[str, Callable[[str], None]] = {}
        self._registrar = registration.registrar()
        self._turns: dict[str, AbstractContextManager[Any]] = {}  # of each function
        self._control = threading.Lock()
        self._connecting = threading.Lock()
        self._turn = threading.Event()
        self._health_changed = threading.Event()
        self._keep_alive_references: list[Any] = []  # services, alive as long as the node
        self._actions = StatusPublisher(self.finished)
        self._digest = _digest(component)
        self.function("connect_port", self._connect_port, waits=True)
        self.function("connect_service", self._connect_service)
        self.function("abort_activity", self._abort_activity)
        self.function("kill", self._kill)

    # --- for the node ---

    def activity(
        self, name: str, handler: Handler, check: Callable[[dict[str, Any]], dict[str, Any]] | None = None
    ) -> None:
        """Let `handler(activity, values)` serve the activity request `name`.

        `check(values)` stands in the place of the interface's own check of all values: what is not checked there is
        for the handler to check. It raises ComponentError or ValueError.
        """
        service = self.component.service(name)
        self._handlers[service.name] = handler
        self._checks[service.name] = check or service.check

    def function(
        self, name: str, handler: Callable[[dict[str, Any]], dict[str, Any] | None], waits: bool = False
    ) -> None:
        """Let `handler(values)` serve the function `name`; it returns the outputs by name, and perhaps a `warning`.

        Functions run one at a time, but for those that `waits` for others, such as the master: nobody waits for them.
        """
        service = self.component.service(name)
        self._handlers[service.name] = handler
        self._checks[service.name] = service.check
        self._turns[name] = self._control
        if waits:
            self._turns[name] = nullcontext()

    def input_port(self, name: str, connect: Callable[[str], None]) -> None:
        """Let `connect(topic)` take the input port `name` to a topic that is known to be published."""
        self._connectors[name] = connect

    def advertise(self, port: str, message_class: Any, element: str = "") -> rospy.Publisher:
        """The latched publisher of an output port, or of one element of a multiple port.

        The master is told of it by and by: see `settle`.
        """
        topic = f"{self.name}/{self.component.port(port).name}" + (f"/{element}" if element else "")
        return Publisher(topic, message_class)

    def call_service(self, name: str, values: Mapping[str, Any]) -> dict[str, Any]:
        """Do what a client asks for who means all `values` as they are; an activity runs when this returns.

        Raises ComponentError.
        """
        service = self.component.service(name)
        request = SimpleNamespace(**values)
        if service.activity:
            self._run(service, request, literal=True)
            return {}
        return self._answer(service, request, literal=True)

    def settle(self) -> None:
        """Wait until the master knows what was advertised and withdrawn, but not long, and not for a dead one."""
        self._registrar.settle()

    def start(self) -> None:
        """Offer all services and actions, and publish genom_state from now on."""
        missing = {s.name for s in self.component.on_graph} - set(self._handlers)
        if missing:
            raise RuntimeError(f"no handler for {', '.join(sorted(missing))}")
        self._state = self.advertise("genom_state", self._msg.genom_state_component)
        for service in self.component.on_graph:
            serve = self._serve_activity if service.activity else self._serve_function
            self._keep_alive_references.append(
                rospy.Service(
                    f"{self.name}/{service.name}",
                    getattr(self._srv, service.name),
                    lambda request, service=service, serve=serve: serve(service, request),
                )
            )
            if service.activity:
                self._serve_action(service)
        for task in (self._publish_state, self._publish_diagnostics, self._actions.run):
            threading.Thread(target=task, daemon=True).start()
        self._registrar.settle(UP_SECONDS)
        self._pulse.start()

    def shutdown(self, by: str) -> None:
        """End all activities and wait for them (bounded); `by` is what their exceptions name."""
        self.finished.set()
        self._turn.set()
        self._health_changed.set()
        self.activities.interrupt_named((s.name for s in self.component.activities), by, wait=STOP_WAIT)
        time.sleep(SEND_SECONDS)

    # --- requests ---

    def _values(self, service: interface.Service, request: Any, literal: bool) -> dict[str, Any]:
        try:
            return self._checks[service.name](service.from_ros(request, literal))
        except ValueError as problem:
            raise self._bad_value(problem) from None

    def _begin(
        self,
        service: interface.Service,
        request: Any,
        literal: bool,
        on_end: Callable[[Activity], None] | None = None,
    ) -> Activity:
        if self.finished.is_set():
            raise ComponentError("::genom::disallowed", "the component is shutting down")
        values = self._values(service, request, literal)
        return self.activities.start(service, self._handlers[service.name], values, on_end)

    def _run(self, service: interface.Service, request: Any, literal: bool) -> Activity:
        """The activity, once it runs."""
        activity = self._begin(service, request, literal)
        activity.begun.wait()
        if activity.error is not None:
            raise activity.error
        return activity

    def _answer(self, service: interface.Service, request: Any, literal: bool) -> dict[str, Any]:
        """The outputs of a function, once what it interrupts has ended."""
        with self._turns[service.name]:
            outputs = self._handlers[service.name](self._values(service, request, literal)) or {}
        if service.interrupts:
            self.activities.interrupt_named(service.interrupts, service.name, wait=STOP_WAIT)
        return outputs

    def _serve_activity(self, service: interface.Service, request: Any) -> Any:
        response = getattr(self._srv, f"{service.name}Response")
        try:
            activity = self._run(service, request, explicit_defaults.has_explicit_defaults(request))
        except ComponentError as problem:
            return response(False, self._logged_errors(service, problem))
        return response(True, explicit_defaults.accepts_warnings(request, activity.warning))

    def _serve_function(self, service: interface.Service, request: Any) -> Any:
        response = getattr(self._srv, f"{service.name}Response")
        changes = self._registrar.changes
        try:
            outputs = self._answer(service, request, explicit_defaults.has_explicit_defaults(request))
        except ComponentError as problem:
            return response(genom_success=False, genom_exdetail=self._logged_errors(service, problem))
        except Exception as problem:  # a fault of ours must reach the caller and the log, and not end the node
            rospy.logerr(f"{service.name}: {traceback.format_exc()}")
            error = ComponentError("::genom::unkex", what=f"{type(problem).__name__}: {problem}"[:127])
            return response(genom_success=False, genom_exdetail=error.exdetail)
        if self._registrar.changes != changes:
            self._registrar.settle()
        self._state_changed()
        whole = outputs.pop("response", None)  # a handler may bring a response of its own, with arrays in it
        if whole is not None:
            return whole
        told = explicit_defaults.accepts_warnings(request, outputs.pop("warning", ""))
        return response(genom_success=True, genom_exdetail=told, **outputs)

    def _logged_errors(self, service: interface.Service, problem: ComponentError) -> str:
        """The exdetail for the client; the log gets the reason too."""
        rospy.logwarn(f"{service.name}: {problem.ex}" + (f": {problem}" if str(problem) != problem.ex else ""))
        return problem.exdetail

    def _serve_action(self, service: interface.Service) -> None:
        result = getattr(self._msg, f"{service.name}Result")
        running: dict[str, Activity] = {}  # by goal id

        def answer(goal: Any, error: ComponentError | None) -> None:
            text = self._logged_errors(service, error) if error is not None else ""
            goal.set_succeeded(result(genom_success=error is None, genom_exdetail=text))

        def accept(goal: Any) -> None:  # actionlib calls this and `cancel` under the lock that set_succeeded needs
            if self.activities.full(service):
                error = too_many(service.task)
                goal.set_rejected(
                    result(False, self._logged_errors(service, error)), f"too many activities in {service.task}"
                )
                return

            def set_accepted(activity: Activity) -> None:
                with server.lock:
                    if goal.get_goal_status().status in (GoalStatus.PENDING, GoalStatus.RECALLING):
                        goal.set_accepted(activity.warning)

            def end(activity: Activity) -> None:
                set_accepted(activity)
                answer(goal, activity.error)
                del running[goal.get_goal_id().id]

            def wait(activity: Activity) -> None:
                # Accepted means running: a client that waits for it can make the next request, which may need this one,
                # and what it stops from then on ends normally. But a device that hangs is no reason to say nothing.
                activity.begun.wait(ACCEPT_SECONDS)
                set_accepted(activity)

            try:
                activity = self._begin(
                    service, goal.get_goal(), explicit_defaults.has_explicit_defaults(goal.goal), end
                )
            except ComponentError as problem:
                goal.set_accepted()
                answer(goal, problem)
                return
            running[goal.get_goal_id().id] = activity
            server.publish_status()  # the client learns that its goal is here
            threading.Thread(target=wait, args=(activity,), name=f"accept-{activity.id}", daemon=True).start()

        def cancel(goal: Any) -> None:
            activity = running.get(goal.get_goal_id().id)
            if activity is not None:
                activity.interrupt("client")

        action = getattr(self._msg, f"{service.name}Action")
        server = self._actions.add(f"{self.name}/{service.name}", action, accept, cancel)

    # --- what every component answers ---

    def _connect_port(self, values: dict[str, Any]) -> None:
        local, remote = values["local"], values["remote"]
        if local not in self._connectors:
            known = ", ".join(sorted(self._connectors)) or "none"
            raise ComponentError("::genom::no_such_inport", f"no input port {short_repr(local)}; there are: {known}")
        if not remote or not rosgraph.names.is_legal_name(remote):
            raise ComponentError("::genom::no_such_outport", f"{short_repr(remote)} is no topic name")
        topic = rospy.resolve_name(remote)
        try:
            published = master.published_topics(master.uri(), self.name)
        except master.MasterError as problem:
            raise ComponentError("::genom::port_io", str(problem)) from None
        if topic not in published:
            raise ComponentError("::genom::no_such_outport", f"nobody publishes {topic}; see `rostopic list`")
        wanted = interface.ros_type(self.component.port(local).idl)
        if published[topic].split("/")[-1] not in (wanted, "*"):
            raise ComponentError("::genom::port_io", f"{topic} is a {published[topic]}, {local} takes {wanted}")
        with self._connecting:
            self._connectors[local](topic)

    def _connect_service(self, values: dict[str, Any]) -> None:
        raise ComponentError("::genom::no_such_remote", f"{self.component.name} has no remote services")

    def _abort_activity(self, values: dict[str, Any]) -> None:
        self.activities.find(values["activity"]).interrupt("abort_activity")

    def _kill(self, values: dict[str, Any]) -> None:
        threading.Timer(SEND_SECONDS, self.finished.set).start()

    # --- genom_state and diagnostics ---

    def _state_changed(self) -> None:
        self._turn.set()

    def _log_crash(self, activity: Activity, problem: BaseException) -> None:
        text = "".join(traceback.format_exception(problem))
        rospy.logerr(f"{activity.service.name} (activity {activity.id}): {text}")

    def _publish_state(self) -> None:
        while not rospy.is_shutdown():
            self._turn.clear()
            self._state.publish(self._state_message())
            if self.finished.is_set():
                return
            self._turn.wait(STATE_PERIOD)
            self.finished.wait(BURST_SECONDS)

    def health_changed(self) -> None:
        """Publish /diagnostics now instead of at the end of its period."""
        self._health_changed.set()

    def _publish_diagnostics(self) -> None:
        rounds = itertools.count(1)
        while not self.finished.wait(DIAGNOSTICS_PAUSE):
            self._health_changed.wait(DIAGNOSTICS_PERIOD - DIAGNOSTICS_PAUSE)
            self._health_changed.clear()
            self.diagnostics.force_update()  # `update` would ask the master for the period, and fail without one
            if next(rounds) % TRIM_ROUNDS == 0:
                malloc_tuning.trim()

    def _state_message(self) -> Any:
        msg = self._msg
        live = self.activities.live()
        tasks = []
        for name, meter in self.meters.items():
            usage = meter.snapshot()
            tasks.append(
                msg.genom_state_task(
                    name=name,
                    rusage=msg.genom_state_rusage(
                        cycles=usage["cycles"],
                        timings=msg.genom_state_stats(**usage["timings"]),
                        load=msg.genom_state_stats(**usage["load"]),
                    ),
                    activity=[
                        msg.genom_state_activity(id=a.id, name=a.service.name) for a in live if a.service.task == name
                    ],
                )
            )
        return msg.genom_state_component(task=tasks, digest=self._digest, date=_DATE, version=VERSION)


_DATE = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(os.path.getmtime(interface.__file__)))


def _digest(component: interface.ComponentSpec) -> str:
    """A fingerprint of the interface, 32 hex digits."""
    return hashlib.md5(re.sub(r" at 0x\w+", "", repr(component)).encode()).hexdigest()
