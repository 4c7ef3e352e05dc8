"""The state of the localizer: its activity or the missing part, in the log at each change and in /diagnostics."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Mapping
from typing import Any

from rosafe.localization.live import ERROR, OK, WARN
from rosafe.system.log_throttle import ThrottledLog
from rosafe.system.terminal import printable

LOG_SECONDS = 10.0  # in which problems that differ only in numbers are logged once


class NodeStatus:
    """The state of the localizer: the worst state of its parts, among several the newest.

    Parameters
    ----------
    changed : callable
        Called after each change.
    log : mapping
        The function that writes a line to the log, for each level.
    """

    def __init__(self, changed: Callable[[], None], log: Mapping[int, Callable[[str], object]]) -> None:
        self._changed = changed
        self._log_error = log[ERROR]
        self._lock = threading.Lock()
        self._causes: dict[str, tuple[int, str]] = {}  # by part of the node
        self._values: dict[str, str] = {}
        self._logged = ""
        self._log = {level: ThrottledLog(write, LOG_SECONDS if level else 1.0) for level, write in log.items()}
        self._errors: set[tuple[type, str]] = set()  # unexpected ones that are in the log: class and place

    def set(self, part: str, level: int, text: str, log: bool = True) -> None:
        """Set the state of a part of the node; a new text of the whole node is logged."""
        with self._lock:
            self._causes.pop(part, None)
            self._causes[part] = level, text
            level, text = self._summary()
            new = text != self._logged
            if new and log:
                self._logged = text
        if new:
            if log:
                self._log[level](text)
            self._changed()

    def set_error(self, part: str, problem: Exception) -> None:
        """Report an unexpected error of a part that continues; the log has its traceback once."""
        place = str(traceback.extract_tb(problem.__traceback__)[-1:])
        new = (type(problem), place) not in self._errors
        self._errors.add((type(problem), place))
        if new:
            self._log_error("".join(traceback.format_exception(problem)))
        self.count("unexpected errors", 1)
        text = f"unexpected error, the node tries again: {type(problem).__name__}: {printable(str(problem))}"
        self.set(part, ERROR, text, log=new)

    def warn(self, line: str, kind: str) -> None:
        """Write a line of a kind to the log, once in some seconds."""
        self._log[WARN](line, kind)

    def clear(self, part: str) -> None:
        """Remove the state of a part."""
        with self._lock:
            self._causes.pop(part, None)

    def state(self) -> tuple[int, str]:
        """Return the worst level and its newest text."""
        with self._lock:
            return self._summary()

    def value(self, key: str, value: Any) -> None:
        """Set an entry of /diagnostics."""
        self._values[key] = str(value)

    def count(self, key: str, number: int) -> None:
        """Add to a number in /diagnostics."""
        self._values[key] = str(int(self._values.get(key, 0)) + number)

    def _summary(self) -> tuple[int, str]:
        """Return the worst level and its newest text."""
        if not self._causes:
            return OK, "starting"
        worst = max(level for level, _ in self._causes.values())
        return worst, next(text for level, text in reversed(self._causes.values()) if level == worst)

    def report(self, status: Any) -> Any:
        """Fill in a status of /diagnostics."""
        with self._lock:
            level, text = self._summary()
        status.summary(level, text)
        for key, value in list(self._values.items()):
            status.add(key, value)
        return status
