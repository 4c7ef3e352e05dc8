"""When the frames of a stream of sound were captured: a straight line below the stamps that come with it.

A stamp is read after the sound has come, so whatever happens on the way only ever makes it later: threads that wait,
chunks that pile up. The line lies below all stamps of the last minute and as close to them as that allows, which is the
linear programme of Moon, Skelly and Towsley (INFOCOM 1999) for the skew of clocks; its solution is the edge of the
stamps' lower convex hull that spans their mean.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

WINDOW_SECONDS = 60.0
BIN_SECONDS = 0.25  # of each, the stamp that is earliest is kept
LEARNING_SECONDS = 5.0  # of stamps before the rate is fitted too; until then it is the nominal one
MAX_SKEW = 1e-3  # of a clock, relatively; those of sound cards have a tenth of that
SLEW = 2e-3  # seconds per second that the line moves at most towards a new fit, and
STEP_SECONDS = 1e-4  # from one answer to the next
SETTLING_SECONDS = 1.0  # after a beginning, when it may jump
SET_SECONDS = 0.05  # a stamp that is so much too early, or some seconds of them too late, tell of a clock that was set
LATE_BINS = 20


class LinearClock(NamedTuple):
    """Frame `frame` was captured at `time` (s), others at `rate` (Hz) before and after."""

    frame: float
    time: float
    rate: float

    def at(self, frame: float) -> float:
        """When another frame was captured (s)."""
        return self.time + (frame - self.frame) / self.rate


class FrameTime:
    """The line of one stream; times are in s since 1970. Not safe from several threads."""

    def __init__(self) -> None:
        self.begin(0.0)

    def begin(self, rate: float) -> None:
        """A new stream at `rate` Hz, of which nothing is known."""
        self._nominal = rate
        self._points: deque[tuple[int, float]] = deque()  # of each bin the earliest, as the nominal rate has it
        self._first = 0  # frame at the beginning
        self._last_output: LinearClock | None = None  # the last time
        self._fitted: LinearClock | None = None  # to the points as they are

    def add(self, frame: int, time: float) -> None:
        """Frame `frame` of the stream, later than those before, was captured at `time` (s) or a little earlier."""
        if self._nominal <= 0 or frame <= 0:
            return
        if self._points:
            within = self._bin(frame) == self._bin(self._points[-1][0])
            if within and self._residual(frame, time) > self._residual(*self._points[-1]):
                return  # most of those of short chunks
            if self._was_set(frame, time):
                self.begin(self._nominal)
        self._fitted = None
        if not self._points:
            self._first = frame
        elif self._bin(frame) == self._bin(self._points[-1][0]):
            self._points.pop()
        self._points.append((frame, time))
        while frame - self._points[0][0] > WINDOW_SECONDS * self._nominal:
            self._points.popleft()

    def _bin(self, frame: int) -> int:
        return int((frame - self._first) / (BIN_SECONDS * self._nominal))

    def _residual(self, frame: int, time: float) -> float:
        """How late a stamp is, but for something that is the same for all."""
        return time - (frame - self._first) / self._nominal

    def _was_set(self, frame: int, time: float) -> bool:
        """Whether somebody has set the clock, back or forth."""
        if len(self._points) < 2:
            return False
        line = self._fit()
        late = list(self._points)[-LATE_BINS:]
        if time < line.at(frame) - SET_SECONDS:
            return True
        return len(self._points) > LATE_BINS and all(stamp > line.at(n) + SET_SECONDS for n, stamp in late)

    def line(self, frame: int) -> LinearClock | None:
        """The line for frames about `frame`, with its time; None where no stamp has come yet.

        From one answer to the next it moves little, and so times grow with frames.
        """
        if not self._points:
            return None
        fit = self._fit()
        time = fit.at(frame)
        if self._last_output is not None and frame > self._last_output.frame and not self._settling(frame):
            goes_on = self._last_output.at(frame)
            most = min(STEP_SECONDS, SLEW * (frame - self._last_output.frame) / self._nominal)
            time = min(max(time, goes_on - most), goes_on + most)
        self._last_output = LinearClock(frame, time, fit.rate)
        return self._last_output

    def _settling(self, frame: int) -> bool:
        return frame - self._first < SETTLING_SECONDS * self._nominal

    def _fit(self) -> LinearClock:
        if self._fitted is None:
            self._fitted = self._refit()
        return self._fitted

    def _refit(self) -> LinearClock:
        newest = self._points[-1][0]
        if newest - self._points[0][0] >= LEARNING_SECONDS * self._nominal:
            (first, begin), (last, end) = self._edge()
            rate = (last - first) / max(end - begin, 1e-9)
            if abs(rate / self._nominal - 1) < MAX_SKEW:
                return LinearClock(first, begin, rate)
        earliest = min(self._residual(frame, time) for frame, time in self._points)
        return LinearClock(self._first, earliest, self._nominal)

    def _edge(self) -> tuple[tuple[int, float], tuple[int, float]]:
        """The two neighbours on the lower convex hull of the points that have the mean of all between them."""
        hull: list[tuple[int, float]] = []
        for point in self._points:
            while len(hull) > 1 and _is_above(hull[-2], hull[-1], point):
                hull.pop()
            hull.append(point)
        total, count = sum(frame for frame, _ in self._points), len(self._points)
        right = next(k for k, (frame, _) in enumerate(hull) if frame * count >= total)  # whole numbers are exact
        return hull[right - 1], hull[right]


def _is_above(first: tuple[int, float], point: tuple[int, float], last: tuple[int, float]) -> bool:
    """Whether `point` lies on or above the line from `first` to `last`."""
    (n0, t0), (n1, t1), (n2, t2) = first, point, last
    return (t1 - t0) * (n2 - n0) >= (t2 - t0) * (n1 - n0)
