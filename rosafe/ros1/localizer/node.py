"""The localizer node: its parts, diagnostics, start and end."""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable, Mapping
from typing import Any

import rospy
from std_msgs.msg import Bool

from rosafe.declarations.errors import ComponentError
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.head import Head
from rosafe.localization.live import OK, FixedHead, FrameQueue, LocalizationLoop, Mute, TransformedHead
from rosafe.localization.localizer import SPHERE, Localizer, find_model
from rosafe.ros import FrameClock
from rosafe.ros1.component.state_publisher import Diagnostics
from rosafe.ros1.localizer.frame_source import PortSource
from rosafe.ros1.localizer.noise import StoredNoise
from rosafe.ros1.localizer.publishers import Publishers
from rosafe.ros1.localizer.settings import LocalizerSettings, read_settings
from rosafe.ros1.localizer.status import NodeStatus
from rosafe.ros1.localizer.transforms import TransformBuffer
from rosafe.ros1.localizer.tree_link import LocalizerPorts, TreeLink
from rosafe.ros1.transport import registration
from rosafe.system.terminal import printable

UP_SECONDS = 10.0  # to register a node that starts at the master
PROGRESS_STEP = 0.1  # of the part of a head that is learned, between two lines in the log


class LocalizerNode:
    """The node. Create it after `rospy.init_node`; it starts at once.

    Parameters
    ----------
    options : mapping
        Those of the command line; see `LocalizerSettings`.

    Raises
    ------
    ComponentError
        A setting is unsuitable: one line.
    """

    def __init__(self, options: Mapping[str, Any]) -> None:
        self.finished = threading.Event()
        self._diagnostics = Diagnostics(self.finished)
        self._status = NodeStatus(self._diagnostics.changed)
        try:
            settings = read_settings(options)
            self._models = Models(settings)
            noise = StoredNoise(settings.noise, self._status)
        except ValueError as problem:
            raise ComponentError("::localizer::e_badNewValue", str(problem)) from None
        self._status.value("head", settings.head)
        self._diagnostics.add("localization", self._status.report)
        self._models.report = self._report_learning
        afe = rospy.resolve_name(settings.rosafe)
        self._transforms = _transforms(settings)
        mute = Mute(settings.audio_delay, self._status, rospy.get_time)
        self._mute = rospy.Subscriber("~mute", Bool, lambda m: mute.set(m.data), queue_size=10, tcp_nodelay=True)
        self._clock = FrameClock(afe)
        names = settings.world_frame, settings.head_frame, settings.audio_delay
        head = FixedHead() if self._transforms is None else TransformedHead(self._transforms, *names, self._status)
        self._loop = LocalizationLoop(
            functools.partial(_localizer, settings.seconds, noise),
            Publishers(settings.frame_id),
            FrameQueue(head, mute),
            self._status,
            lambda: self._link.check_now(),
            rospy.get_time,
        )
        self._link = TreeLink(
            afe, settings.connect, self._models.model_for, self._connect, self._status, self._loop.is_stalled
        )
        registration.registrar().settle(UP_SECONDS)
        self._loop.start()
        self._link.start()
        threading.Thread(target=self._diagnostics.run, name="diagnostics", daemon=True).start()

    def shutdown(self, by: str) -> None:
        """Remove the created processors, and end."""
        if not self.finished.is_set():
            self.finished.set()
            self._diagnostics.changed()
            self._link.close()
            self._loop.close()
            if self._transforms is not None:
                self._transforms.close()
            self._mute.unregister()

    def _connect(self, ports: LocalizerPorts | None) -> None:
        if ports is None:
            self._loop.connect(None)
        else:
            self._loop.connect(ports.model, functools.partial(PortSource, ports.topics, ports.format, self._clock))

    def _report_learning(self, part: float) -> None:
        """Show the progress of learning in the log and in /diagnostics; raises InterruptedError if the node ends."""
        if self.finished.is_set():
            raise InterruptedError("the node ends")
        shown = int(part / PROGRESS_STEP) * round(100 * PROGRESS_STEP)
        self._status.set("rosAFE", OK, f"learning the directions of the head: {shown} %")


def _localizer(seconds: float, noise: StoredNoise, model: DirectionModel) -> Localizer:
    localizer = Localizer(model.sample_rate, model, seconds, keep_history=False)
    noise.apply(localizer)
    return localizer


def _transforms(settings: LocalizerSettings) -> TransformBuffer | None:
    """Return the transforms of the head, subscribed; None if azimuths are relative to it."""
    if not settings.world_frame:
        return None
    try:
        transforms = TransformBuffer(settings.world_frame, settings.head_frame)
        transforms.subscribe()
    except ImportError as problem:
        raise ComponentError(
            "::localizer::e_badNewValue",
            f"world_frame: expected the Python modules of tf2 ({problem}); run scripts/install",
        ) from None
    return transforms


class Models:
    """The models of one head, by sample rate.

    Parameters
    ----------
    settings : LocalizerSettings

    Raises
    ------
    ValueError
        The file of the head is unsuitable.
    """

    def __init__(self, settings: LocalizerSettings) -> None:
        self.report: Callable[[float], None] = lambda part: None  # of the progress
        self._parameters = settings.parameters or None
        self._head: Any = SPHERE
        path = os.path.expanduser(settings.head)
        if path.lower().endswith(".sofa"):
            self._head = Head.from_sofa(path, settings.mirror)
        elif settings.mirror is not None:
            raise ValueError(f"mirror: expected a SOFA file as the head, got {settings.head!r}; unset mirror")
        elif settings.head != "sphere":
            self._head = DirectionModel.load(path)

    def model_for(self, sample_rate: float) -> DirectionModel:
        """Return the model for a sample rate. It is learned if there is none, which takes up to 30 s on two cores."""
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)  # of this thread only: sound comes first
        try:
            return find_model(self._head, sample_rate, self._parameters, self.report)
        except ValueError as problem:
            raise ValueError(printable(str(problem))) from None
