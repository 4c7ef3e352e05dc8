"""Records the seven output ports: counts received and lost frames, and keeps the frames for the figure."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rosafe.audio.files.windows import new_frames, split_new_frames
from rosafe.interface import KINDS, ROSAFE, ros_type
from rosafe.view.report import PortRow
from rosafe.view.representations import Representations

FRAMED = ("ild", "ratemap", "crossCorrelation")  # kinds with one frame per hop; the others have one per sample
RECORDED = ("input", *FRAMED)  # kinds whose frames are kept


@dataclass
class _Recording:
    """The frames of one port since the start of the audio.

    Attributes
    ----------
    index : int
        Index of the audio frame after the newest one.
    message
        The newest message.
    pieces : list of ndarray
        All frames of a framed kind, and those of the input that have not been taken, as returned by `_reduced`;
        lost ones are 0.
    start : float
        Audio time (s) of the centre of the first frame of a framed kind.
    arrivals : list of float
        Times of the messages.
    """

    frames: int = 0
    lost: int = 0
    frame_rate: int = 0
    index: int = 0
    message: Any = None
    pieces: list[np.ndarray] = field(default_factory=list)
    start: float = np.inf
    arrivals: list[float] = field(default_factory=list)


class PortFollower:
    """Records one port.

    Each message contains a window of the newest frames, which overlaps with the previous one, and the index of the
    audio frame at its end (`lastFrameIndex`). The index determines how many frames are new, and how many are lost
    because no received window contained them. If it falls, the audio has restarted, and so does the recording.

    Parameters
    ----------
    kind : str
        A key of `rosafe.interface.KINDS`.
    topic : str
        Its topic.
    sample_rate : int
        Of the audio (Hz).
    frames_per_block : int
        Of the input processor; the number of new audio frames in the first message of a port.
    """

    def __init__(self, kind: str, topic: str, sample_rate: int, frames_per_block: int) -> None:
        self.kind = kind
        self.topic = topic
        self.port = ROSAFE.port(KINDS[kind].port)
        self.starts = 0  # how often the audio has started
        self._sample_rate = sample_rate
        self._frames_per_block = frames_per_block
        self._recording = _Recording()
        self._stopped = False
        self._lock = threading.Lock()

    def receive(self, message: Any) -> None:
        """Record a message. Called on a thread of rospy."""
        now = time.monotonic()
        with self._lock:
            # 0: a processor that has just started
            if self._stopped or message.lastFrameIndex in (0, self._recording.index):
                return
            if self._recording.message is None or message.lastFrameIndex < self._recording.index:
                self._recording = _Recording()
                self.starts += 1
            recording = self._recording
            recording.arrivals.append(now)
            recording.frame_rate = message.sampleRate
            lost, fresh = split_new_frames(self._new_frames(message), message.framesOnPort)
            recording.lost += lost
            recording.frames += fresh
            recording.index, recording.message = message.lastFrameIndex, message
            if self.kind in RECORDED and fresh:
                piece = _reduced(self.kind, message, fresh)
                recording.pieces += [np.zeros((*piece.shape[:-1], lost)), piece]
            if self.kind in FRAMED and fresh:
                # A block may end anywhere between two frames. The earliest start that is compatible with any message is
                # correct within a fraction of a hop. Windows are two hops long.
                newest = (recording.index - 1) / self._sample_rate - 1 / recording.frame_rate
                start = newest - (recording.frames + recording.lost - 1) / recording.frame_rate
                recording.start = min(recording.start, start)

    def stop(self) -> None:
        """Ignore further messages."""
        with self._lock:
            self._stopped = True

    def _new_frames(self, message: Any) -> int:
        """Return the number of frames since the previous message."""
        before = self._recording
        if self.kind not in FRAMED:
            return self._frames_per_block if before.message is None else message.lastFrameIndex - before.index
        hop = self._sample_rate / message.sampleRate
        if before.message is None:  # the number of complete windows in a block
            return int(self._frames_per_block / hop) - 1
        return new_frames((message.lastFrameIndex - before.index) / hop, message.left, before.message.left)

    @property
    def position(self) -> tuple[int, int]:
        """How often the audio has started, and its newest frame."""
        return self.starts, self._recording.index

    @property
    def row(self) -> PortRow:
        """The line of the port in the table."""
        with self._lock:
            recording = self._recording
            times = recording.arrivals
            rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else float("nan")
            message_type = ros_type(self.port.idl)
            return PortRow(self.topic, message_type, rate, recording.frames, recording.frame_rate, recording.lost)

    def series(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times (s, of the audio) and data of all recorded frames of a framed kind."""
        with self._lock:
            recording = self._recording
            if not recording.pieces:
                return np.zeros(0), np.zeros((0, 0))
            data = np.concatenate(recording.pieces, axis=-1)
            return recording.start + np.arange(data.shape[-1]) / recording.frame_rate, data

    def take_sound(self) -> tuple[tuple[int, int], np.ndarray]:
        """Return the sound of the input since the previous call: its position (see `position`), and samples (2, n)."""
        with self._lock:
            pieces, self._recording.pieces = self._recording.pieces, []
            sound = np.concatenate(pieces, axis=-1) if pieces else np.zeros((2, 0))
            return (self.starts, self._recording.index - sound.shape[1]), sound

    def newest(self, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the last `seconds` of the left and the right ear."""
        recording = self._recording
        if recording.message is None:
            return np.zeros(0), np.zeros(0)
        count = max(1, round(seconds * recording.frame_rate))
        return recording.message.left[-count:], recording.message.right[-count:]


def _reduced(kind: str, message: Any, fresh: int) -> np.ndarray:
    """Return a copy of the newest `fresh` frames in the shape that `Representations` needs."""
    if kind in ("input", "ratemap"):
        return np.stack((message.left[..., -fresh:], message.right[..., -fresh:]))
    if kind == "crossCorrelation":
        return np.asarray(message.left[..., -fresh:].mean(axis=1))
    return np.array(message.left[..., -fresh:])


class PortRecorder:
    """Records all seven ports and the counters of the nodes. Create it after `rospy.init_node`, before the processors.

    Parameters
    ----------
    names : mapping
        Name of the processor by kind.
    sample_rate, frames_per_block : int
        Of the audio and of the input processor.
    """

    def __init__(self, names: dict[str, str], sample_rate: int, frames_per_block: int) -> None:
        import rospy
        from diagnostic_msgs.msg import DiagnosticArray

        from rosafe.ros1.component import serialization

        self.center_frequencies = np.zeros(0)
        self.lags = np.zeros(0)
        self.health: dict[str, dict[str, str]] = {}  # values by name of the status
        self.ports: dict[str, PortFollower] = {}
        self._health_times: dict[str, float] = {}
        rospy.Subscriber("/diagnostics", DiagnosticArray, self._receive_health)
        for kind, name in names.items():
            port = ROSAFE.port(KINDS[kind].port)
            topic = f"/rosAFE/{port.name}" + (f"/{name}" if port.multiple else "")
            follower = PortFollower(kind, topic, sample_rate, frames_per_block)
            self.ports[kind] = follower
            message_class = serialization.message_class("rosAFE", port.idl)
            rospy.Subscriber(topic, message_class, follower.receive, buff_size=2**22, tcp_nodelay=True)

    def _receive_health(self, message: Any) -> None:
        for status in message.status:
            self.health[status.name] = {entry.key: entry.value for entry in status.values}
            self._health_times[status.name] = time.monotonic()

    def health_since(self, moment: float) -> bool:
        """Return whether both nodes have published their counters since `moment` (time.monotonic)."""
        return all(self._health_times.get(name, 0.0) > moment for name in ("bass: capture", "rosAFE: audio"))

    @property
    def position(self) -> tuple[int, int]:
        """Position of the slowest port: how often the audio has started, and its newest frame."""
        return min(follower.position for follower in self.ports.values())

    def stop(self) -> None:
        """Ignore further messages of the ports."""
        for follower in self.ports.values():
            follower.stop()

    def representations(self) -> Representations:
        """Return the recorded frames on one time axis, in seconds of the audio stream."""
        series = {}
        for kind in FRAMED:
            times, data = self.ports[kind].series()
            frame_rate = max(1, self.ports[kind].row.frame_rate)
            complete = times >= 1.5 / frame_rate  # earlier windows start before the first frame
            series[kind] = times[complete], data[..., complete]
        return Representations.aligned(
            self.center_frequencies,
            self.lags,
            ratemap=series["ratemap"],
            ild=series["ild"],
            correlation=series["crossCorrelation"],
        )
