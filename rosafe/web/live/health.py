"""The content of /diagnostics: loads, states and losses of the nodes. Subscribed only while a page is open."""

from __future__ import annotations

import re
import threading
import time
from collections import deque
from typing import Any

STALE_AFTER_SECONDS = 3.5  # since the last message of a node, which sends one per second
MAX_LOSSES = 50
MAX_DIGITS = 15  # of a counter: JavaScript has no longer integers
MAX_LOADS = 10_000  # processors
MAX_TEXT = 500  # characters
_LOAD = re.compile(r"(\S+), (\w+), (\d{1,15}) blocks, (\d{1,9}(?:\.\d{1,9})?) ms/s", re.ASCII)
# Counters in the audio status of rosAFE, and the text for an increase.
_AUDIO_COUNTERS = {
    "lost": "audio frames were lost between bass and rosAFE",
    "dropped": "frames of an earlier stream were discarded",
    "refused": "audio messages were rejected",
    "breaks": "interruptions of the audio: its windows did not fit together",
}


class Health:
    """Subscribes to /diagnostics between `listen` and `close`.

    Parameters
    ----------
    rosafe, bass, localizer : str
        Full names of the nodes.
    """

    def __init__(self, rosafe: str, bass: str, localizer: str) -> None:
        # The names of statuses begin with the full names of the nodes without the first slash.
        self._rosafe, self._bass = rosafe.removeprefix("/"), bass.removeprefix("/")
        self._names = (f"{self._rosafe}: audio", f"{self._rosafe}: processors", f"{self._bass}: capture")
        self._localizer_name = f"{localizer.removeprefix('/')}: localization"
        self._localizer: tuple[float, str] | None = None  # time of the message (monotonic), and its text
        self._lock = threading.Lock()
        self._subscriber: Any = None
        self._closed = False
        self._values: dict[str, dict[str, str]] = {}
        self._received_at: dict[str, float] = {}
        self._losses: deque[dict[str, Any]] = deque(maxlen=MAX_LOSSES)

    def listen(self) -> None:
        """Subscribe; may block for a moment."""
        import rospy
        from diagnostic_msgs.msg import DiagnosticArray

        with self._lock:
            if self._subscriber is None and not self._closed:
                self._subscriber = rospy.Subscriber("/diagnostics", DiagnosticArray, self._receive, queue_size=10)

    def close(self, permanent: bool = False) -> None:
        """Unsubscribe; if `permanent`, a later `listen` has no effect."""
        with self._lock:
            self._closed = self._closed or permanent
            if self._subscriber is not None:
                self._subscriber.unregister()
                self._subscriber = None
            self._values.clear()
            self._received_at.clear()

    def _receive(self, message: Any) -> None:
        for status in message.status:
            if status.name == self._localizer_name:
                self._localizer = time.monotonic(), status.message[:MAX_TEXT]
            if status.name not in self._names:
                continue
            values = {entry.key: entry.value[:MAX_TEXT] for entry in status.values[:MAX_LOADS]}
            with self._lock:
                if self._subscriber is None:
                    return
                before = self._values.get(status.name)
                self._values[status.name] = values
                self._received_at[status.name] = time.monotonic()
                if before is not None:
                    self._note_losses(status.name, before, values)

    def _note_losses(self, name: str, before: dict[str, str], values: dict[str, str]) -> None:
        """Compare two messages of a node and record its losses in between."""
        counters = {}
        if name == f"{self._rosafe}: audio":
            counters = _AUDIO_COUNTERS
        elif name == f"{self._bass}: capture":
            counters = {"lost frames": "frames were lost at the sound card"}
        for counter, text in counters.items():
            if (lost := _number(values, counter) - _number(before, counter)) > 0:
                self._losses.append({"at": time.time(), "what": f"{lost} {text}"})

    def status(self) -> dict[str, Any]:
        """Return the status as shown by the page."""
        now = time.monotonic()
        with self._lock:
            fresh = {name for name, at in self._received_at.items() if now - at < STALE_AFTER_SECONDS}
            capture = self._values.get(f"{self._bass}: capture", {})
            audio = self._values.get(f"{self._rosafe}: audio", {})
            tree = self._values.get(f"{self._rosafe}: processors", {})
            device = capture.get("device", "none")
            localizer = self._localizer
            return {
                "bass": f"{self._bass}: capture" in fresh,
                "rosafe": f"{self._rosafe}: audio" in fresh,
                "localizer": localizer[1] if localizer and now - localizer[0] < STALE_AFTER_SECONDS else None,
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
    """Parse the diagnostics of a processor."""
    match = _LOAD.fullmatch(text)
    if match is None:
        return {"state": text[:80], "blocks": 0, "load": 0.0}
    return {"state": match[2], "blocks": int(match[3]), "load": float(match[4])}
