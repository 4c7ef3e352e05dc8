"""For clients in Python on the ROS graph: arrays where the generated classes have lists, and the time of any frame."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any, NamedTuple

KEPT = 600  # lines of a FrameClock: two minutes and more with the default block


def array_msg(generated: Any) -> Any:
    """As `rosafe.component.serialization.array_msg`: the message class to use in place of a generated one."""
    from rosafe.component import serialization  # which needs ROS, and generated messages

    return serialization.array_msg(generated)


def array_srv(generated: Any) -> Any:
    """As `rosafe.component.serialization.array_srv`: the service class to use in place of a generated one."""
    from rosafe.component import serialization

    return serialization.array_srv(generated)


class Moment(NamedTuple):
    """When something was captured.

    Attributes
    ----------
    wall : float
        In s since 1970, by the clock of the machine that captured it.
    ros : rospy.Time
        In ROS time, which with `use_sim_time` is another one.
    """

    wall: float
    ros: Any


class _Line(NamedTuple):
    frame: int
    wall: float
    rate: float
    offset: float  # of ROS time to the stamps' clock, when it came


class FrameClock:
    """Tells when frames were captured, from the port `frameTime` of a rosAFE; docs/time.md has the formulas.

    Make it after `rospy.init_node`.

    Parameters
    ----------
    node : str
        The rosAFE.
    """

    def __init__(self, node: str = "rosAFE") -> None:
        import rospy

        from rosafe.component import generate

        generate.ensure_messages()
        from rosAFE.msg import rosAFE_frameTime

        self.topic = f"{node}/frameTime"
        self._lines: deque[_Line] = deque(maxlen=KEPT)
        self._come = threading.Condition()
        self._rospy = rospy
        self._subscriber = rospy.Subscriber(self.topic, rosAFE_frameTime, self._take, queue_size=100, tcp_nodelay=True)

    def close(self) -> None:
        """Listen no longer."""
        self._subscriber.unregister()

    def wait(self, timeout: float = 5.0) -> bool:
        """Wait until times are known, up to `timeout` s; whether they are."""
        with self._come:
            return self._come.wait_for(lambda: bool(self._lines), timeout)

    def time(self, frame: float) -> Moment:
        """When audio frame `frame` was captured, as bass and `lastFrameIndex` number them; between two frames, too.

        Raises
        ------
        LookupError
            Nothing has come yet.
        """
        with self._come:
            if not self._lines:
                raise LookupError(f"nothing has come on {self.topic} yet: is there an input, and sound?")
            line = next((line for line in self._lines if line.frame >= frame), self._lines[-1])
        wall = line.wall + (frame - line.frame) / line.rate
        return Moment(wall, self._rospy.Time.from_sec(max(0.0, wall + line.offset)))

    def of(self, message: Any, frame: int = -1, window: float = 0.0, hop: float = 0.0) -> Moment:
        """When the middle of a frame in a port's message was captured.

        Parameters
        ----------
        message
            Of any port of the rosAFE.
        frame : int
            Which column of the message; by default the newest. Negative ones count from the end.
        window, hop : float
            The ``wSizeSec`` and ``hSizeSec`` of its processor in s; both 0 for ports whose frames are samples.

        Raises
        ------
        LookupError
            Nothing has come on `frameTime` yet, or there is no such frame.

        Notes
        -----
        Frames begin with the first block that a processor gets. Where the hop divides the block, that says where they
        end, and the answer is exact; else it is wrong by half a hop at most.
        """
        frames = int(message.framesOnPort)
        if not -frames <= frame < frames:
            raise LookupError(f"there is no frame {frame}, the message has {frames}")
        back = -1 - frame if frame < 0 else frames - 1 - frame
        newest = int(message.lastFrameIndex) - 1  # the last audio frame that it knows of
        if hop <= 0:
            return self.time(newest - back)
        with self._come:
            lines = list(self._lines)[-2:]
        rate = lines[-1].rate if lines else 0.0
        width, step = round(window * rate), max(1, round(hop * rate))
        block = lines[-1].frame - lines[0].frame if len(lines) > 1 else 0
        left_over = -width % step if block > 0 and block % step == 0 else step / 2  # samples after the newest frame
        return self.time(newest + 1 - left_over - back * step - width / 2)

    def _take(self, message: Any) -> None:
        wall = message.stamp.to_sec()
        now, ros_now = time.time(), self._rospy.get_time()
        # Stamps of a bag that somebody plays are ROS time already; those of a bass that captures are wall-clock time.
        recorded = abs(wall - ros_now) <= abs(wall - now)
        line = _Line(int(message.frameIndex), wall, float(message.sampleRate), 0.0 if recorded else ros_now - now)
        with self._come:
            if self._lines and line.frame <= self._lines[-1].frame:  # another stream
                self._lines.clear()
            self._lines.append(line)
            self._come.notify_all()
