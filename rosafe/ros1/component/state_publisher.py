"""Publishers of a node's state: genom_state and /diagnostics."""

from __future__ import annotations

import hashlib
import importlib
import itertools
import os
import re
import threading
import time
from collections.abc import Mapping
from typing import Any

import diagnostic_updater
import rospy

from rosafe import interface
from rosafe.dsp import buffer_pool
from rosafe.ros1.component.activities import Activities
from rosafe.ros1.transport import systemd
from rosafe.system.version import VERSION
from rosafe.tree.health import TaskStatistics

STATE_PERIOD = 0.9  # s between two genom_state messages at most; the contract is 1
BURST_SECONDS = 0.005  # changes within this time are published in one message
DIAGNOSTICS_PERIOD = 1.0  # s; less after a change
DIAGNOSTICS_PAUSE = 0.1  # s between two messages at least
TRIM_ROUNDS = 20  # messages of diagnostics between two times that freed memory is returned to the system
_DATE = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(os.path.getmtime(interface.__file__)))


class StatePublisher:
    """Publishes the tasks and activities of a component on genom_state.

    Parameters
    ----------
    component : ComponentSpec
        The table of the interface.
    activities : Activities
        The running activities.
    meters : mapping of str to TaskStatistics
        By the name of the task.
    finished : threading.Event
        Ends it, after a last message.
    """

    def __init__(
        self,
        component: interface.ComponentSpec,
        activities: Activities,
        meters: Mapping[str, TaskStatistics],
        finished: threading.Event,
    ) -> None:
        self._messages = importlib.import_module(f"{component.name}.msg")
        self._activities = activities
        self._meters = meters
        self._finished = finished
        self._changed = threading.Event()
        # a fingerprint of the interface, 32 hex digits
        text = re.sub(r" at 0x\w+", "", repr(component))
        self._digest = hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()

    def changed(self) -> None:
        """Publish soon instead of at the end of the period."""
        self._changed.set()

    def run(self, publisher: rospy.Publisher) -> None:
        """Publish periodically, and after each change, until the node ends."""
        while not rospy.is_shutdown():
            self._changed.clear()
            publisher.publish(self._message())
            if self._finished.is_set():
                return
            self._changed.wait(STATE_PERIOD)
            self._finished.wait(BURST_SECONDS)

    def _message(self) -> Any:
        live = self._activities.live()
        tasks = [self._task(name, meter, live) for name, meter in self._meters.items()]
        return self._messages.genom_state_component(task=tasks, digest=self._digest, date=_DATE, version=VERSION)

    def _task(self, name: str, meter: TaskStatistics, live: list[Any]) -> Any:
        messages, usage = self._messages, meter.snapshot()
        return messages.genom_state_task(
            name=name,
            rusage=messages.genom_state_rusage(
                cycles=usage["cycles"],
                timings=messages.genom_state_stats(**usage["timings"]),
                load=messages.genom_state_stats(**usage["load"]),
            ),
            activity=[
                messages.genom_state_activity(id=one.id, name=one.service.name)
                for one in live
                if one.service.task == name
            ],
        )


class Diagnostics(diagnostic_updater.Updater):
    """/diagnostics of a node.

    Parameters
    ----------
    finished : threading.Event
        Ends it.
    """

    def __init__(self, finished: threading.Event) -> None:
        super().__init__()
        self.setHardwareID("none")
        self._finished = finished
        self._changed = threading.Event()

    def changed(self) -> None:
        """Publish soon instead of at the end of the period."""
        self._changed.set()

    def run(self) -> None:
        """Publish periodically and after each change, and notify systemd's watchdog, until the node ends."""
        rounds = itertools.count(1)
        while not self._finished.wait(DIAGNOSTICS_PAUSE):
            self._changed.wait(DIAGNOSTICS_PERIOD - DIAGNOSTICS_PAUSE)
            self._changed.clear()
            systemd.notify("WATCHDOG=1")
            self.force_update()  # `update` asks the master for the period, and fails without a master
            if next(rounds) % TRIM_ROUNDS == 0:
                buffer_pool.trim()
