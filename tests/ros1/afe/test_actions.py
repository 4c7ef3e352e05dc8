"""Requests as actions, and the life of an activity: ids, genom_state, ends of every kind."""

from __future__ import annotations

import itertools
import signal
import time
from typing import Any

import pytest
import rosAFE.msg
import rospy
from actionlib import CommState
from actionlib_msgs.msg import GoalStatus

from rosafe.interface import CORE_REPRESENTATIONS, ROSAFE
from rosafe.interface.genom import REJECTED_GOAL
from tests.harness import Graph, wait_for
from tests.ros1.afe.session import Goal, Session, error_of, noise, own_node

REQUESTS = [kind.request for kind in CORE_REPRESENTATIONS.values()]


def build(afe: Session, *requests: str) -> dict[str, Goal]:
    """Send goals for an input and `requests`, each as soon as the previous one is accepted."""
    afe.listen()
    goals = {}
    for request in ("InputProc", *requests):
        few = {"fb_nChannels": 2} if request == "GammatoneProc" else {}
        goals[request] = afe.goal(request, **few).active()
    return goals


def succeeded(goal: Goal) -> None:
    """Check that the goal has ended normally."""
    result = goal.result()
    assert (result.genom_success, result.genom_exdetail) == (True, "")
    assert goal.status() == GoalStatus.SUCCEEDED


def failed(goal: Goal) -> tuple[str, Any]:
    """Return exception and detail of a goal that failed; its actionlib state is succeeded, too."""
    result = goal.result()
    assert not result.genom_success
    assert goal.status() == GoalStatus.SUCCEEDED
    assert {CommState.ACTIVE, CommState.PREEMPTING} & set(goal.states), "failures are reported after acceptance"
    return error_of(result)


def test_a_whole_tree_of_goals(afe: Session) -> None:
    """An accepted goal is running, so that the next one can follow; results arrive when the activities end."""
    goals = build(afe, *REQUESTS[1:])
    assert afe.processors() == {
        kind: [ROSAFE.service(k.request).parameter("name").default] for kind, k in CORE_REPRESENTATIONS.items()
    }
    ids = afe.wait_activities(REQUESTS)
    assert list(ids.values()) == REQUESTS and sorted(ids) == list(ids), "ids grow in the order of the requests"
    assert all(goal.running for goal in goals.values())
    afe.ok("removeProcessor", name="gammatone")
    for request in ("GammatoneProc", "IhcProc", "IldProc", "RatemapProc", "CrossCorrelationProc"):
        succeeded(goals[request])
    assert goals["InputProc"].running and goals["PreProc"].running
    afe.ok("Stop")
    succeeded(goals["InputProc"])
    succeeded(goals["PreProc"])


def test_failures_are_results(afe: Session) -> None:
    build(afe, "PreProc")
    with afe.graph.collect(f"/{afe.name}/IhcProc/status") as messages:
        assert failed(afe.goal("IhcProc")) == ("::rosAFE::e_noUpperDependencie", {})
        accepted = GoalStatus.ACTIVE, REJECTED_GOAL
        wait_for(lambda: accepted in [(one.status, one.text) for message in messages for one in message.status_list])
    assert failed(afe.goal("PreProc")) == ("::rosAFE::e_existsAlready", {})
    ex, detail = failed(afe.goal("GammatoneProc", fb_nERBs=-1.0))
    assert ex == "::rosAFE::e_badNewValue" and "fb_nERBs" in detail["what"]
    assert afe.processors() == {"input": ["input"], "preProc": ["preProc"]}
    afe.wait_activities(["InputProc", "PreProc"])


def waiting_input(afe: Session) -> Goal:
    """Start an InputProc that waits for audio."""
    goal = afe.goal("InputProc")
    afe.wait_activities(["InputProc"])
    return goal


def silent_port(afe: Session) -> Any:
    """Connect the Audio port to a topic without messages."""
    import bass.msg

    publisher = rospy.Publisher("/silent/Audio", bass.msg.binaudio_portStruct, queue_size=1)
    afe.ok("connect_port", local="Audio", remote="/silent/Audio")
    return publisher


@pytest.mark.parametrize("by", ["client", "abort_activity", "Stop", "InputProc"])
def test_a_waiting_input_is_interrupted(afe: Session, by: str) -> None:
    silent = silent_port(afe)
    goal = waiting_input(afe)
    if by == "client":
        goal.handle.cancel()
    elif by == "abort_activity":
        (number,) = afe.wait_activities(["InputProc"])
        afe.ok("abort_activity", activity=number)
    elif by == "Stop":
        afe.ok("Stop")
    else:
        newer = afe.goal("InputProc", name="newer")
        afe.listen()
        newer.active()
        assert afe.processors() == {"input": ["newer"]}
    assert failed(goal) == ("::genom::interrupted", {"by": by})
    silent.unregister()


def test_cancel_is_a_normal_end_also_of_the_descendants(afe: Session) -> None:
    goals = build(afe, "PreProc", "GammatoneProc", "IhcProc")
    goals["GammatoneProc"].handle.cancel()
    succeeded(goals["GammatoneProc"])
    succeeded(goals["IhcProc"])
    wait_for(lambda: afe.processors() == {"input": ["input"], "preProc": ["preProc"]})
    assert afe.topic("gammatone") not in afe.graph.topics()


def test_an_old_goal_can_be_cancelled(afe: Session) -> None:
    """Also after many other goals of its kind."""
    goals = build(afe, "PreProc")
    for _ in range(40):
        failed(afe.goal("PreProc"))
    goals["PreProc"].handle.cancel()
    succeeded(goals["PreProc"])


def test_cancel_everything_by_an_empty_goal_id(afe: Session) -> None:
    from actionlib_msgs.msg import GoalID

    goals = build(afe, "PreProc", "GammatoneProc")
    gammatones = [goals["GammatoneProc"], afe.goal("GammatoneProc", name="second", fb_nChannels=2).active()]
    publisher = rospy.Publisher("/rosAFE/GammatoneProc/cancel", GoalID, queue_size=1)
    wait_for(lambda: publisher.get_num_connections() == 1)
    publisher.publish(GoalID())
    for goal in gammatones:
        succeeded(goal)
    assert goals["PreProc"].running
    publisher.unregister()


def test_abort_activity_ends_goals_and_services_alike(afe: Session) -> None:
    goals = build(afe, "PreProc")
    afe.ok("GammatoneProc", fb_nChannels=2)
    ids = {name: number for number, name in afe.wait_activities(["InputProc", "PreProc", "GammatoneProc"]).items()}
    afe.ok("abort_activity", activity=ids["GammatoneProc"])
    afe.wait_activities(["InputProc", "PreProc"])
    assert afe.processors() == {"input": ["input"], "preProc": ["preProc"]}
    assert afe.refused("abort_activity", activity=ids["GammatoneProc"]) == ("::genom::no_such_activity", {})
    afe.ok("abort_activity", activity=ids["PreProc"])
    succeeded(goals["PreProc"])


def test_kill_ends_all_activities_and_the_node(graph: Graph) -> None:
    """Each goal has its result; the exit code is 0, and the node leaves nothing on the graph."""
    with own_node(graph) as afe:
        goals = build(afe, "PreProc", "GammatoneProc", "IhcProc", "IldProc")
        assert afe.microphone is not None
        afe.microphone.play(noise(12000))
        afe.read("ild", 12001)
        afe.ok("kill")
        for goal in goals.values():
            succeeded(goal)
        assert afe.process.wait() == 0
        assert "Traceback" not in afe.process.err
        assert "/own" not in graph.nodes()


def test_a_waiting_input_is_interrupted_by_kill(graph: Graph) -> None:
    """Three attempts: on a busy machine the wait for audio (2 s) may end before the signal arrives."""
    for _ in range(3):
        with own_node(graph) as afe:
            silent = silent_port(afe)
            goal = waiting_input(afe)
            assert afe.process.stop(signal.SIGTERM) == 0
            result = failed(goal)
            silent.unregister()
        if result[0] != "::rosAFE::e_noData":
            break
    assert result == ("::genom::interrupted", {"by": "kill"})


# --- genom_state ------------------------------------------------------------------------------------------------


def test_genom_state_describes_all_activities(afe: Session) -> None:
    microphone = afe.build("PreProc", block=800)
    blocks = 5
    with afe.follow("preProc"):  # otherwise the blocks are combined
        microphone.play(noise(800 * blocks))
        state = afe.graph.message(
            "/rosAFE/genom_state",
            rosAFE.msg.genom_state_component,
            accept=lambda s: s.task[1].rusage.cycles >= blocks and s.task[2].rusage.cycles >= blocks,
        )
    assert [task.name for task in state.task] == list(ROSAFE.tasks)
    assert len(state.digest) == 32 and int(state.digest, 16) and len(state.date) < 32 and 0 < len(state.version) < 33
    by_name = {task.name: task for task in state.task}
    assert [a.name for a in by_name["input"].activity] == ["InputProc"]
    assert [a.name for a in by_name["preProc"].activity] == ["PreProc"]
    for name in ("input", "preProc"):
        timings = by_name[name].rusage.timings
        assert 0 < timings.avg <= timings.max and 0 < timings.last <= timings.max
    idle = by_name["ildProc"].rusage
    assert (idle.cycles, idle.timings.max, idle.load.max) == (0, 0.0, 0.0)


def test_genom_state_is_published_each_second_and_at_each_change(afe: Session) -> None:
    afe.build()
    with afe.graph.collect("/rosAFE/genom_state", rosAFE.msg.genom_state_component) as messages:
        moments = []
        for count in range(1, 7):  # the latched message is the first one
            wait_for(lambda: len(messages) >= count)  # noqa: B023
            moments.append(time.monotonic())
        periods = [after - before for before, after in itertools.pairwise(moments[1:])]
        assert min(periods) < 1.1, "one each second, except for delays on a busy machine"
        afe.ok("PreProc")
        wait_for(lambda: "PreProc" in {a.name for t in messages[-1].task for a in t.activity})
        afe.ok("removeProcessor", name="preProc")
        wait_for(lambda: "PreProc" not in {a.name for t in messages[-1].task for a in t.activity})
