"""The time at which frames of an audio stream were captured: a linear clock, fitted to the stamps of its messages.

A stamp is taken after the audio has arrived, so that every delay (a waiting thread, queued chunks) makes it later and
never earlier. The line is therefore fitted below all stamps of the last minute and as close to them as possible. This
is the linear programme of Moon, Skelly and Towsley (INFOCOM 1999) for the skew of clocks. Its solution is the edge of
the stamps' lower convex hull that spans their mean.
"""

from __future__ import annotations

import itertools
from collections import deque
from typing import NamedTuple

WINDOW_SECONDS = 60.0
BIN_SECONDS = 0.25  # only the earliest stamp of each bin is kept
LEARNING_SECONDS = 5.0  # of stamps before the rate is fitted too; until then the nominal rate is used
MAX_SKEW = 1e-3  # relative, of a clock; those of sound cards have a tenth of this
SLEW = 2e-3  # maximum speed at which the line moves towards a new fit, in seconds per second, and
STEP_SECONDS = 1e-4  # its maximum step between two calls
SETTLING_SECONDS = 1.0  # after the beginning of a stream, when the line may jump
SET_SECONDS = 0.05  # if one stamp is earlier than the line by this, or LATE_BINS are later, the clock has been set
LATE_BINS = 20


class LinearClock(NamedTuple):
    """A clock: frame `frame` was captured at `time` (s), and others at `rate` (Hz) before and after it."""

    frame: float
    time: float
    rate: float

    def at(self, frame: float) -> float:
        """Return the time at which another frame was captured (s)."""
        return self.time + (frame - self.frame) / self.rate


class FrameTime:
    """The clock of one stream; times are in s since 1970. Not thread-safe."""

    def __init__(self) -> None:
        self.begin(0.0)

    def begin(self, rate: float) -> None:
        """Begin a new stream at `rate` Hz."""
        self._nominal = rate
        self._points: deque[tuple[int, float]] = deque()  # the earliest of each bin, relative to the nominal rate
        self._first = 0  # frame at the beginning
        self._last_output: LinearClock | None = None
        self._fitted: LinearClock | None = None  # to the present points; None if they have changed

    def add(self, frame: int, time: float) -> None:
        """Add the stamp of a frame, later than all previous ones: it was captured at `time` (s) or a little earlier."""
        if self._nominal <= 0 or frame <= 0:
            return
        if self._points:
            same_bin = self._bin(frame) == self._bin(self._points[-1][0])
            if same_bin and self._residual(frame, time) >= self._residual(*self._points[-1]):
                return  # most stamps of short chunks
            line = self._fit()
            if self._was_set(line, frame, time):
                self.begin(self._nominal)
            elif same_bin:
                self._points[-1] = frame, time
                if time < line.at(frame):  # otherwise the line is still below all points, and is fitted once per bin
                    self._fitted = None
                return
        if not self._points:
            self._first = frame
        self._fitted = None
        self._points.append((frame, time))
        while frame - self._points[0][0] > WINDOW_SECONDS * self._nominal:
            self._points.popleft()

    def _bin(self, frame: int) -> int:
        return int((frame - self._first) / (BIN_SECONDS * self._nominal))

    def _residual(self, frame: int, time: float) -> float:
        """Return the delay of a stamp, up to a constant."""
        return time - (frame - self._first) / self._nominal

    def _was_set(self, line: LinearClock, frame: int, time: float) -> bool:
        """Return whether the system clock has been set, back or forth."""
        if len(self._points) < 2:
            return False
        if self._last_output is not None and time < self._last_output.at(frame) - SET_SECONDS:
            return True  # also a clock that is much slower than the sound, which the line cannot follow
        newest = itertools.islice(reversed(self._points), LATE_BINS)
        return len(self._points) > LATE_BINS and all(stamp > line.at(n) + SET_SECONDS for n, stamp in newest)

    def line(self, frame: int) -> LinearClock | None:
        """Return the clock at `frame`, or None without stamps.

        It moves little between two calls, so that times increase with frames.
        """
        if not self._points:
            return None
        fit = self._fit()
        time = fit.at(frame)
        settled = frame - self._first >= SETTLING_SECONDS * self._nominal
        if self._last_output is not None and frame > self._last_output.frame and settled:
            expected = self._last_output.at(frame)
            step = min(STEP_SECONDS, SLEW * (frame - self._last_output.frame) / self._nominal)
            time = min(max(time, expected - step), expected + step)
        self._last_output = LinearClock(frame, time, fit.rate)
        return self._last_output

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
        """Return the two neighbours on the points' lower convex hull between which the mean of all points lies."""
        hull: list[tuple[int, float]] = []
        for point in self._points:
            while len(hull) > 1 and _is_above(hull[-2], hull[-1], point):
                hull.pop()
            hull.append(point)
        total, count = sum(frame for frame, _ in self._points), len(self._points)
        right = next(k for k, (frame, _) in enumerate(hull) if frame * count >= total)  # whole numbers are exact
        return hull[right - 1], hull[right]


def _is_above(first: tuple[int, float], point: tuple[int, float], last: tuple[int, float]) -> bool:
    """Return whether `point` lies on or above the line from `first` to `last`."""
    (n0, t0), (n1, t1), (n2, t2) = first, point, last
    return (t1 - t0) * (n2 - n0) >= (t2 - t0) * (n1 - n0)
