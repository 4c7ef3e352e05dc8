"""The truth of a running scene, every 50 ms while its sound is captured."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rosafe.localization.scene import Truth  # imports scipy, which the options of bass-ros need not wait for

PERIOD = 0.05  # s of the scene between two messages
_START_POLL = 0.005  # s, until the source has started


class TruthSource(Protocol):
    """A source of sound whose true directions are known."""

    sample_rate: int
    frames: int | None  # length; None without an end

    @property
    def started(self) -> float | None:
        """When the first frame was due, on the clock of time.monotonic."""

    def truth(self, time: float) -> Truth:
        """Return the directions at a time in s from the first frame."""


class TruthLoop:
    """Calls a function with the truth of one scene every 50 ms, on a thread of its own; a context.

    Parameters
    ----------
    source : TruthSource
        The scene.
    publish : callable
        Called with the number of an audio frame, its time on the clock of time.monotonic, and the truth at it.
    """

    def __init__(self, source: TruthSource, publish: Callable[[int, float, Truth], object]) -> None:
        self._source = source
        self._publish = publish
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="scene truth", daemon=True)

    def __enter__(self) -> None:
        """Begin; the first call follows the first frame of the source."""
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        """End."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        while (started := self._source.started) is None:
            if self._stopping.wait(_START_POLL):
                return
        rate, number = self._source.sample_rate, 0
        while True:
            frame = round(number * PERIOD * rate)
            if self._source.frames is not None and frame >= self._source.frames:
                return
            moment = started + frame / rate
            if self._stopping.wait(max(0.0, moment - time.monotonic())):
                return
            self._publish(frame, moment, self._source.truth(frame / rate))
            # After a delay the thread continues with the present; it does not publish old states.
            number = max(number + 1, math.floor((time.monotonic() - started) / PERIOD))
