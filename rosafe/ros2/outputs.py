"""The topics of the processors: each frame once, with its number, and only for subscribers."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, Protocol

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosafe_msgs.msg import Coordinate, Representation

from rosafe.interface import KINDS, ROSAFE
from rosafe.results.view.coordinates import axis_coordinates
from rosafe.ros2.messages import numbers, ros_time
from rosafe.ros2.sound import BlockReader, Sound
from rosafe.tree.block import Block
from rosafe.tree.health import ProcessorHealth
from rosafe.tree.processor import Processor

QUEUE = 5  # messages; the offered quality of service is reliable, which suits all subscribers
UNITS = {"channel": "Hz", "filter": "Hz", "lag": "s"}  # of coordinates that are numbers


class FramePosition(NamedTuple):
    """The position of the frames of a block.

    Attributes
    ----------
    first : int
        Number of the first frame: frame k begins k hops after the beginning of the sound.
    lost : int
        Frames that are missing before it.
    begin : float
        Audio frames of the stream before the beginning of the first frame.
    restarted : bool
        Whether another stream of frames begins.
    """

    first: int
    lost: int
    begin: float
    restarted: bool


class FrameCounter:
    """Numbers the frames of one processor."""

    def __init__(self) -> None:
        self._reader: BlockReader | None = None
        self._signal: Any = None
        self._end = 0  # of the last block, in audio frames of the stream
        self._origin = (0, 0)  # audio frames before the first block, and the number of the first frame
        self._frames = 0  # since then
        self._missing = 0  # audio frames since then
        self._next = 0  # number of the next frame

    def advance(self, block: Block, reader: BlockReader) -> FramePosition:
        """Return the position of the frames of the next block."""
        signal, frames, end = block.signal, block.parts[0].shape[-1], reader.end_of(block.number)
        gap = end - self._end - reader.block
        before = self._next
        restarted = reader is not self._reader or signal != self._signal or gap < 0
        if restarted:
            begin = end - reader.block
            self._origin = begin, round(begin / signal.hop)
            self._frames = self._missing = gap = 0
            self._reader, self._signal = reader, signal
        self._missing += gap
        self._end = end
        first = self._origin[1] + self._frames + round(self._missing / signal.hop)
        position = self._origin[0] + self._missing + self._frames * signal.hop
        self._frames += frames
        self._next = first + frames
        return FramePosition(first, 0 if restarted else first - before, position, restarted)


class FrameConsumer(Protocol):
    """Gets the frames of processors, on the threads of the tree."""

    def __call__(self, processor: Processor, block: Block, position: FramePosition) -> object:
        """The next block of a processor."""


class _Topic:
    """One part of the output of a processor."""

    def __init__(self, node: Node, processor: Processor, part: int) -> None:
        declared = processor.representation.parts[part]
        self._node, self._part = node, part
        topic = topics_of(processor)[part]
        self.publisher = node.create_publisher(Representation, topic, QoSProfile(depth=QUEUE))
        self._message = Representation(
            processor=processor.name,
            kind=processor.kind,
            output=declared.name,
            unit=declared.unit,
            axes=list(declared.axes),
        )
        self._axes = declared.axes[:-1]
        self._format: Any = None

    def publish(self, processor: Processor, block: Block, first: int, lost: int, time: float) -> None:
        """Publish a block if there are subscribers."""
        data = block.parts[self._part]
        message = self._message
        if self._format != (block.signal, data.shape[:-1]):
            self._format = block.signal, data.shape[:-1]
            message.frame_rate = float(block.signal.rate)
            message.coordinates = list(_coordinates(processor, self._axes, data.shape))
        message.header.stamp = ros_time(time)
        message.shape = data.shape
        message.first_frame, message.lost_frames = first, lost
        message.data = numbers(data)
        self.publisher.publish(message)


class _Output:
    """All topics of one processor."""

    def __init__(self, node: Node, processor: Processor) -> None:
        self.counter = FrameCounter()
        self.topics = [_Topic(node, processor, part) for part in range(len(processor.representation.parts))]
        self._lost = 0  # frames, not reported yet: many blocks complete no frame

    def publish(self, processor: Processor, block: Block, position: FramePosition, sound: Sound) -> None:
        """Publish a block on the topics that have subscribers."""
        self._lost += position.lost
        if not block.parts[0].shape[-1]:
            return
        lost, self._lost = self._lost, 0
        subscribed = [topic for topic in self.topics if topic.publisher.get_subscription_count()]
        if subscribed:
            time = sound.time_of(1 + position.begin + block.signal.window / 2 * block.signal.framed)
            for topic in subscribed:
                topic.publish(processor, block, position.first, lost, time)


class Outputs:
    """Publishes the tree, whose listener it is.

    Parameters
    ----------
    node : Node
    sound : Sound
    changed : callable
        Called when a processor was added or removed, on any thread; must return at once.

    Attributes
    ----------
    consumers : list of FrameConsumer
        Get all blocks too.
    health : ProcessorHealth
        Of the tree; has to be set before the first processor.
    """

    health: ProcessorHealth

    def __init__(self, node: Node, sound: Sound, changed: Callable[[], object]) -> None:
        self._node, self._sound, self._changed = node, sound, changed
        self._outputs: dict[Processor, _Output] = {}
        self.consumers: list[FrameConsumer] = []

    def on_added(self, processor: Processor) -> None:
        """Create the topics."""
        self._outputs[processor] = _Output(self._node, processor)
        self.health.added(processor)
        self._changed()

    def on_executed(self, processor: Processor, seconds: float) -> None:
        """Measure the load."""
        self.health.executed(processor, seconds)

    def on_released(self, processor: Processor, block: Block) -> None:
        """Publish a block."""
        reader = self._sound.reader
        output = self._outputs.get(processor)
        if output is None or reader is None:
            return
        position = output.counter.advance(block, reader)
        output.publish(processor, block, position, self._sound)
        for consumer in self.consumers:
            consumer(processor, block, position)

    def on_removed(self, processor: Processor) -> None:
        """Remove the topics."""
        self.health.ended(processor)
        output = self._outputs.pop(processor, None)
        if output is not None:
            for topic in output.topics:
                self._node.destroy_publisher(topic.publisher)
        self._changed()


def topics_of(processor: Processor) -> list[str]:
    """Return the topics of a processor, relative to the node."""
    _, *others = processor.representation.parts
    return [f"~/{processor.name}", *(f"~/{processor.name}/{part.name}" for part in others)]


def check_name(name: str, reserved: Iterable[str]) -> None:
    """Raise ``e_badNewValue`` for a name of a processor that cannot be a topic, or that is one of another kind."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*", name) or len(name) > 100:
        expected = "a letter, then letters, digits and single _: it also names a topic"
    elif name in reserved:
        expected = "another name than those of the topics and services of the node"
    else:
        return
    raise ROSAFE.error("e_badNewValue", what=f"name: expected {expected}, got {name[:80]!r}")


def _coordinates(processor: Processor, axes: Iterable[str], shape: Iterable[int]) -> Iterable[Coordinate]:
    """Yield the coordinates of the axes that have numbers."""
    values: dict[str, Any] = {}
    ancestor: Processor | None = processor
    while ancestor is not None:
        values = {**ancestor.values(), **values}
        ancestor = ancestor.parent
    for axis, size in zip(axes, shape, strict=False):
        if axis in UNITS:
            found = axis_coordinates(values, KINDS[processor.kind], axis, size)
            yield Coordinate(name=axis, unit=UNITS[axis], values=numbers(found))
