"""The progress display: one line that is updated on a terminal, or one line per second in a file."""

from __future__ import annotations

import sys
import time

import numpy as np

from rosafe.demo.direction import DirectionFinder
from rosafe.demo.recorder import PortRecorder
from rosafe.view import report

REFRESH_SECONDS = 0.1
LINE_SECONDS = 1.0
WINDOW_SECONDS = 0.25  # of the newest audio, for levels
BAR = 7  # characters, so that the line fits into 80 columns
QUIET_DB, LOUD_DB = -70.0, -10.0


class Progress:
    """The display of a recording of `seconds` seconds."""

    def __init__(self, recorder: PortRecorder, finder: DirectionFinder | None, seconds: float) -> None:
        self._recorder, self._finder = recorder, finder
        self._seconds = seconds
        self._live = sys.stdout.isatty()
        self._next = 0.0

    def show(self, elapsed: float) -> None:
        """Show the progress if the refresh period has passed."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + (REFRESH_SECONDS if self._live else LINE_SECONDS)
        levels = [report.level_db(samples) for samples in self._recorder.ports["input"].newest(WINDOW_SECONDS)]
        azimuth = self._finder.azimuth if self._finder else float("nan")
        if self._live:
            left, right = (_bar(level) for level in levels)
            line = f"{elapsed:5.1f}/{self._seconds:.1f} s  L {left[::-1]}|{right} R  {report.ruler({'@': azimuth})}"
            print(f"\r{line}\x1b[K", end="", flush=True)
        else:
            print(
                f"{elapsed:5.1f} s   left {levels[0]:6.1f} dB   right {levels[1]:6.1f} dB   "
                f"source {report.side(azimuth)}",
                flush=True,
            )

    def close(self) -> None:
        """End the line."""
        if self._live:
            print(flush=True)


def _bar(level: float) -> str:
    filled = round(float(np.clip((level - QUIET_DB) / (LOUD_DB - QUIET_DB), 0, 1)) * BAR)
    return "#" * filled + "." * (BAR - filled)
