"""The time of each frame: a `FrameClock` reads the port frameTime of a rosAFE node."""

from __future__ import annotations

import math
import struct
import threading
import time
from collections import deque
from typing import Any, NamedTuple

from rosafe.declarations.checks import is_number
from rosafe.declarations.text import short_repr
from rosafe.system.clocks import clock_difference

MAX_LINES = 600  # lines of a FrameClock: at least two minutes with the default block
MAX_RATE = 1_000_000.0  # Hz
MAX_TIME = 2.0**32 - 86400  # s since 1970; the time of a ROS message ends a day later
MAX_SKEW = 1e-3  # relative, of the measured rate of a sound card
_LINE = struct.Struct("<IIQd")  # a message: the stamp in s and ns, the frame index, the measured sample rate


class Moment(NamedTuple):
    """The time at which an audio frame was captured.

    Attributes
    ----------
    wall : float
        In s since 1970, by the clock of the capturing machine.
    ros : rospy.Time
        In ROS time, which differs if `use_sim_time` is set.
    """

    wall: float
    ros: Any


class _Line(NamedTuple):
    frame: int
    wall: float
    rate: float
    offset: float  # ROS time minus the stamps' clock, at the arrival of the message


class FrameClock:
    """Computes capture times of frames from the port `frameTime` of a rosAFE node; docs/time.md has the formulas.

    Create it after `rospy.init_node`.

    Parameters
    ----------
    node : str
        The name of the node.

    Attributes
    ----------
    problem : str
        Why the last message was ignored; empty if it was not.
    """

    def __init__(self, node: str = "rosAFE") -> None:
        import rospy

        from rosafe.ros1.component import generate

        generate.ensure_messages()
        from rosAFE.msg import rosAFE_frameTime

        self.topic = f"{node}/frameTime"
        self.problem = ""
        self._lines: deque[_Line] = deque(maxlen=MAX_LINES)
        self._arrived = threading.Condition()
        self._rospy = rospy
        message_class = type("frameTime", (rosAFE_frameTime,), {"deserialize": _read_line})
        self._subscriber = rospy.Subscriber(self.topic, message_class, self._take, queue_size=100, tcp_nodelay=True)

    def close(self) -> None:
        """Unsubscribe."""
        self._subscriber.unregister()

    def wait(self, timeout: float = 5.0) -> bool:
        """Wait up to `timeout` s until times are known. Return whether they are. ValueError if it is not a number."""
        seconds = min(checked_timeout(timeout), threading.TIMEOUT_MAX)
        with self._arrived:
            return self._arrived.wait_for(lambda: bool(self._lines), seconds)

    def covers(self, frame: int, within: float) -> bool:
        """Return whether the time of an audio frame less than `within` frames from `frame` has arrived last."""
        with self._arrived:
            return bool(self._lines) and abs(self._lines[-1].frame - frame) < within

    def time(self, frame: float) -> Moment:
        """Return the capture time of an audio frame by its frame index, which may be fractional.

        Raises
        ------
        LookupError
            No message has arrived yet.
        """
        with self._arrived:
            if not self._lines:
                raise LookupError(f"no message on {self.topic} yet; check that there is an input and sound")
            line = self._lines[-1]
            for older in reversed(self._lines):  # mostly one of the last is sought
                if older.frame < frame:
                    break
                line = older
        wall = line.wall + (frame - line.frame) / line.rate
        return Moment(wall, self._rospy.Time.from_sec(max(0.0, wall + line.offset)))

    def of(self, message: Any, frame: int = -1, window: float = 0.0, hop: float = 0.0) -> Moment:
        """Return the capture time of the middle of a frame in a port's message.

        Parameters
        ----------
        message
            From any port of the node.
        frame : int
            Column of the message; the newest by default. Negative numbers count from the end.
        window, hop : float
            ``wSizeSec`` and ``hSizeSec`` of the processor in s; both 0 for ports whose frames are samples.

        Raises
        ------
        LookupError
            No message has arrived on `frameTime` yet, or the frame does not exist.

        Notes
        -----
        Frames begin with the first block that a processor receives. If the hop divides the block, the end of the newest
        frame is known and the result is exact; otherwise the error is at most half a hop.
        """
        frames = int(message.framesOnPort)
        if not -frames <= frame < frames:
            raise LookupError(f"frame: expected {-frames} to {frames - 1}, got {frame}")
        back = -1 - frame if frame < 0 else frames - 1 - frame
        newest = int(message.lastFrameIndex) - 1  # the last audio frame that the message depends on
        if hop <= 0:
            return self.time(newest - back)
        with self._arrived:
            lines = list(self._lines)[-2:]
        rate = _nominal(lines[-1].rate) if lines else 0.0
        width, step = 2 * _whole(window * rate / 2), max(1, _whole(hop * rate))  # as in `rosafe.dsp.framing`
        block = lines[-1].frame - lines[0].frame if len(lines) > 1 else 0
        left_over = -width % step if block > 0 and block % step == 0 else step / 2  # samples after the newest frame
        return self.time(newest + 1 - left_over - back * step - width / 2)

    def _take(self, message: Any) -> None:
        self.problem = self._add(message)

    def _add(self, message: Any) -> str:
        """Add the line of a message; return a problem if it is malformed, or an empty string."""
        # rospy has one message class for each topic of a process: it is the generated one after another subscription.
        if problem := getattr(message, "problem", ""):
            return f"{self.topic}: {problem}"
        frame, rate, wall = message.frameIndex, message.sampleRate, message.stamp.to_sec()
        if not 1 <= rate <= MAX_RATE:  # NaN is not
            return f"{self.topic}: sampleRate: expected a number from 1 to {MAX_RATE:g} Hz, got {rate:g}"
        if wall >= MAX_TIME:
            return f"{self.topic}: stamp: expected a time below {MAX_TIME:.0f} s, got {wall:.0f}"
        ahead, late = clock_difference(self._rospy.get_time, time.time), time.time() - wall
        # Stamps from rosbag play are ROS time; stamps from capture are wall-clock time.
        recorded = abs(late + ahead) <= abs(late)
        line = _Line(frame, wall, rate, 0.0 if recorded else ahead)
        with self._arrived:
            if self._lines and line.frame <= self._lines[-1].frame:  # a new stream
                self._lines.clear()
            self._lines.append(line)
            self._arrived.notify_all()
        return ""


def checked_timeout(timeout: float | None) -> float:
    """Return a timeout in s; None and infinity are infinity. Raises ValueError for anything else."""
    if timeout is None or (isinstance(timeout, float) and timeout == math.inf):
        return math.inf
    if not is_number(timeout):
        raise ValueError(f"timeout: expected seconds or None, got {short_repr(timeout)}")
    return float(timeout)


def _read_line(message: Any, data: bytes) -> Any:
    """Decode a message in a fraction of the time that the generated class takes; note if it has another length."""
    if len(data) != _LINE.size:
        message.problem = f"expected {_LINE.size} bytes, got {len(data)}"
    else:
        message.stamp.secs, message.stamp.nsecs, message.frameIndex, message.sampleRate = _LINE.unpack(data)
    return message


def _whole(samples: float) -> int:
    """Return a number of samples, rounded half up."""
    return int(samples + 0.5)


def _nominal(rate: float) -> float:
    """Return the nominal sample rate (Hz) for a measured one: a usual one if it is near, otherwise a whole number."""
    usual = min((step * round(rate / step) for step in (1000, 11025)), key=lambda other: abs(other - rate))
    return float(usual if abs(usual / rate - 1) < MAX_SKEW else round(rate))
