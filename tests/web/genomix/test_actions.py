"""Goals of activities on a slow graph: the time of sending, and goals without an answer."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from rosafe.interface import ComponentError
from rosafe.interface.genom import REJECTED_GOAL
from rosafe.ros1.client import actions
from rosafe.ros1.client.actions import ActionClient
from rosafe.ros1.client.graph import Graph
from tests.harness import in_loop


class Topic:
    """A publisher or subscriber of rospy with a given number of connections."""

    def __init__(self) -> None:
        self.connections = 0
        self.sent: list[Any] = []

    def get_num_connections(self) -> int:
        return self.connections

    def publish(self, message: Any) -> None:
        self.sent.append(message)


class Action:
    """The topics of bass's Acquire, as its client sees them."""

    def __init__(self, client: ActionClient) -> None:
        self.client = client
        self.goal, self.cancel, self.result, self.status = topics = [Topic() for _ in range(4)]
        client._publishers.update(goal=topics[0], cancel=topics[1])
        client._subscribers += topics[2:]

    def accept(self, text: str = "") -> None:
        """Publish the status that an action server publishes for a goal that it has accepted."""
        from actionlib_msgs.msg import GoalStatus, GoalStatusArray

        status = GoalStatus(status=GoalStatus.ACTIVE, text=text)
        status.goal_id.id = self.goal.sent[-1].goal_id.id
        self.client._on_status(GoalStatusArray(status_list=[status]))


@asynccontextmanager
async def action_of_bass() -> AsyncIterator[Action]:
    """Provide an action of a component that does not run."""
    graph = Graph("http://127.0.0.1:9")
    yield Action(ActionClient(graph, "bass", "bass", "Acquire"))
    await graph.close()


@pytest.mark.parametrize("missing", ["goal", "cancel", "result", "status"])
@in_loop(action_of_bass)
async def test_a_goal_is_sent_when_all_topics_are_connected(
    action: Action, /, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    """A result and a cancellation are sent once: a client or component that is not connected yet would miss them."""
    monkeypatch.setattr(actions, "REPEAT_SECONDS", 0.01)
    for topic in (action.goal, action.cancel, action.result, action.status):
        topic.connections = 1
    late: Topic = getattr(action, missing)
    late.connections = 0
    sending = asyncio.create_task(action.client.send({"device": "scene:"}))
    done, _ = await asyncio.wait({sending}, timeout=0.2)
    assert not done and action.goal.sent == []
    late.connections = 1
    async with asyncio.timeout(60):
        while not action.goal.sent:
            await asyncio.sleep(0.01)
        action.accept()
        goal = await sending
    assert goal.acknowledged.is_set() and action.goal.sent[0].goal.device == "scene:"
    assert len({message.goal_id.id for message in action.goal.sent}) == 1


@in_loop(action_of_bass)
async def test_a_goal_without_an_answer_is_cancelled(action: Action, /, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actions, "ANSWER_SECONDS", 0.1)
    for topic in (action.goal, action.cancel, action.result, action.status):
        topic.connections = 1
    with pytest.raises(ComponentError, match=r"bass did not answer /bass/Acquire within 0\.1 s"):
        await action.client.send({"device": "scene:"})
    assert action.cancel.sent[0].id == action.goal.sent[0].goal_id.id
    assert action.client.goals == {}


@in_loop(action_of_bass)
async def test_a_goal_that_is_accepted_and_rejected_at_once(action: Action, /) -> None:
    """It counts as acknowledged when its error arrives, however late: a client does not see it as running before."""
    for topic in (action.goal, action.cancel, action.result, action.status):
        topic.connections = 1
    sending = asyncio.create_task(action.client.send({"device": "scene:"}))
    async with asyncio.timeout(60):
        while not action.goal.sent:
            await asyncio.sleep(0.01)
        action.accept(REJECTED_GOAL)
        goal = await sending
    assert not goal.acknowledged.is_set() and not goal.ended.is_set()
    goal.end(ComponentError("::bass::e_device"))
    assert goal.acknowledged.is_set() and goal.error is not None
