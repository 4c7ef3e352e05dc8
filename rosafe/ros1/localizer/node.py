"""The localizer node: its parts, diagnostics, start and end."""

from __future__ import annotations

import functools
import threading
from collections.abc import Mapping
from typing import Any

import rospy
from std_msgs.msg import Bool

from rosafe.declarations.errors import ComponentError
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.live import OK, FixedHead, FrameQueue, LocalizationLoop, Mute, TransformedHead
from rosafe.localization.live_streams import LiveStreams
from rosafe.localization.localizer import Localizer
from rosafe.localization.settings import LocalizerSettings, Models
from rosafe.localization.stored_noise import StoredNoise
from rosafe.ros import FrameClock
from rosafe.ros1.component.state_publisher import Diagnostics
from rosafe.ros1.localizer.frame_source import PortSource
from rosafe.ros1.localizer.publishers import Publishers
from rosafe.ros1.localizer.settings import read_settings
from rosafe.ros1.localizer.sound import InputSound
from rosafe.ros1.localizer.status import node_status
from rosafe.ros1.localizer.transforms import TransformBuffer
from rosafe.ros1.localizer.tree_link import LocalizerPorts, TreeLink
from rosafe.ros1.transport import registration

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
        self._status = node_status(self._diagnostics.changed)
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
        publishers = Publishers(settings.frame_id, settings.speech_only)
        self._streams = publishers.streams = LiveStreams(
            publishers.publish_part, publishers.has_stream_subscribers, publishers.has_speech_subscribers, self._status
        )
        self._loop = LocalizationLoop(
            functools.partial(_localizer, settings.seconds, noise),
            publishers,
            FrameQueue(head, mute),
            self._status,
            lambda: self._link.check_now(),
            rospy.get_time,
            self._streams.update,
        )
        self._link = TreeLink(
            afe, settings.connect, self._models.model_for, self._connect, self._status, self._loop.is_stalled
        )
        registration.registrar().settle(UP_SECONDS)
        self._loop.start()
        self._streams.start()
        self._link.start()
        threading.Thread(target=self._diagnostics.run, name="diagnostics", daemon=True).start()

    def shutdown(self, by: str) -> None:
        """Remove the created processors, and end."""
        if not self.finished.is_set():
            self.finished.set()
            self._diagnostics.changed()
            self._link.close()
            self._loop.close()
            self._streams.close()
            if self._transforms is not None:
                self._transforms.close()
            self._mute.unregister()

    def _connect(self, ports: LocalizerPorts | None) -> None:
        if ports is None:
            self._loop.connect(None)
            self._streams.connect(None)
        else:
            open_sound = functools.partial(InputSound, ports.audio, ports.format.sample_rate, self._clock, self._status)
            self._streams.connect(ports.model, open_sound)
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
