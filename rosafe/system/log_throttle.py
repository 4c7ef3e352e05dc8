"""Log with a limited rate: the first event of a kind is logged at once, repetitions once per period."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass

PERIOD = 1.0  # seconds in which a kind of event gets one line
MAX_KINDS = 50  # at a time; further kinds are counted as one

_NUMBER = re.compile(r"\d+(\.\d+)?")


@dataclass
class _SuppressedEvent:
    """The events of one kind since its last line."""

    count: int = 0
    last: str = ""


class ThrottledLog:
    """A log that writes the first event of a kind immediately and counts the events that follow within `period`.

    At the end of the period, the last of these is written with their number. Lines that differ only in numbers are of
    one kind. Thread-safe.

    Parameters
    ----------
    write : callable
        Function that writes one line, such as `rospy.logwarn`.
    period : float
        Duration in s.
    """

    def __init__(self, write: Callable[[str], object], period: float = PERIOD) -> None:
        self._write = write
        self._period = period
        self._suppressed: dict[str, _SuppressedEvent] = {}
        self._lock = threading.Lock()

    def __call__(self, line: str, kind: str = "") -> None:
        """Report one event; `kind` is by default the line without its numbers."""
        kind = kind or _NUMBER.sub("#", line)
        with self._lock:
            if kind not in self._suppressed and len(self._suppressed) >= MAX_KINDS:
                kind = ""
            suppressed = self._suppressed.get(kind)
            if suppressed is not None:
                suppressed.count += 1
                suppressed.last = line
                return
            self._start_period(kind)
        self._write(line)

    def _start_period(self, kind: str) -> None:
        self._suppressed[kind] = _SuppressedEvent()
        timer = threading.Timer(self._period, self._end_period, (kind,))
        timer.daemon = True
        try:
            timer.start()
        except RuntimeError:  # no thread is available: the next event gets a line too
            del self._suppressed[kind]

    def _end_period(self, kind: str) -> None:
        with self._lock:
            suppressed = self._suppressed.pop(kind)
            if suppressed.count:
                self._start_period(kind)
        if suppressed.count:
            self._write(f"{suppressed.last} ({suppressed.count} like it in {self._period:g} s)")
