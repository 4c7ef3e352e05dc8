"""The localizer in the process of the tree: it requests its representations, and publishes sources."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose, PoseArray
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosafe_msgs.msg import DirectionPosterior, SoundSource, SoundSources, SourceAudio
from std_msgs.msg import Header

from rosafe.dsp.framing import FrameGrid
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.interface import ComponentError
from rosafe.localization import cues
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.live import OK, WARN, FrameFormat, NewFrames, Status, StreamRestartedError, Transforms
from rosafe.localization.live_node import MAX_PARTS, LiveLocalizer, MessageClasses, SourceTopics
from rosafe.localization.live_streams import LiveSound
from rosafe.localization.settings import LocalizerSettings
from rosafe.localization.status import NodeStatus
from rosafe.ros2.messages import ros_time
from rosafe.ros2.outputs import QUEUE, FramePosition
from rosafe.tree.block import Block
from rosafe.tree.processor import Processor

CHECK_SECONDS = 0.5  # between two checks of the processors
MAX_FRAMES = 10_000  # that wait for the thread that localizes


class TreeFrames:
    """New frames of the representations, from the threads of the tree to the one that localizes: a `FrameSource`.

    Parameters
    ----------
    processors : mapping
        The processor of each representation of `cues.KINDS`.
    format_ : FrameFormat
    time_of : callable
        Returns the clock time (s) of an audio frame, of which the first is 1.
    received : callable
        Called when `take` returns frames.
    """

    def __init__(
        self,
        processors: Mapping[str, Processor],
        format_: FrameFormat,
        time_of: Callable[[float], float],
        received: Callable[[], object],
    ) -> None:
        self.format = format_
        self.least = 0
        self.problem = ""
        self.missing = "sound: no new frames"
        self._kinds = {processor: kind for kind, processor in processors.items()}
        self._time_of, self._received = time_of, received
        self._lock = threading.Lock()
        self._restarted = ""
        self._begin()

    def _begin(self) -> None:
        self._parts: dict[str, list[tuple[int, FloatArray]]] = {kind: [] for kind in cues.KINDS}
        self._begins = 0, 0.0  # number of a frame, and the audio frames of the stream before it
        self._next = -1  # number of the frame after those that were taken; -1 before the first

    def close(self) -> None:
        """Use no further blocks."""
        self._kinds = {}

    def __call__(self, processor: Processor, block: Block, position: FramePosition) -> None:
        """Use a block: see `FrameConsumer`."""
        kind = self._kinds.get(processor)
        frames = block.parts[0]
        if kind is None:
            return
        with self._lock:
            if (position.restarted or position.lost) and self._parts[kind]:
                self._restarted = "the stream of frames has begun again"
                self._begin()
            if not frames.shape[-1]:
                return
            self._parts[kind].append((position.first, frames))
            if kind == cues.KINDS[0]:
                self._begins = position.first, position.begin
                if len(self._parts[kind]) > MAX_FRAMES:
                    self._begin()
            first, end = self._range()
            ready = bool(self._restarted) or (end - first) * self.format.hop >= max(self.least, 1)
        if ready:
            self._received()

    def _range(self) -> tuple[int, int]:
        """Return the first frame that was not taken yet and that all representations have, and the frame after."""
        if not all(self._parts.values()):
            return 0, 0
        first = max(self._next, *(parts[0][0] for parts in self._parts.values()))
        end = min(number + frames.shape[-1] for number, frames in (parts[-1] for parts in self._parts.values()))
        return first, max(first, end)

    def take(self) -> NewFrames | None:
        """Return the frames since the last call; see `FrameSource`."""
        with self._lock:
            if restarted := self._restarted:
                self._restarted = ""
                raise StreamRestartedError(restarted)
            first, end = self._range()
            if end <= first or (end - first) * self.format.hop < self.least:
                return None
            features = {kind: _slice(parts, first, end) for kind, parts in self._parts.items()}
            lost = first - self._next if self._next >= 0 else 0
            self._next = end
            number, begin = self._begins
            begin += (first - number) * self.format.hop + self.format.window / 2
        middles = np.array([self._time_of(1 + begin + k * self.format.hop) for k in range(end - first)])
        return NewFrames(features, middles, lost)


def _slice(parts: list[tuple[int, FloatArray]], first: int, end: int) -> FloatArray:
    """Return the frames from `first` to `end`, and remove those before `end`."""
    pieces = [
        frames[..., max(0, first - number) : end - number]
        for number, frames in parts
        if number < end and number + frames.shape[-1] > first
    ]
    parts[:] = [part for part in parts if part[0] + part[1].shape[-1] > end]
    return np.concatenate(pieces, axis=-1)


class SourcePublishers(SourceTopics):
    """Publishes sources, poses, the posterior, and the sound of each source: see `SourceTopics`."""

    def __init__(self, node: Node, frame_id: str, speech_only: bool) -> None:
        super().__init__(MessageClasses(Header, Pose, SoundSource, ros_time), frame_id, speech_only)
        topics = {"sources": SoundSources, "poses": PoseArray, "posterior": DirectionPosterior, "streams": SourceAudio}
        self._publishers = {
            name: node.create_publisher(
                message, f"~/{name}", QoSProfile(depth=MAX_PARTS if name == "streams" else QUEUE)
            )
            for name, message in topics.items()
        }

    def has_subscribers(self, topic: str) -> bool:
        """See `SourceTopics`."""
        return bool(self._publishers[topic].get_subscription_count())

    def send(self, topic: str, fields: Callable[[], Mapping[str, Any]]) -> None:
        """See `SourceTopics`."""
        if self.has_subscribers(topic):
            publisher = self._publishers[topic]
            publisher.publish(publisher.msg_type(**fields()))


class Localization:
    """Localizes as long as there is sound, from `start` to `close`.

    Parameters
    ----------
    settings : LocalizerSettings
    tree : LocalizedTree
        The tree of the node.
    publishers : SourcePublishers
    status : NodeStatus
    transforms : Transforms or None
        Of the head; None: azimuths are relative to it.
    clock : callable
        Returns the clock time in s.
    open_sound : callable
        Opens the sound at a sample rate (Hz), of which the sources are separated.

    Raises
    ------
    ValueError
        A file of the settings is unsuitable: one line.
    """

    def __init__(
        self,
        settings: LocalizerSettings,
        tree: Any,
        publishers: SourcePublishers,
        status: NodeStatus,
        transforms: Transforms | None,
        clock: Callable[[], float],
        open_sound: Callable[[float, Status], LiveSound],
    ) -> None:
        self._tree, self._status, self._open_sound = tree, status, open_sound
        self._closing = threading.Event()
        self._wake = threading.Event()
        self._localizer = LiveLocalizer(settings, publishers, status, transforms, clock, self._wake.set, self._closing)
        self._watched: dict[Processor, Mapping[str, Any]] = {}
        self._created: list[str] = []
        self._thread = threading.Thread(target=self._run, name="localizer", daemon=True)

    def start(self) -> None:
        """Start the threads."""
        self._localizer.start()
        self._thread.start()

    def check_now(self) -> None:
        """Check the processors soon, because something about them has changed."""
        self._wake.set()

    def close(self) -> None:
        """End."""
        self._closing.set()
        self._wake.set()
        self._thread.join(1.0)
        self._localizer.close()

    # --- the thread ---

    def _run(self) -> None:
        while not self._closing.is_set():
            self._wake.clear()
            try:
                self._check()
            except (ComponentError, ValueError, InterruptedError) as problem:
                self._status.set("rosAFE", WARN, str(problem))
            except Exception as problem:  # the node continues
                self._status.set_error("rosAFE", problem)
            self._wake.wait(CHECK_SECONDS)

    def _check(self) -> None:
        """Localize with the representations, requested again if they are missing or have changed."""
        present = set(self._tree.processors())
        if self._watched and all(
            processor in present and processor.stage.parameters == values for processor, values in self._watched.items()
        ):
            return
        self._unlink()
        rate = self._tree.sound_rate()
        if not rate:
            self._status.set("rosAFE", WARN, "waiting for sound")
            return
        model = self._localizer.model_for(rate)
        processors = self._request(model)
        grid = FrameGrid.design(rate, "cc", model.parameters)
        format_ = FrameFormat(rate, model.channels, len(grid.window), grid.hop, self._tree.block())
        names = ", ".join(processor.name for processor in processors.values())
        self._status.set("rosAFE", OK, f"localizing with {names}")
        open_sound = functools.partial(self._open_sound, rate, self._status)
        self._localizer.connect(model, open_sound, functools.partial(self._open, processors, format_))

    def _request(self, model: DirectionModel) -> dict[str, Processor]:
        found: dict[str, Processor] = {}
        for kind in cues.KINDS:
            planned = self._tree.request(kind, model.parameters)
            self._created += planned.created
            chain = [self._tree.find(name) for name in planned.names]
            self._watched.update({processor: processor.stage.parameters for processor in chain})
            found[kind] = chain[-1]
        return found

    def _open(
        self, processors: Mapping[str, Processor], format_: FrameFormat, received: Callable[[], object]
    ) -> TreeFrames:
        frames = TreeFrames(processors, format_, self._tree.time_of, received)
        self._tree.consumers.append(frames)
        return frames

    def _unlink(self) -> None:
        """Forget the processors, and remove those that only this localizer has used."""
        if self._watched:
            self._watched = {}
            self._localizer.disconnect()
            self._tree.consumers.clear()
            self._tree.remove_unused(self._created)
            self._created = []
