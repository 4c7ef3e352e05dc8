"""What is shown while it runs: one line that is drawn anew on a terminal, a line per second elsewhere."""

from __future__ import annotations

import sys
import time

import numpy as np

from rosafe.demo.recorder import PortRecorder
from rosafe.view import estimates, report

REFRESH_SECONDS = 0.1
LINE_SECONDS = 1.0
LOOK_BACK = 0.25  # s; levels and side are of the newest sound
BAR = 7  # the line fits into 80 columns
QUIET_DB, LOUD_DB = -70.0, -10.0


class Progress:
    """The display of one recording of `seconds` seconds."""

    def __init__(self, recorder: PortRecorder, seconds: float) -> None:
        self._recorder = recorder
        self._seconds = seconds
        self._live = sys.stdout.isatty()
        self._next = 0.0

    def show(self, elapsed: float) -> None:
        """Show where things are, if it is time to."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + (REFRESH_SECONDS if self._live else LINE_SECONDS)
        levels = [report.level_db(samples) for samples in self._recorder.newest_sound(LOOK_BACK)]
        azimuth = self._azimuth()
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

    def _azimuth(self) -> float:
        shown = self._recorder.representations().tail(LOOK_BACK)
        heard = estimates.azimuth_from_ild(shown) if len(shown.times) else np.zeros(0)
        heard = heard[np.isfinite(heard)]
        return float(np.median(heard)) if len(heard) else float("nan")

    def close(self) -> None:
        """Leave the line."""
        if self._live:
            print(flush=True)


def _bar(level: float) -> str:
    filled = round(float(np.clip((level - QUIET_DB) / (LOUD_DB - QUIET_DB), 0, 1)) * BAR)
    return "#" * filled + "." * (BAR - filled)
