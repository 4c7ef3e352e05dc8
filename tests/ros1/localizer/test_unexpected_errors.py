"""Unexpected errors in the threads of the localizer: it reports them and continues."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rospy

from rosafe.localization.live import ERROR, OK, WARN, FixedHead, FrameQueue, LocalizationLoop, NewFrames
from rosafe.ros1.localizer import tree_link
from rosafe.ros1.localizer.settings import node_status
from tests.harness import wait_for


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the errors in the log."""
    lines: list[str] = []
    monkeypatch.setattr(rospy, "logerr", lines.append)
    monkeypatch.setattr(rospy, "resolve_name", lambda name: name)
    monkeypatch.setattr(rospy, "get_time", lambda: 1.0)
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:1")
    return lines


def test_the_link_to_rosafe_tries_again(log: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    class Client:
        attempts = 0

        @classmethod
        async def load(cls, *_: Any) -> Client:
            cls.attempts += 1
            raise KeyError("no such member")

    monkeypatch.setattr(tree_link, "ComponentClient", Client)
    monkeypatch.setattr(tree_link, "POLL_SECONDS", 0.01)
    monkeypatch.setattr(tree_link, "MAX_PAUSE", 0.01)
    status = node_status(lambda: None)
    unused: Any = None
    link = tree_link.TreeLink("/rosAFE", "", unused, unused, status)
    link.start()
    try:
        wait_for(lambda: Client.attempts > 3)
        level, text = status.state()
        assert level == ERROR and "KeyError: 'no such member'" in text
        assert len(log) == 2 and "Traceback" in log[0], "once, with its traceback"
    finally:
        link.close()


def namespace(**members: Any) -> Any:
    """Return an object with these members."""
    return SimpleNamespace(**members)


class Fake:
    """The parts of a loop whose steps fail if a test says so."""

    def __init__(self) -> None:
        self.faults: dict[str, Exception] = {}
        self.published = 0
        self.status = node_status(lambda: None)
        self._times = itertools.count()
        azimuths = np.arange(0.0, 360.0, 5.0)
        self.localizer = namespace(
            model=namespace(level_gain_db=0.0),
            noise=namespace(azimuths=[]),
            hop=0.1,
            sources=[],
            updated_at=0.0,
            update_parts=lambda frames: [slice(frames)],
            reset=lambda keep_noise: self.fail("reset"),
            update=lambda _, times, *__, **___: self.step(
                "update", {"time": times[-1:], "azimuths": azimuths, "posterior": [azimuths]}
            ),
        )
        self.source = namespace(
            problem="",
            missing="sound",
            take=self.take,
            close=lambda: None,
            format=namespace(block=800, hop=1600, sample_rate=16000.0),
        )
        mute = namespace(active=False, muted=lambda times: np.zeros(len(times), bool))
        publishers = namespace(begin_again=lambda: None, publish=self.publish)
        unused: Any = None
        queue = FrameQueue(FixedHead(), mute)
        self.loop = LocalizationLoop(unused, publishers, queue, self.status, unused, lambda: 1.0)
        self.loop._localizer, self.loop._source = self.localizer, self.source

    def fail(self, step: str) -> None:
        """Raise the error of a step, if it has one."""
        if step in self.faults:
            raise self.faults[step]

    def step(self, step: str, result: Any) -> Any:
        """Return the result of a step that may fail."""
        self.fail(step)
        return result

    def take(self) -> NewFrames:
        """Return a new frame of 0.1 s."""
        times = np.array([0.1 * next(self._times)])
        return self.step("take", NewFrames({"itd": times[np.newaxis]}, times, 0))

    def publish(self, *_: Any) -> None:
        """Count the message."""
        self.fail("publish")
        self.published += 1


@pytest.fixture
def fake(log: list[str]) -> Iterator[Fake]:
    """Run a loop for which sound arrives every 10 ms."""
    fake = Fake()
    ending = threading.Event()

    def deliver() -> None:
        while not ending.wait(0.01):
            fake.loop._arrived.set()

    thread = threading.Thread(target=deliver)
    fake.loop.start()
    thread.start()
    yield fake
    ending.set()
    thread.join()
    fake.loop.close()


def more(fake: Fake) -> Callable[[], bool]:
    """Return whether further messages have been published since this call."""
    before = fake.published
    return lambda: fake.published > before + 2


@pytest.mark.parametrize("step", ["take", "update", "publish"])
def test_the_loop_continues(fake: Fake, log: list[str], step: str) -> None:
    wait_for(more(fake))
    assert fake.status.state()[0] == OK
    fake.faults = {step: KeyError("first"), "reset": KeyError("second")}
    wait_for(lambda: fake.status.state()[0] == ERROR)
    assert "KeyError: 'first'" in fake.status.state()[1]
    count = int(fake.status._values["unexpected errors"])
    wait_for(lambda: int(fake.status._values["unexpected errors"]) > count + 3)
    assert len(log) == 2 and "Traceback" in log[0], "once, with its traceback"
    if step != "publish":
        wait_for(more(fake), what="messages continue")
    fake.faults = {}
    wait_for(more(fake))
    wait_for(lambda: fake.status.state()[0] == OK)


def test_messages_that_are_not_finite(fake: Fake, log: list[str]) -> None:
    fake.faults = {"update": ValueError("ild: expected finite numbers")}
    wait_for(lambda: fake.status.state() == (WARN, "messages of rosAFE cannot be used: ild: expected finite numbers"))
    wait_for(more(fake), what="messages continue")
    fake.faults = {}
    wait_for(lambda: fake.status.state()[0] == OK)
    assert not log


def test_the_state_is_the_worst_and_among_several_the_newest() -> None:
    status = node_status(lambda: None)
    states = []
    for part, level in (("a", OK), ("b", WARN), ("c", WARN), ("b", WARN), ("d", OK)):
        status.set(part, level, part, log=False)
        states.append(status.state()[1])
    assert states == ["a", "b", "c", "b", "b"]
    status.clear("b")
    assert status.state() == (WARN, "c")
