"""New frames of the port of a running node: its messages are sliding windows, and each shows most frames again."""

from __future__ import annotations

import dataclasses
import io
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rosafe.audio.files.windows import MAX_INDEX, MAX_WINDOW, WindowStream, mismatch, rows_of, window_error
from rosafe.declarations.text import short_repr
from rosafe.interface import BASS, KINDS, LAYOUTS
from rosafe.ros1.client.frame_clock import FrameClock, checked_timeout
from rosafe.ros1.client.tree_snapshot import TreeSnapshot
from rosafe.system.terminal import printable

READ_BYTES = 2**17  # per read: allocating a larger buffer takes longer than reading several times
FORGET_SECONDS = 3.0  # after the last bad message until the problem is hidden
ASK_SECONDS = 1.0  # between two questions to the node for the same reason
POLL_SECONDS = 0.5
AUDIO = "Audio"  # the port of bass


@dataclass(frozen=True)
class Frames:
    """New frames of a port.

    Attributes
    ----------
    data : ndarray, (..., F)
        The frames, with the axes of the representation; time is the last one. Sound of bass is int32 (2, F).
    first_frame : int
        Number of the first of them. Frame k begins k hops after the beginning of the sound, as in the result of
        `rosafe.process`; if the processor was created later, up to a hop before or after that.
    lost : int
        Frames that are missing before them, and after those of the last call.
    restarted : bool
        Whether they are the first of another stream: the sound has begun again, or the processor has changed.
    stamp : float or None
        Clock time (ROS time, s) of the middle of the first frame; None if it is not known (yet).
    kind : str
        The representation, such as `ild`, as in `rosafe.process`; `Audio` for the port of bass.
    axes : tuple of str
        Of `data`.
    rate : float
        Frames per second.
    parts : tuple of ndarray
        All parts of a representation that has several; `data` is the first one.
    index : int
        `lastFrameIndex` of the message with the last frame, which is equal for ports that belong together.
    """

    data: np.ndarray
    first_frame: int
    lost: int
    restarted: bool
    stamp: float | None
    kind: str
    axes: tuple[str, ...]
    rate: float
    parts: tuple[np.ndarray, ...]
    index: int

    @property
    def after(self) -> int:
        """Number of the frame after the last one."""
        return self.first_frame + self.data.shape[-1]

    @staticmethod
    def joined(frames: Sequence[Frames]) -> Frames:
        """Return successive frames without losses or restarts between them as one."""
        if len(frames) == 1:
            return frames[0]
        parts = tuple(np.concatenate(part, axis=-1) for part in zip(*(one.parts for one in frames), strict=True))
        return dataclasses.replace(frames[0], data=parts[0], parts=parts, index=frames[-1].index)


class PortSubscription:
    """Calls back with the new frames of a port until `close`. Bad messages are ignored, and reported once.

    Parameters
    ----------
    topic : str
        Of a port of rosAFE, or the port Audio of bass.
    callback : callable
        Called with `Frames`, on a thread of rospy.
    tree : TreeSnapshot or None
        Has the processor of the port; None: the node is asked for it.
    queue_size : int
        Number of messages that wait for the callback.
    grace_seconds : float
        Time for which bad messages are ignored without a report.

    Attributes
    ----------
    topic : str
        The full name.
    lost : int
        Frames that were missing in the received windows.

    Raises
    ------
    ValueError
        The topic is not that of a port.
    """

    def __init__(
        self,
        topic: str,
        callback: Callable[[Frames], None],
        tree: TreeSnapshot | None = None,
        queue_size: int = 1,
        grace_seconds: float = 0.0,
    ) -> None:
        import rospy

        from rosafe.ros1.component import serialization
        from rosafe.system.log_throttle import ThrottledLog

        self.topic = rospy.resolve_name(topic)
        self.lost = 0
        self._callback = callback
        self._kind, self._node = _port_of(self.topic)
        package, idl = ("bass", BASS.port(AUDIO).idl) if self._kind == AUDIO else ("rosAFE", LAYOUTS[self._kind].idl)
        self._message_class = serialization.tolerant_message_class(package, idl, MAX_WINDOW)
        self._stream = WindowStream()
        self._format: _Format | None = None
        self._restarted = False  # whether the next frames begin another stream
        # the reason and time (time.monotonic) of the last question to the node; None if it is not asked
        self._asked = ("", 0.0) if tree is None else None
        self._clock: FrameClock | None = None
        self._problems = _Problems(self.topic, grace_seconds, ThrottledLog(rospy.logwarn))
        self._lock = threading.Lock()
        self._closed = False
        if tree is not None:
            self._use(tree)
        elif self._kind != AUDIO:
            self._clock = FrameClock(self._node)
        self._subscriber = rospy.Subscriber(
            topic, self._message_class, self._receive, queue_size=queue_size, buff_size=READ_BYTES, tcp_nodelay=True
        )

    @property
    def problem(self) -> str:
        """Why the latest messages were ignored; empty if they were not."""
        return self._problems.text

    def close(self) -> None:
        """Unsubscribe."""
        self._closed = True
        self._subscriber.unregister()
        if self._clock is not None:
            self._clock.close()

    def _receive(self, message: Any) -> None:
        with self._lock:
            if self._closed:
                return
            try:
                self._accept(message)
            except (ValueError, LookupError) as problem:
                self._problems.add(str(problem))
            except Exception as fault:  # otherwise, rospy logs a traceback for each message
                self._problems.add(f"{type(fault).__name__}: {fault}")

    def _accept(self, message: Any) -> None:
        """Use a message; raise ValueError or LookupError if that is not possible."""
        if not isinstance(message, self._message_class):  # of another subscription, which has come before this one
            content = io.BytesIO()
            message.serialize(content)
            message = self._message_class().deserialize(content.getvalue())
        index = int(message.lastFrameIndex)
        problem = message.problem or (window_error(message) if self._kind == AUDIO else "")
        if not problem and index >= MAX_INDEX:
            problem = f"lastFrameIndex {index} is out of range"
        if problem:
            raise ValueError(problem)
        if not index:  # a processor that has just started, or another acquisition
            return
        if self._kind == AUDIO:
            if self._format is None or mismatch(self._stream, int(self._format.rate), message):
                self._begin(_Format(float(message.sampleRate), float(message.sampleRate), (), 1, 1))
        else:
            self._check(message)
        assert self._format is not None
        end = index - (self._kind != AUDIO)  # ports of rosAFE have the number of the next audio frame
        if end != self._stream.end:
            self._advance(message, end, self._format)

    def _advance(self, message: Any, end: int, format_: _Format) -> None:
        window = np.asarray(message.left if self._kind == AUDIO else getattr(message, _fields(self._kind)[0]))
        first = not self._stream.end and self._kind != AUDIO
        step = self._stream.advance(end, window[0] if window.ndim == 3 else window)  # one lag shows the new frames
        self._restarted |= step.restarted
        self.lost += step.lost
        parts = self._parts(message, window.shape[-1] - step.new)
        skipped = _zeros(parts) if first else 0  # the window of a processor is full of zeros at first
        parts = tuple(part[..., skipped:] for part in parts) if skipped else parts
        if not parts[0].shape[-1]:
            return
        frames = Frames(
            parts[0],
            step.first + skipped,
            step.lost,
            self._restarted,
            self._stamp(message, parts[0].shape[-1], format_),
            self._kind,
            ("ear", "time") if self._kind == AUDIO else KINDS[self._kind].parts[0].axes,
            format_.rate,
            parts,
            int(message.lastFrameIndex),
        )
        self._restarted = False
        self._callback(frames)

    def _parts(self, message: Any, start: int) -> tuple[np.ndarray, ...]:
        """Return the parts of the output from one frame of the window on, with the axes of the representation."""
        if self._kind == AUDIO:
            return (np.stack(rows_of(message, start, len(message.left))),)
        parts: dict[int, list[np.ndarray]] = {}
        for place in LAYOUTS[self._kind].places:
            if place.present:
                samples = getattr(message, place.field)[..., start:]
                parts.setdefault(place.part, []).append(samples.swapaxes(0, 1) if samples.ndim == 3 else samples)
        return tuple(np.stack(ears) if len(ears) > 1 else np.array(ears[0]) for ears in parts.values())

    def _stamp(self, message: Any, count: int, format_: _Format) -> float | None:
        """Return the clock time of the first of the newest frames of a message."""
        if self._kind == AUDIO:
            newest = message.stamp.sec + 1e-9 * message.stamp.nsec
            return newest - (count - 1) / format_.rate if newest else None
        if self._clock is None or not self._clock.covers(int(message.lastFrameIndex) - 1, format_.sample_rate):
            return None
        window, hop = (0.0, 0.0) if format_.hop == 1 else (format_.width, format_.hop)
        rate = format_.sample_rate
        return float(self._clock.of(message, -count, window / rate, hop / rate).ros.to_sec())

    # --- the processor ---

    def _begin(self, format_: _Format) -> None:
        """Begin another stream."""
        self._restarted = self._restarted or self._stream.end > 0
        self._format, self._stream = format_, WindowStream(format_.hop, format_.width)

    def _use(self, tree: TreeSnapshot) -> None:
        name = self.topic.rpartition("/")[2]
        for one in tree.processors.values():
            if one.kind == self._kind and one.topic.rpartition("/")[2] == name and one.rate and tree.sample_rate:
                found = _Format(one.rate, tree.sample_rate, one.shapes(), *tree.grid(one))
                if found != self._format:
                    self._begin(found)
                return
        raise LookupError(f"expected the port of a processor with sound, got none of this name at {self._node}")

    def _check(self, message: Any) -> None:
        """Raise ValueError or LookupError unless a message has the frames that the node describes."""
        try:
            self._compare(message)
        except (ValueError, LookupError) as problem:
            now = time.monotonic()
            if self._asked is None or (self._asked[0] == str(problem) and now < self._asked[1] + ASK_SECONDS):
                raise
            self._asked = str(problem), now
            self._use(_ask(self._node))
            self._compare(message)

    def _compare(self, message: Any) -> None:
        if self._format is None:
            raise LookupError(f"expected an answer of {self._node}/getProcessors, got none; check that the node runs")
        frames = -1
        for place in LAYOUTS[self._kind].places:
            if not place.present:
                continue
            samples, shape = getattr(message, place.field), self._format.shapes[place.part]
            if not isinstance(samples, np.ndarray):
                raise ValueError(f"{place.field}: expected rows of one length, got different ones")
            frames = samples.shape[-1] if frames < 0 else frames
            expected = (*shape[1:], *shape[:1], frames)  # of two axes, the second one is first
            if samples.shape != expected:
                raise ValueError(f"{place.field}: expected an array of shape {expected}, got {samples.shape}")
        if message.sampleRate != round(self._format.rate):
            raise ValueError(f"sampleRate: expected {self._format.rate:g} Hz, got {message.sampleRate}")


class PortReader(PortSubscription):
    """Reads a port of rosAFE, or the port Audio of bass: each frame once. Create it after `rospy.init_node`.

    Messages of ports are sliding windows. A reader finds the frames that are new, also if messages were missed: only
    frames that no received window has are lost. The node has to run: the reader asks it for the rate of the frames.

    Parameters
    ----------
    topic : str
        Such as ``/rosAFE/ildPort/ild`` or ``/bass/Audio``.
    callback : callable
        Called with `Frames` on a thread of rospy. Without it, use `read`.
    queue_size : int
        Number of messages that wait; for a further one, the oldest is dropped, and its frames count as lost.

    Attributes
    ----------
    topic : str
        The full name.
    lost : int
        Frames that were missing in the received windows.

    Raises
    ------
    ValueError
        The topic is not that of a port, or `queue_size` is not a whole number from 1 on.
    """

    def __init__(self, topic: str, callback: Callable[[Frames], None] | None = None, queue_size: int = 100) -> None:
        if isinstance(queue_size, bool) or not isinstance(queue_size, (int, np.integer)) or queue_size < 1:
            raise ValueError(f"queue_size: expected a whole number from 1 on, got {short_repr(queue_size)}")
        self._arrived = threading.Condition()
        self._waiting: deque[Frames] = deque()
        self._queue_size = queue_size
        super().__init__(topic, callback or self._keep, queue_size=queue_size)

    def read(self, timeout: float | None = None) -> Frames:
        """Return the new frames: all that wait, up to a loss or restart. Wait up to `timeout` s if there are none.

        Raises
        ------
        TimeoutError
            No frames have arrived, or the reader was closed.
        ValueError
            `timeout` is not a number.
        rospy.ROSInterruptException
            This node ends.
        """
        import rospy

        end = time.monotonic() + checked_timeout(timeout)
        with self._arrived:
            while not self._waiting:
                rest = end - time.monotonic()
                if rest <= 0 or self._closed:
                    why = f": {self.problem}" if self.problem else "; check that there is sound"
                    raise TimeoutError(f"{self.topic}: expected new frames, got none{why}")
                if rospy.is_shutdown():
                    raise rospy.ROSInterruptException(f"{self.topic}: the node ends")
                self._arrived.wait(min(rest, POLL_SECONDS))
            found = [self._waiting.popleft()]
            while self._waiting and not (self._waiting[0].lost or self._waiting[0].restarted):
                found.append(self._waiting.popleft())
        return Frames.joined(found)

    def _keep(self, frames: Frames) -> None:
        with self._arrived:
            self._waiting.append(frames)
            if len(self._waiting) > self._queue_size:
                old, following = self._waiting.popleft(), self._waiting.popleft()
                missed = 0 if following.restarted else old.lost + old.data.shape[-1]
                self._waiting.appendleft(
                    dataclasses.replace(
                        following, lost=following.lost + missed, restarted=old.restarted or following.restarted
                    )
                )
            self._arrived.notify_all()


class _Format(NamedTuple):
    """The frames of a port: rates in Hz, the shape of each part without ears, and hop and length in audio frames."""

    rate: float
    sample_rate: float
    shapes: tuple[tuple[int, ...], ...]
    hop: float
    width: int


class _Problems:
    """The latest problem of a topic, which is reported once until it has not occurred for some time."""

    def __init__(self, topic: str, grace_seconds: float, report: Callable[[str, str], None]) -> None:
        self._topic, self._grace_seconds, self._report = topic, grace_seconds, report
        self._text, self._reported = "", False
        self._first = self._last = -FORGET_SECONDS  # time.monotonic()

    def add(self, problem: str) -> None:
        now = time.monotonic()
        if now >= self._last + FORGET_SECONDS:
            self._first, self._reported = now, False
        self._last, self._text = now, printable(problem)[:300]
        if not self._reported and now >= self._first + self._grace_seconds:
            self._reported = True
            self._report(f"{self._topic}: malformed messages are ignored: {self._text}", self._topic)

    @property
    def text(self) -> str:
        """The problem if it was reported; empty if it has not occurred for some time."""
        return self._text if self._reported and time.monotonic() < self._last + FORGET_SECONDS else ""


def _port_of(topic: str) -> tuple[str, str]:
    """Return the representation of a port and the name of the node."""
    kinds = {port: kind for kind, one in KINDS.items() for port in (one.port, *one.port_aliases)}
    for levels in (2, 1):  # ildPort/NAME, inputProcPort
        node, *rest = topic.rsplit("/", levels)
        if rest and (rest[0] in kinds or rest == [AUDIO]):
            return kinds.get(rest[0], AUDIO), node
    raise ValueError(f"topic: expected a port such as /rosAFE/ildPort/ild or /bass/Audio, got {topic}")


def _fields(kind: str) -> list[str]:
    return [place.field for place in LAYOUTS[kind].places if place.present]


def _zeros(parts: Sequence[np.ndarray]) -> int:
    """Return the number of frames before the first one that is not zero in all parts."""
    nonzero = np.logical_or.reduce([(part != 0).any(axis=tuple(range(part.ndim - 1))) for part in parts])
    return int(nonzero.argmax()) if nonzero.any() else len(nonzero)


def _ask(node: str) -> TreeSnapshot:
    """Return the processors of a node. Raise LookupError if it does not answer."""
    import rospy

    from rosafe.ros1.component import generate, serialization

    generate.ensure_messages()
    from rosAFE.srv import getProcessors

    try:
        answer = rospy.ServiceProxy(f"{node}/getProcessors", serialization.array_srv(getProcessors))()
    except rospy.ServiceException as problem:
        raise LookupError(f"expected an answer of {node}/getProcessors, got none: {problem}") from None
    return TreeSnapshot.of(answer.processors)
