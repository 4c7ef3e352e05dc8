"""The node's tree in a file: saved at each change, and restored after a restart (`rosAFE-ros --keep FILE`)."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rospy
from diagnostic_msgs.msg import DiagnosticStatus

from rosafe.declarations import ros_names
from rosafe.interface import RESTORED_PARAM, ROSAFE, ComponentError, Representation
from rosafe.ros1.afe.audio_input import AudioInput
from rosafe.ros1.afe.tree_state_file import TreeStateFile
from rosafe.ros1.component.activities import Activities, Handler
from rosafe.ros1.transport import master, registration
from rosafe.setups import Setup, SetupProcessor, dry_run
from rosafe.tree.tree import Tree

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
    tree : Tree
    processors : callable
        Returns the current processors.
    activities : Activities
        Of the node.
    handler : callable
        Returns the handler that creates a processor of a kind.
    """

    def __init__(
        self,
        path: Path | None,
        audio: AudioInput,
        tree: Tree,
        processors: Callable[[], tuple[SetupProcessor, ...]],
        activities: Activities,
        handler: Callable[[Representation], Handler],
    ) -> None:
        self._audio = audio
        self._tree = tree
        self._processors = processors
        self._activities = activities
        self._handler = handler
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
        """Give up the restoration because another tree was requested."""
        self._pending = Setup()

    def _setup(self) -> Setup:
        """Return the current tree, or the one that is still to be restored, with the current connection."""
        topic = self._audio.topic
        connections = {"Audio": ros_names.relative(topic, rospy.get_name())} if topic else {}
        return Setup(self._sound, connections, self._pending.processors or self._processors())

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
        while self._pending.processors and not finished.wait(POLL_SECONDS):
            rate = self._audio.ring.sample_rate
            requested = any(activity.service.name == "InputProc" for activity in self._activities.live())
            if rate == 0 or rate in tried or requested:
                continue
            tried.add(rate)
            try:
                dry_run(self._pending, rate)
                self._build(self._pending)
            except ComponentError as problem:
                self._waiting_for = str(problem)
                if self._pending.processors:  # otherwise another tree was requested
                    rospy.logerr(f"cannot restore the tree of {self._file and self._file.path}: {problem}")
            else:
                rospy.loginfo(f"{len(self._pending.processors)} processors are restored")
                self._waiting_for = ""
                self.discard()
                self.save()

    def _build(self, setup: Setup) -> None:
        try:
            for processor in setup.processors:
                kind = processor.representation
                values = {
                    "name": processor.name,
                    "upperDepName": processor.parent,
                    **processor.values,
                    **processor.input_values,
                }
                activity = self._activities.start(ROSAFE.service(kind.request), self._handler(kind), values, None)
                activity.begun.wait()
                if activity.error is not None:
                    raise activity.error
        except ComponentError:
            if self._pending is setup:
                self._tree.stop()
            raise

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
