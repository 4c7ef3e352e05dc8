"""Activities without ROS: ids, slots, start, end, interruption; statistics of a task."""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from rosafe.interface import BASS, MAX_ACTIVITIES, ROSAFE, ComponentError
from rosafe.ros1.component.activities import Activities, Activity
from rosafe.tree import health
from rosafe.tree.health import TaskStatistics
from tests.harness import PATIENCE, wait_for

INPUT = ROSAFE.service("InputProc")  # interrupts its own kind
IHC = ROSAFE.service("IhcProc")


class Board:
    """Activities and their reports."""

    def __init__(self) -> None:
        self.crashes: list[BaseException] = []
        self.changes = 0
        self.activities = Activities(
            ROSAFE.tasks, self._changed, lambda activity, problem: self.crashes.append(problem)
        )

    def _changed(self) -> None:
        self.changes += 1

    def start(
        self, service: Any = IHC, handler: Any = None, on_end: Callable[[Activity], None] | None = None
    ) -> Activity:
        return self.activities.start(service, handler or until_stopped, {"value": 1}, on_end)


def until_stopped(activity: Activity, values: dict[str, Any]) -> None:
    activity.running()
    activity.stop_requested.wait(PATIENCE)


def raising(problem: BaseException) -> Any:
    def handler(activity: Activity, values: dict[str, Any]) -> None:
        raise problem

    return handler


@pytest.fixture
def board() -> Any:
    board = Board()
    yield board
    for activity in board.activities.live():
        activity.interrupt("the test's end")


def test_ids_grow_over_all_kinds_and_ended_activities_are_removed(board: Board) -> None:
    first, second, third = board.start(), board.start(INPUT), board.start()
    assert [first.id, second.id, third.id] == [1, 2, 3]
    assert board.activities.live() == [first, second, third]
    second.interrupt("abort_activity")
    assert second.ended.wait(PATIENCE)
    assert second.error is None, "an activity that was running ends normally"
    assert board.activities.live() == [first, third]
    assert board.start().id == 4
    assert board.activities.find(3) is third
    with pytest.raises(ComponentError, match="no activity 2; there are: 1, 3, 4"):
        board.activities.find(2)
    assert board.changes >= 5


def test_the_number_of_activities_of_a_task_is_limited(board: Board) -> None:
    for _ in range(MAX_ACTIVITIES - 1):
        board.start()
    assert board.activities.full(IHC) and not board.activities.full(INPUT)
    with pytest.raises(ComponentError, match="ihcProc has 255 activities, which is the limit"):
        board.start()
    board.start(INPUT)
    leaving = board.activities.find(5)
    leaving.interrupt("client")
    assert leaving.ended.wait(PATIENCE)
    assert not board.activities.full(IHC)
    board.start()
    assert board.activities.full(IHC)


@pytest.mark.parametrize(
    ("problem", "exdetail", "crashes"),
    [
        (ROSAFE.error("e_noData", "for people"), '{"ex":"::rosAFE::e_noData","what":"for people"}', 0),
        (ROSAFE.error("e_badNewValue", what="a"), '{"ex":"::rosAFE::e_badNewValue","detail":{"what":"a"}}', 0),
        (
            MemoryError(),
            '{"ex":"::genom::syserr","detail":{"code":12},"what":"there is not enough memory for it"}',
            1,
        ),
        (KeyError("lost"), '{"ex":"::genom::unkex","detail":{"what":"KeyError: \'lost\'"}}', 1),
    ],
)
def test_failures_are_named_errors(board: Board, problem: BaseException, exdetail: str, crashes: int) -> None:
    activity = board.start(handler=raising(problem))
    assert activity.begun.wait(PATIENCE) and activity.ended.wait(PATIENCE)
    assert activity.error is not None and activity.error.exdetail == exdetail
    assert len(board.crashes) == crashes
    assert board.activities.live() == []


def test_an_error_keeps_nothing_of_its_handler(board: Board) -> None:
    """Such as a processor that has failed."""
    objects: list[weakref.ref[Any]] = []

    def handler(activity: Activity, values: dict[str, Any]) -> None:
        local = threading.Event()
        objects.append(weakref.ref(local))
        try:
            raise KeyError("the context")
        except KeyError:
            raise ROSAFE.error("e_noData") from None

    gc.disable()
    try:
        activity = board.start(handler=handler)
        assert activity.ended.wait(PATIENCE) and activity.error is not None
        wait_for(lambda: objects[0]() is None)
    finally:
        gc.enable()


def test_lack_of_threads_is_a_named_error(board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", raising_start)
        with pytest.raises(ComponentError) as caught:
            board.start()
    assert caught.value.body["detail"] == {"code": 11} and "new thread" in caught.value.what
    assert board.activities.live() == []
    assert board.start().begun.wait(PATIENCE)


def raising_start(thread: threading.Thread) -> None:
    raise RuntimeError("can't start new thread")


def test_the_requesting_client_is_notified_first(board: Board) -> None:
    seen: list[Any] = []
    activity = board.start(on_end=lambda a: seen.append((a.begun.is_set(), a.ended.is_set(), board.activities.live())))
    activity.begun.wait(PATIENCE)
    board.activities.interrupt_named(["IhcProc"], "Stop", wait=10)
    assert seen == [(True, False, [])]


def test_an_end_is_complete_if_its_report_fails(board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda arguments: None)
    activity = board.start(handler=raising(ROSAFE.error("e_noData")), on_end=raising_end)
    assert activity.ended.wait(PATIENCE)


def raising_end(activity: Activity) -> None:
    raise OSError("the topic is gone")


def test_interrupted_before_it_ran(board: Board) -> None:
    gate = threading.Event()

    def slow(activity: Activity, values: dict[str, Any]) -> None:
        gate.wait(PATIENCE)
        activity.raise_if_interrupted()
        pytest.fail("it was interrupted")

    activity = board.start(handler=slow)
    activity.interrupt("client")
    activity.interrupt("Stop")
    gate.set()
    assert activity.ended.wait(PATIENCE)
    assert activity.error is not None
    assert activity.error.exdetail == '{"ex":"::genom::interrupted","detail":{"by":"client"}}', "the first one counts"


def test_a_new_activity_waits_for_the_ones_that_it_replaces(board: Board) -> None:
    release = threading.Event()

    def reluctant(activity: Activity, values: dict[str, Any]) -> None:
        activity.running()
        activity.stop_requested.wait(PATIENCE)
        release.wait(PATIENCE)

    def replacing(activity: Activity, values: dict[str, Any]) -> None:
        activity.interrupt_others()
        until_stopped(activity, values)

    bystander, old = board.start(), board.start(INPUT, reluctant)
    old.begun.wait(PATIENCE)
    new = board.start(INPUT, replacing)
    assert old.stop_requested.wait(PATIENCE) and old.stopped_by == "InputProc"
    assert not new.begun.is_set()
    release.set()
    assert new.begun.wait(PATIENCE) and old.ended.is_set() and old.error is None
    assert not bystander.stop_requested.is_set()


def test_stopping_by_name_is_bounded(board: Board) -> None:
    deaf = threading.Event()
    activity = board.start(handler=lambda activity, values: deaf.wait(PATIENCE))
    board.activities.interrupt_named(["IhcProc", "IldProc"], "Stop", wait=0.05)
    assert activity.stopped_by == "Stop" and not activity.ended.is_set()
    deaf.set()
    assert activity.ended.wait(PATIENCE)


def test_the_interface_table_names_existing_activities() -> None:
    for component in (ROSAFE, BASS):
        names = {service.name for service in component.activities}
        assert all(set(service.interrupts) <= names for service in component.services)
        assert all(service.task in component.tasks for service in component.activities)


def test_a_task_measures_its_cycles(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(health, "time", SimpleNamespace(monotonic=lambda: now))
    meter = TaskStatistics("input")
    assert meter.snapshot() == {
        "cycles": 0,
        "timings": {"last": 0.0, "max": 0.0, "avg": 0.0},
        "load": {"last": 0.0, "max": 0.0, "avg": 0.0},
    }
    for seconds in (0.1, 0.4, 0.25):
        meter.cycle(seconds)
    now = 100.5
    usage = meter.snapshot()
    assert usage["cycles"] == 3
    assert usage["timings"] == pytest.approx({"last": 0.25, "max": 0.4, "avg": 0.25})
    assert usage["load"]["last"] == 0.0, "not yet: half a second is too short"
    now = 103.0
    assert meter.snapshot()["load"] == pytest.approx({"last": 0.25, "max": 0.25, "avg": 0.25})
    now = 105.0
    assert meter.snapshot()["load"] == pytest.approx({"last": 0.0, "max": 0.25, "avg": 0.15})
