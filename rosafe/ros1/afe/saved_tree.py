"""The node's tree in a file: saved at each change, and restored after a restart (`rosAFE-ros --keep FILE`)."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import rospy
from diagnostic_msgs.msg import DiagnosticStatus

from rosafe.declarations import ros_names
from rosafe.interface import RESTORED_PARAM, ComponentError
from rosafe.ros1.afe.audio_input import AudioInput
from rosafe.ros1.transport import master, registration
from rosafe.tree.setups import Setup, dry_run, plan
from rosafe.tree.setups.state_file import TreeStateFile
from rosafe.tree.tree_builder import Planner
from rosafe.tree.tree_planner import ExistingProcessor, TreePlan

POLL_SECONDS = 0.1  # between two checks whether there is audio for the tree to restore


def _announce(names: list[str]) -> None:
    """Store the names of the processors to restore, for clients that know them; also in a master that starts later."""
    value = [rospy.get_node_uri(), *names]
    registration.registrar().parameters[rospy.resolve_name(f"~{RESTORED_PARAM}")] = value
    with contextlib.suppress(*master.FAILURES):
        rospy.set_param(f"~{RESTORED_PARAM}", value)


class SavedTree:
    """The tree of a node in a file.

    Parameters
    ----------
    path : Path or None
        The file; None to save nothing.
    audio : AudioInput
    describe : callable
        Returns the current tree and its connection.
    build : callable
        Executes a plan of processors to create: see `rosafe.tree.tree_builder`.
    is_requested : callable
        Returns whether another client is about to create an input.
    """

    def __init__(
        self,
        path: Path | None,
        audio: AudioInput,
        describe: Callable[[], Setup],
        build: Callable[[Planner], object],
        is_requested: Callable[[], bool],
    ) -> None:
        self._audio = audio
        self._describe = describe
        self._build = build
        self._is_requested = is_requested
        self._file = None if path is None else TreeStateFile(path, self._setup, rospy.logerr)
        saved = Setup() if self._file is None else self._file.saved()
        if self._file is not None and self._file.absent:
            rospy.logwarn(self._file.absent)
        self._pending = Setup(None, saved.connections, saved.processors)  # not restored yet
        self._sound = saved.sound  # not used by the node, but preserved in the file
        self._waiting_for = ""  # why it is not restored yet

    @property
    def enabled(self) -> bool:
        """Whether the tree is saved."""
        return self._file is not None

    def save(self) -> None:
        """Write the current tree to the file, if it has changed."""
        if self._file is not None:
            self._file.save()

    def close(self) -> None:
        """Save no later changes, as the processors end now and are to be restored."""
        if self._file is not None:
            self._file.close()

    def discard(self) -> None:
        """Give up the restoration because there is another tree, or because the tree is restored."""
        self._pending = Setup()

    def _setup(self) -> Setup:
        """Return the current tree, or the one that is still to be restored, with the current connection."""
        now = self._describe()
        return replace(now, sound=self._sound, processors=self._pending.processors or now.processors)

    def restore(self, finished: threading.Event) -> None:
        """Connect to the saved topic, and start a thread that restores the tree; it ends when `finished` is set."""
        topic = self._pending.connections.get("Audio", "")
        if topic:
            topic = ros_names.resolve(topic, rospy.get_name())
            self._audio.connect(topic)  # it need not have a publisher yet
            self.save()
        if self._pending.processors:
            names = [processor.name for processor in self._pending.processors]
            master.bounded(lambda: _announce(names), None, finished.is_set)  # the master may hang
            self._waiting_for = f"waiting for sound on {topic or 'the Audio port'}"
            threading.Thread(target=self._restore, args=(finished,), name="restore tree", daemon=True).start()

    def _restore(self, finished: threading.Event) -> None:
        """Build the tree as soon as there is audio with a suitable sample rate."""
        tried: set[int] = set()
        setup = self._pending

        def plan_if_pending(found: Sequence[ExistingProcessor]) -> TreePlan:
            if self._pending is not setup:
                raise ComponentError("::genom::interrupted", by="InputProc")
            return plan(setup, found)

        while self._pending is setup and not finished.wait(POLL_SECONDS):
            rate = self._audio.ring.sample_rate
            if rate == 0 or rate in tried or self._is_requested():
                continue
            tried.add(rate)
            try:
                dry_run(setup, rate)
                self._build(plan_if_pending)
            except ComponentError as problem:
                self._waiting_for = str(problem)
                if self._pending is setup:  # otherwise another tree was requested
                    rospy.logerr(f"cannot restore the tree of {self._file and self._file.path}: {problem}")
            else:
                rospy.loginfo(f"{len(setup.processors)} processors are restored")
                self._waiting_for = ""
                self.discard()
                self.save()

    def report(self, status: Any) -> Any:
        """Fill in a status of /diagnostics."""
        assert self._file is not None
        if problem := self._file.problem or self._waiting_for or self._file.absent:
            status.summary(DiagnosticStatus.WARN, problem)
        else:
            status.summary(DiagnosticStatus.OK, "the tree is kept")
        status.add("file", str(self._file.path))
        status.add("to come back", " ".join(one.name for one in self._pending.processors) or "nothing")
        return status
