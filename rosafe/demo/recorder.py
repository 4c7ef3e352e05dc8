"""Follows the seven output ports: counts what comes, notices what does not, keeps what the picture shows."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from rosafe.interface import KINDS, ROSAFE, ros_type
from rosafe.sound.windows import new_frames, split_new_frames
from rosafe.view.report import PortRow
from rosafe.view.representations import Representations

FRAMED = ("ild", "ratemap", "crossCorrelation")  # kinds whose port has a frame per hop, the others one per sample


class PortFollower:
    """What came on one port.

    A port shows a window of the newest frames, which overlaps with the one before. Every message says which audio
    frame it reaches up to (`lastFrameIndex`): from that follows how many frames are new, and whether some were in no
    window that came, which is what `lost` counts. Where the index falls the sound began anew, and so does the count.

    Parameters
    ----------
    kind : str
        A key of `rosafe.interface.KINDS`.
    topic : str
        Its topic.
    sample_rate : int
        Of the audio (Hz).
    frames_per_block : int
        Of the input processor; so much is new in a port's first message.
    """

    def __init__(self, kind: str, topic: str, sample_rate: int, frames_per_block: int) -> None:
        self.kind = kind
        self.topic = topic
        self.port = ROSAFE.port(KINDS[kind].port)
        self._sample_rate = sample_rate
        self._frames_per_block = frames_per_block
        self._stopped = False
        self._lock = threading.Lock()
        self.beginnings = 0  # how often the sound began (anew)
        self._forget()

    def _forget(self) -> None:
        self.frames = 0
        self.lost = 0
        self.frame_rate = 0
        self.index = 0  # of the audio frame after the newest one
        self.message: Any = None  # the newest one
        self.pieces: list[np.ndarray] = []  # all frames of a framed kind, as `_reduced` leaves them; lost ones are 0
        self.start = np.inf  # audio time (s) of the centre of the first frame of a framed kind
        self._arrivals: list[float] = []

    def take(self, message: Any) -> None:
        """A message that came (on rospy's thread)."""
        now = time.monotonic()
        with self._lock:
            if self._stopped or message.lastFrameIndex in (0, self.index):  # 0: a processor that has just started
                return
            if self.message is None or message.lastFrameIndex < self.index:
                self._forget()
                self.beginnings += 1
            self._arrivals.append(now)
            self.frame_rate = message.sampleRate
            lost, fresh = split_new_frames(self._fresh(message), message.framesOnPort)
            self.lost += lost
            self.frames += fresh
            self.index, self.message = message.lastFrameIndex, message
            if self.kind in FRAMED and fresh:
                piece = _reduced(self.kind, message, fresh)
                self.pieces += [np.zeros((*piece.shape[:-1], lost)), piece]
                # A block ends anywhere between two frames: the earliest start that any message allows is the true one
                # to within a fraction of a hop. Windows are two hops long.
                newest = (self.index - 1) / self._sample_rate - 1 / self.frame_rate
                self.start = min(self.start, newest - (self.frames + self.lost - 1) / self.frame_rate)

    def stop(self) -> None:
        """Take no more messages."""
        with self._lock:
            self._stopped = True

    def _fresh(self, message: Any) -> int:
        """How many frames up to the newest one did not come before."""
        if self.kind not in FRAMED:
            return self._frames_per_block if self.message is None else message.lastFrameIndex - self.index
        hop = self._sample_rate / message.sampleRate
        if self.message is None:  # a block holds this many whole windows
            return int(self._frames_per_block / hop) - 1
        expected = (message.lastFrameIndex - self.index) / hop
        return new_frames(expected, message.left, self.message.left)

    @property
    def row(self) -> PortRow:
        """The port's line in the table."""
        with self._lock:
            arrivals = self._arrivals
            rate = (len(arrivals) - 1) / (arrivals[-1] - arrivals[0]) if len(arrivals) > 1 else float("nan")
            return PortRow(self.topic, ros_type(self.port.idl), rate, self.frames, self.frame_rate, self.lost)

    def series(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (s, of the audio) and data of all frames of a framed kind that came."""
        with self._lock:
            if not self.pieces:
                return np.zeros(0), np.zeros((0, 0))
            data = np.concatenate(self.pieces, axis=-1)
            return self.start + np.arange(data.shape[-1]) / self.frame_rate, data


def _reduced(kind: str, message: Any, fresh: int) -> np.ndarray:
    """The newest `fresh` frames as `Representations` has them; a copy, so that the message can go."""
    if kind == "ratemap":
        return np.stack((message.left[..., -fresh:], message.right[..., -fresh:]))
    if kind == "crossCorrelation":
        return np.asarray(message.left[..., -fresh:].mean(axis=1))
    return np.array(message.left[..., -fresh:])


class PortRecorder:
    """All seven ports and the nodes' own counters. Make it after `rospy.init_node`, before there are processors.

    Parameters
    ----------
    names : mapping
        From kind to the processor's name.
    sample_rate, frames_per_block : int
        Of the audio and of the input processor.
    """

    def __init__(self, names: dict[str, str], sample_rate: int, frames_per_block: int) -> None:
        import rospy
        from diagnostic_msgs.msg import DiagnosticArray

        from rosafe.component import serialization

        self.center_frequencies = np.zeros(0)
        self.lags = np.zeros(0)
        self.health: dict[str, dict[str, str]] = {}  # by name of the status: its values
        self.ports: dict[str, PortFollower] = {}
        self._told: dict[str, float] = {}
        rospy.Subscriber("/diagnostics", DiagnosticArray, self._take_health)
        for kind, name in names.items():
            port = ROSAFE.port(KINDS[kind].port)
            topic = f"/rosAFE/{port.name}" + (f"/{name}" if port.multiple else "")
            follower = PortFollower(kind, topic, sample_rate, frames_per_block)
            self.ports[kind] = follower
            message_class = serialization.message_class("rosAFE", port.idl)
            rospy.Subscriber(topic, message_class, follower.take, buff_size=2**22, tcp_nodelay=True)

    def _take_health(self, message: Any) -> None:
        for status in message.status:
            self.health[status.name] = {entry.key: entry.value for entry in status.values}
            self._told[status.name] = time.monotonic()

    def health_since(self, moment: float) -> bool:
        """Whether both nodes have told about themselves since `moment` (of time.monotonic)."""
        return all(self._told.get(name, 0.0) > moment for name in ("bass: capture", "rosAFE: audio"))

    @property
    def position(self) -> tuple[int, int]:
        """How far the last of the ports has come: how often the sound began, and its newest audio frame."""
        return min((follower.beginnings, follower.index) for follower in self.ports.values())

    def stop(self) -> None:
        """Take nothing of the ports any more."""
        for follower in self.ports.values():
            follower.stop()

    def representations(self) -> Representations:
        """What came so far, on one time axis: seconds of the audio stream."""
        series = {}
        for kind in FRAMED:
            times, data = self.ports[kind].series()
            inside = times >= 1.5 / max(1, self.ports[kind].frame_rate)  # a window before that reaches before frame 1
            series[kind] = times[inside], data[..., inside]
        return Representations.aligned(
            self.center_frequencies,
            self.lags,
            ratemap=series["ratemap"],
            ild=series["ild"],
            correlation=series["crossCorrelation"],
        )

    def newest_sound(self, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """The last `seconds` of the left and of the right ear, from the input's port."""
        follower = self.ports["input"]
        message = follower.message
        if message is None:
            return np.zeros(0), np.zeros(0)
        count = max(1, round(seconds * follower.frame_rate))
        return message.left[-count:], message.right[-count:]
