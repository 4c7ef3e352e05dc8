"""What the nodes tell of themselves: loads, states, and what was lost and when. Listens only while somebody looks."""

from __future__ import annotations

import re
import threading
import time
from collections import deque
from typing import Any

STALE_AFTER_SECONDS = 3.5  # since a node told of itself last; it does so every second
MAX_LOSSES = 50
MAX_DIGITS = 15  # of a counter: the page has no longer whole numbers
MAX_LOADS = 10_000  # processors
MAX_TEXT = 500  # characters
_LOAD = re.compile(r"(\S+), (\w+), (\d{1,15}) blocks, (\d{1,9}(?:\.\d{1,9})?) ms/s", re.ASCII)
# counters of rosAFE's audio, and what a rise of them means
_COUNTED = {
    "lost": "audio frames were lost on their way to rosAFE",
    "dropped": "frames of an earlier sound were dropped unread",
    "refused": "audio messages were refused",
    "breaks": "break in the sound: its windows did not fit",
}


class Health:
    """Follows /diagnostics between `listen` and `close`.

    Parameters
    ----------
    instance, bass : str
        Names of the nodes.
    """

    def __init__(self, instance: str, bass: str) -> None:
        self._rosafe, self._bass = instance, bass
        self._names = (f"{instance}: audio", f"{instance}: processors", f"{bass}: capture")
        self._lock = threading.Lock()
        self._subscriber: Any = None
        self._ended = False
        self._values: dict[str, dict[str, str]] = {}
        self._told: dict[str, float] = {}
        self._losses: deque[dict[str, Any]] = deque(maxlen=MAX_LOSSES)

    def listen(self) -> None:
        """Begin; may block for a moment."""
        import rospy
        from diagnostic_msgs.msg import DiagnosticArray

        with self._lock:
            if self._subscriber is None and not self._ended:
                self._subscriber = rospy.Subscriber("/diagnostics", DiagnosticArray, self._take, queue_size=10)

    def close(self, for_good: bool = False) -> None:
        """Listen no longer, or never again, whoever is about to begin."""
        with self._lock:
            self._ended = self._ended or for_good
            if self._subscriber is not None:
                self._subscriber.unregister()
                self._subscriber = None
            self._values.clear()
            self._told.clear()

    def _take(self, message: Any) -> None:
        now = time.monotonic()
        for status in message.status:
            if status.name not in self._names:  # of other nodes, which are as many as there may be
                continue
            values = {entry.key: entry.value[:MAX_TEXT] for entry in status.values[:MAX_LOADS]}
            with self._lock:
                if self._subscriber is None:
                    return
                before, self._values[status.name] = self._values.get(status.name), values
                self._told[status.name] = now
            if before is not None:
                self._compare(status.name, before, values)

    def _compare(self, name: str, before: dict[str, str], values: dict[str, str]) -> None:
        """Note what has been lost between two messages of a node."""
        if name == f"{self._rosafe}: audio":
            for counter, what in _COUNTED.items():
                if (more := _number(values, counter) - _number(before, counter)) > 0:
                    self.note(f"{more} {what}")
        elif name == f"{self._bass}: capture":
            more = _number(values, "lost frames") - _number(before, "lost frames")
            if more > 0:
                self.note(f"{more} frames were lost at the sound card")

    def note(self, what: str) -> None:
        """Remember a loss, with the time of day."""
        with self._lock:
            self._losses.append({"at": time.time(), "what": what})

    def status(self) -> dict[str, Any]:
        """What the page shows."""
        now = time.monotonic()
        with self._lock:
            fresh = {name for name, at in self._told.items() if now - at < STALE_AFTER_SECONDS}
            capture = self._values.get(f"{self._bass}: capture", {})
            audio = self._values.get(f"{self._rosafe}: audio", {})
            tree = self._values.get(f"{self._rosafe}: processors", {})
            device = capture.get("device", "none")
            return {
                "bass": f"{self._bass}: capture" in fresh,
                "rosafe": f"{self._rosafe}: audio" in fresh,
                "device": "" if device == "none" else device,
                "lastEnd": capture.get("last end", ""),
                "lost": _number(audio, "lost") + _number(audio, "dropped") + _number(capture, "lost frames"),
                "losses": list(self._losses)[::-1],
                "loads": {name: _load(text) for name, text in tree.items()},
                "failures": [text for key, text in tree.items() if key.startswith(("failed ", "slow "))],
            }


def _number(values: dict[str, str], key: str) -> int:
    text = values.get(key, "0")
    return int(text) if text.isascii() and text.isdigit() and len(text) <= MAX_DIGITS else 0


def _load(text: str) -> dict[str, Any]:
    """What rosAFE says of a processor."""
    match = _LOAD.fullmatch(text)
    if match is None:
        return {"state": text[:80], "blocks": 0, "load": 0.0}
    return {"state": match[2], "blocks": int(match[3]), "load": float(match[4])}
