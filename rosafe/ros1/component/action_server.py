"""Action servers of a node, their goals, and one thread that publishes the status of all of them periodically."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from types import ModuleType
from typing import Any

import actionlib
import rospy
from actionlib_msgs.msg import GoalStatus, GoalStatusArray

from rosafe.interface import ComponentError, Service
from rosafe.interface.genom import REJECTED_GOAL
from rosafe.ros1.component.activities import Activity, RequestDispatcher, too_many
from rosafe.ros1.component.explicit_defaults import has_explicit_defaults
from rosafe.ros1.transport.publisher import BufferList, Publisher

DEFAULT_FREQUENCY = 5.0  # Hz, as of every action server
MAX_FREQUENCY = 100.0  # Hz
ACCEPT_SECONDS = 2.0  # a goal is accepted when its activity runs, or after this: longer than InputProc waits for sound


class ActionServer(actionlib.ActionServer):
    """actionlib's server without a timer of its own: `StatusPublisher` publishes its status.

    Parameters
    ----------
    in_use : threading.Event
        Set when the server gets a goal, or its status a subscriber.
    """

    frequency: Any = DEFAULT_FREQUENCY  # the value of the ROS parameter

    def __init__(self, in_use: threading.Event, *arguments: Any) -> None:
        self._in_use = in_use
        super().__init__(*arguments, auto_start=False)

    @property
    def status_frequency(self) -> float:
        """0, for which actionlib starts no timer; the value of the parameter goes to `frequency`."""
        return 0.0

    @status_frequency.setter
    def status_frequency(self, value: Any) -> None:
        self.frequency = value

    def initialize(self) -> None:
        """Create publishers and subscribers."""
        status = Publisher(f"{rospy.remap_name(self.ns)}/status", GoalStatusArray)  # actionlib's will be the same topic
        status.impl.on_change = self._in_use.set
        super().initialize()

    def publish_status(self) -> None:
        """Publish the status of all goals now."""
        super().publish_status()
        if self.status_list:
            self._in_use.set()

    def publish_again(self, idle: BufferList) -> bool:
        """Publish the status; `idle` is that of a server without goals. Return whether the server is in use."""
        if self.status_list:
            self.publish_status()
            return True
        return bool(self.status_pub.impl.send(idle))


class StatusPublisher:
    """Publishes the status of all action servers of a node periodically, on one thread.

    Clients discover a server by its status, and treat a server that does not publish it as lost. Servers without goals
    and subscribers need no computing time; a new subscriber gets the last status immediately.

    Parameters
    ----------
    finished : threading.Event
        Ends it.
    """

    def __init__(self, finished: threading.Event) -> None:
        self._servers: list[ActionServer] = []
        self._finished = finished
        self._in_use = threading.Event()

    def add(self, name: str, action: Any, accept: Callable[[Any], None], cancel: Callable[[Any], None]) -> ActionServer:
        """Start the server of an action."""
        server = ActionServer(self._in_use, name, action, accept, cancel)
        server.start()
        self._servers.append(server)
        return server

    def run(self) -> None:
        """Publish at the frequency of the ROS parameter until the node ends."""
        frequency = _frequency(self._servers[0].frequency)
        message = GoalStatusArray()
        while frequency and not self._finished.wait(min(1 / frequency, threading.TIMEOUT_MAX)):
            self._in_use.wait()
            self._in_use.clear()
            message.header.seq += 1
            message.header.stamp = rospy.Time.now()
            idle = BufferList()
            message.serialize(idle)
            if sum(server.publish_again(idle) for server in self._servers):  # each of them publishes
                self._in_use.set()


def _frequency(value: Any) -> float:
    """Return the frequency in Hz for the parameter's `value`; 0 if the status is not published periodically."""
    number = float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan
    if number <= 0:
        return 0.0
    if not number <= MAX_FREQUENCY:
        rospy.logwarn(
            f"actionlib_status_frequency: expected a number up to {MAX_FREQUENCY:g}, got {value!r:.80}; "
            f"{DEFAULT_FREQUENCY:g} Hz are used"
        )
        return DEFAULT_FREQUENCY
    return number


# --- goals ------------------------------------------------------------------------------------------------------------


class GoalHandler:
    """Serves the action of an activity.

    Parameters
    ----------
    service : Service
        The activity.
    name : str
        The name of the action.
    messages : module
        The generated messages of the component.
    dispatcher : RequestDispatcher
        Starts the activities.
    statuses : StatusPublisher
        Publishes the status of the action.
    """

    def __init__(
        self,
        service: Service,
        name: str,
        messages: ModuleType,
        dispatcher: RequestDispatcher,
        statuses: StatusPublisher,
    ) -> None:
        self._service = service
        self._dispatcher = dispatcher
        self._result = getattr(messages, f"{service.name}Result")
        self._running: dict[str, Activity] = {}  # by goal id
        statuses.add(name, getattr(messages, f"{service.name}Action"), self._accept, self._cancel)

    def _accept(self, goal: Any) -> None:  # actionlib calls this and `_cancel` with the lock that set_succeeded needs
        service = self._service
        if self._dispatcher.activities.full(service):
            text = report_error(service, too_many(service.task))
            goal.set_rejected(self._result(False, text), f"too many activities in {service.task}")
            return

        def end(activity: Activity) -> None:
            _set_accepted(goal, activity)
            self._set_succeeded(goal, activity.error)
            del self._running[goal.get_goal_id().id]

        try:
            activity = self._dispatcher.start(service, goal.get_goal(), has_explicit_defaults(goal.goal), end)
        except ComponentError as problem:
            goal.set_accepted(REJECTED_GOAL)
            self._set_succeeded(goal, problem)
            return
        self._running[goal.get_goal_id().id] = activity
        goal.action_server.publish_status()  # the client learns that its goal has arrived
        name = f"accept-{activity.id}"
        threading.Thread(target=_accept_when_running, args=(goal, activity), name=name, daemon=True).start()

    def _cancel(self, goal: Any) -> None:
        activity = self._running.get(goal.get_goal_id().id)
        if activity is not None:
            activity.interrupt("client")

    def _set_succeeded(self, goal: Any, error: ComponentError | None) -> None:
        text = report_error(self._service, error) if error is not None else ""
        goal.set_succeeded(self._result(genom_success=error is None, genom_exdetail=text))


def report_error(service: Service, problem: ComponentError) -> str:
    """Log the error of a request, and return its exdetail for the client."""
    rospy.logwarn(f"{service.name}: {problem.ex}" + (f": {problem}" if str(problem) != problem.ex else ""))
    return problem.exdetail


def _accept_when_running(goal: Any, activity: Activity) -> None:
    """Accept a goal when its activity is running, but not later than `ACCEPT_SECONDS`, for instance if a device hangs.

    A client may send the next request, which may depend on the activity, when its goal is accepted. An activity that
    is stopped after this ends normally.
    """
    activity.begun.wait(ACCEPT_SECONDS)
    _set_accepted(goal, activity)


def _set_accepted(goal: Any, activity: Activity) -> None:
    with goal.action_server.lock:
        if goal.get_goal_status().status in (GoalStatus.PENDING, GoalStatus.RECALLING):
            goal.set_accepted(activity.warning if activity.error is None else REJECTED_GOAL)
