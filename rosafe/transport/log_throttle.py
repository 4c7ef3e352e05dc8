"""One line in the log for each event, and one line a second for a storm of them."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass

PERIOD = 1.0  # seconds in which a kind of event gets one line
KINDS = 50  # at once; what goes beyond is of one kind

_NUMBER = re.compile(r"\d+(\.\d+)?")


@dataclass
class _SuppressedEvent:
    """What came of one kind since its last line."""

    count: int = 0
    last: str = ""


class ThrottledLog:
    """Writes lines about events, of each kind at once where it is the first in a second.

    Those that follow within the second are counted, and the last of them is written with their number when the second
    is over. Lines that differ in numbers alone are of one kind. Safe from any thread.

    Parameters
    ----------
    write : callable
        Takes one line, such as `rospy.logwarn`.
    period : float
        The second.
    """

    def __init__(self, write: Callable[[str], None], period: float = PERIOD) -> None:
        self._write = write
        self._period = period
        self._held: dict[str, _SuppressedEvent] = {}
        self._lock = threading.Lock()

    def __call__(self, line: str, kind: str = "") -> None:
        """Report one event, of a `kind` that need not be told by the line."""
        kind = kind or _NUMBER.sub("#", line)
        with self._lock:
            if kind not in self._held and len(self._held) >= KINDS:
                kind = ""
            held = self._held.get(kind)
            if held is not None:
                held.count += 1
                held.last = line
                return
            self._hold(kind)
        self._write(line)

    def _hold(self, kind: str) -> None:
        self._held[kind] = _SuppressedEvent()
        timer = threading.Timer(self._period, self._release, (kind,))
        timer.daemon = True
        try:
            timer.start()
        except RuntimeError:  # no thread is left: the next one gets a line too
            del self._held[kind]

    def _release(self, kind: str) -> None:
        with self._lock:
            held = self._held.pop(kind)
            if held.count:
                self._hold(kind)
        if held.count:
            self._write(f"{held.last} ({held.count} like it in {self._period:g} s)")
