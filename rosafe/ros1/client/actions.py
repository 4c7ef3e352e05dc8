"""Clients of activities: goals that are sent to an action server, acknowledged, cancelled and ended."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import importlib
import itertools
from collections.abc import Callable, Mapping
from typing import Any

from rosafe.interface import ComponentError
from rosafe.interface.genom import REJECTED_GOAL
from rosafe.ros1.client import installed_components
from rosafe.ros1.client.errors import middleware_error
from rosafe.ros1.client.graph import Graph
from rosafe.ros1.client.tcpros import component_exception
from rosafe.ros1.component import explicit_defaults

ANSWER_SECONDS = 5.0  # until the first status of a goal
REPEAT_SECONDS = 0.1  # between two attempts to send a goal; the server ignores a goal that arrives twice
RESULT_SECONDS = 1.0  # from the last status of a goal to its result, which normally follows immediately

_ACTIVE = frozenset((1, 6))  # actionlib_msgs/GoalStatus: ACTIVE, PREEMPTING
_ENDED = frozenset((2, 3, 4, 5, 8, 9))  # PREEMPTED, SUCCEEDED, ABORTED, REJECTED, RECALLED, LOST
_REJECTED = 5


class Goal:
    """One requested activity. `error` is valid once `ended` is set: None if the activity has ended normally."""

    def __init__(self, number: str, client: ActionClient) -> None:
        self.id = number
        self._client = client
        self.seen = asyncio.Event()  # the component has received it
        self.acknowledged = asyncio.Event()  # it runs, or has ended
        self.ended = asyncio.Event()
        self.error: ComponentError | None = None
        self.warning = ""  # of the component, when it is acknowledged
        self.outputs: dict[str, Any] = {}  # when it has ended without an error

    def cancel(self) -> None:
        """Ask the component to end the activity."""
        self._client.cancel(self)

    def forget(self) -> None:
        """Stop following the activity."""
        self._client.goals.pop(self.id, None)

    def end(self, error: ComponentError | None) -> None:
        """Record the end, unless it is recorded already, and stop following the activity."""
        self.forget()
        if not self.ended.is_set():
            self.error = error
            for event in (self.seen, self.acknowledged, self.ended):
                event.set()


class ActionClient:
    """Sends goals to one action of one component instance. Use `create` to construct it."""

    _numbers = itertools.count(1)

    def __init__(self, graph: Graph, package: str, instance: str, action: str) -> None:
        self._graph = graph
        self._instance = instance
        self._name = f"{graph.resolve(instance)}/{action}"
        self._loop = asyncio.get_running_loop()
        self.goals: dict[str, Goal] = {}  # in progress, by id
        self._subscribers: list[Any] = []
        self._publishers: dict[str, Any] = {}
        messages = importlib.import_module(f"{package}.msg")
        self._goal_class = getattr(messages, f"{action}ActionGoal")
        self._result_class = getattr(messages, f"{action}ActionResult")

    @classmethod
    async def create(cls, graph: Graph, package: str, instance: str, action: str) -> ActionClient:
        """Return a client that is registered at the master; ComponentError if the master does not answer."""
        await graph.become_node()
        await graph.master("getPid")  # rospy would wait for the master without a time limit
        client = cls(graph, package, instance, action)
        await asyncio.to_thread(client._register)
        return client

    def _register(self) -> None:
        import rospy
        from actionlib_msgs.msg import GoalID, GoalStatusArray

        for part, kind, callback in (
            ("result", self._result_class, self._on_result),
            ("status", GoalStatusArray, self._on_status),
        ):
            forward = functools.partial(self._forward, callback)
            self._subscribers.append(rospy.Subscriber(f"{self._name}/{part}", kind, forward, tcp_nodelay=True))
        for part, kind in (("cancel", GoalID), ("goal", self._goal_class)):
            self._publishers[part] = rospy.Publisher(
                f"{self._name}/{part}", kind, queue_size=64, tcp_nodelay=True, headers=explicit_defaults.HEADER
            )

    def _forward(self, callback: Callable[[Any], None], message: Any) -> None:
        """Run a callback of rospy's thread in the event loop."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(callback, message)

    async def close(self) -> None:
        """Unregister from the action's topics; goals in progress end with an error."""
        for goal in list(self.goals.values()):
            goal.end(middleware_error(f"{self._instance} was unloaded"))
        topics = [*self._subscribers, *self._publishers.values()]
        await asyncio.gather(*(asyncio.to_thread(topic.unregister) for topic in topics))

    # --- goals ---

    async def send(self, values: Mapping[str, Any]) -> Goal:
        """Send a goal with `values`; return it when the component has received it.

        Raises ComponentError if the component does not confirm that.
        """
        goal = Goal(f"{self._graph.name}-{next(self._numbers)}", self)
        self.goals[goal.id] = goal
        message = self._goal_class()
        message.goal_id.id = goal.id
        installed_components.fill(message.goal, values)
        try:
            await asyncio.wait_for(self._send_until_seen(goal, message), ANSWER_SECONDS)
        except BaseException as problem:
            goal.forget()
            if not isinstance(problem, TimeoutError):
                raise
            self.cancel(goal)  # in case it still arrives
            what = f"{self._instance} did not answer {self._name} within {ANSWER_SECONDS:g} s"
            raise middleware_error(what) from None
        return goal

    async def _send_until_seen(self, goal: Goal, message: Any) -> None:
        while not goal.seen.is_set():
            # A result is sent once, as is a cancellation, and not to later subscribers: send the goal only when all
            # topics are connected.
            if all(topic.get_num_connections() for topic in (*self._subscribers, *self._publishers.values())):
                self._publishers["goal"].publish(message)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(goal.seen.wait(), REPEAT_SECONDS)

    def cancel(self, goal: Goal) -> None:
        """Ask the component to end the activity."""
        from actionlib_msgs.msg import GoalID

        self._publishers["cancel"].publish(GoalID(id=goal.id))

    def _on_status(self, message: Any) -> None:
        for status in message.status_list:
            goal = self.goals.get(status.goal_id.id)
            if goal is None:
                continue
            goal.seen.set()
            if status.status in _ACTIVE and status.text != REJECTED_GOAL:
                goal.warning = status.text
                goal.acknowledged.set()
            elif status.status in _ENDED:
                self._loop.call_later(RESULT_SECONDS, goal.end, _without_result(status))

    def _on_result(self, message: Any) -> None:
        goal = self.goals.get(message.status.goal_id.id)
        if goal is None:
            return
        error = None
        if message.result.genom_success:
            goal.outputs = installed_components.outputs(message.result)
        elif message.result.genom_exdetail:
            error = component_exception(message.result.genom_exdetail)
        else:
            error = _without_result(message.status)
        goal.end(error)


def _without_result(status: Any) -> ComponentError:
    if status.status == _REJECTED:
        return ComponentError("::genom::too_many_activities", status.text)
    return middleware_error(f"the activity ended without a result (actionlib status {status.status} {status.text})")
