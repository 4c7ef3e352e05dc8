"""The goals of an action: each accepted goal is an activity."""

from __future__ import annotations

import threading
from types import ModuleType
from typing import Any

from actionlib_msgs.msg import GoalStatus

from rosafe.interface import ComponentError, Service
from rosafe.ros1.component.action_server import StatusPublisher
from rosafe.ros1.component.activities import Activity, too_many
from rosafe.ros1.component.explicit_defaults import has_explicit_defaults
from rosafe.ros1.component.request_dispatcher import RequestDispatcher, report_error

ACCEPT_SECONDS = 2.0  # a goal is accepted when its activity runs, or after this: longer than InputProc waits for sound


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
            goal.set_accepted()
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
            goal.set_accepted(activity.warning)
