"""The localizer node: its parts, diagnostics, start and end."""

from __future__ import annotations

import functools
import threading
from collections.abc import Mapping
from typing import Any

import rospy
from std_msgs.msg import Bool

from rosafe.declarations.errors import ComponentError
from rosafe.localization.live_node import LiveLocalizer
from rosafe.localization.rotations import RotationBuffer
from rosafe.localization.settings import LocalizerSettings
from rosafe.ros import FrameClock
from rosafe.ros1.component.state_publisher import Diagnostics
from rosafe.ros1.localizer.inputs import InputSound, PortSource
from rosafe.ros1.localizer.publishers import Publishers
from rosafe.ros1.localizer.settings import node_status, read_settings
from rosafe.ros1.localizer.tree_link import LocalizerPorts, TreeLink
from rosafe.ros1.transport import registration
from rosafe.system.log_throttle import ThrottledLog

UP_SECONDS = 10.0  # to register a node that starts at the master


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
            self._localizer = LiveLocalizer(
                settings,
                Publishers(settings.frame_id, settings.speech_only),
                self._status,
                _transforms(settings),
                rospy.get_time,
                lambda: self._link.check_now(),
                self.finished,
            )
        except ValueError as problem:
            raise ComponentError("::localizer::e_badNewValue", str(problem)) from None
        self._diagnostics.add("localization", self._status.report)
        localizer = self._localizer
        rospy.Subscriber("~mute", Bool, lambda m: localizer.mute.set(m.data), queue_size=10, tcp_nodelay=True)
        afe = rospy.resolve_name(settings.rosafe)
        self._clock = FrameClock(afe)
        self._link = TreeLink(
            afe, settings.connect, localizer.model_for, self._connect, self._status, localizer.is_stalled
        )
        registration.registrar().settle(UP_SECONDS)
        localizer.start()
        self._link.start()
        threading.Thread(target=self._diagnostics.run, name="diagnostics", daemon=True).start()

    def shutdown(self, by: str) -> None:
        """Remove the created processors, and end."""
        if not self.finished.is_set():
            self.finished.set()
            self._diagnostics.changed()
            self._link.close()
            self._localizer.close()

    def _connect(self, ports: LocalizerPorts | None) -> None:
        if ports is None:
            self._localizer.disconnect()
        else:
            rate = ports.format.sample_rate
            self._localizer.connect(
                ports.model,
                functools.partial(InputSound, ports.audio, rate, self._clock, self._status),
                functools.partial(PortSource, ports.topics, ports.format, self._clock),
            )


def _transforms(settings: LocalizerSettings) -> RotationBuffer | None:
    """Return the transforms of the head, subscribed; None if azimuths are relative to it."""
    if not settings.world_frame:
        return None
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError as problem:
        raise ComponentError(
            "::localizer::e_badNewValue",
            f"world_frame: expected the Python modules of tf2 ({problem}); run scripts/install",
        ) from None
    buffer = RotationBuffer(settings.world_frame, settings.head_frame, ThrottledLog(rospy.logwarn, 60.0))
    for topic, static in (("/tf", False), ("/tf_static", True)):
        add = functools.partial(buffer.add_message, static=static, seconds=rospy.Time.to_sec)
        rospy.Subscriber(topic, TFMessage, add, queue_size=100, tcp_nodelay=True)
    return buffer
