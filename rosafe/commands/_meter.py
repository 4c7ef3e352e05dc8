"""Level meter: one live line on a terminal, otherwise a plain line every second."""

from __future__ import annotations

import shutil
import time
from typing import TextIO

import numpy as np

from rosafe.audio.files.levels import EARS, LevelMeter
from rosafe.system.terminal import printable

LIVE_SECONDS = 0.1  # between two updates of the live line
PLAIN_SECONDS = 1.0  # of sound, between two plain lines
FLOOR_DB = -60.0  # the left end of a bar
HOLD_SECONDS = 1.5  # duration for which the highest peak and the clipping mark are shown
_CLEAR = "\r\x1b[K"


class Meter:
    """Display of the levels of a stream of sound.

    Parameters
    ----------
    stream : text file
        The output; a live line is drawn if it is a terminal.
    sample_rate : int
        Hz.
    quiet : bool
        Show messages only.
    """

    def __init__(self, stream: TextIO, sample_rate: int, quiet: bool) -> None:
        self._stream = stream
        self._rate = sample_rate
        self._quiet = quiet
        self._live = stream.isatty()
        self._frames = 0
        self._recent = LevelMeter()  # since the last update
        self._due = 0.0
        self._held = [LevelMeter(), LevelMeter()]  # peaks of the previous and of the current hold time
        self._hold_until = 0.0

    def show(self, samples: np.ndarray, lost: int) -> None:
        """Add `samples`, int32 (2, n), and update the display; `lost` is the number of frames lost so far."""
        self._frames += samples.shape[1]
        if self._quiet:
            return
        self._recent.add(samples)
        if not self._live:
            if self._recent.frames >= PLAIN_SECONDS * self._rate:
                self._write(self._plain_line(lost) + "\n")
                self._recent = LevelMeter()
            return
        now = time.monotonic()
        if now >= self._hold_until:
            self._held, self._hold_until = [self._held[1], LevelMeter()], now + HOLD_SECONDS
        self._held[1].add(samples)
        if now >= self._due:
            self._due = now + LIVE_SECONDS
            self._write(_CLEAR + self._live_line(lost))
            self._recent = LevelMeter()

    def message(self, text: str) -> None:
        """Write a line that remains in the place of the live line."""
        self._write((_CLEAR if self._live and not self._quiet else "") + printable(text) + "\n")

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()

    def _plain_line(self, lost: int) -> str:
        ears = [
            f"{name} peak {self._recent.peak(ear):6.1f} rms {self._recent.rms(ear):6.1f}{_mark([self._recent], ear)}"
            for ear, name in enumerate(EARS)
        ]
        return "  ".join((clock(self._frames / self._rate).rjust(5), *ears, f"lost {lost}"))

    def _live_line(self, lost: int) -> str:
        """Return bars of the RMS with the highest recent peak, and peak/RMS as numbers, within the terminal's width."""
        figures = [
            f"{self._recent.peak(ear):6.1f}/{self._recent.rms(ear):6.1f}{_mark(self._held, ear):5}" for ear in range(2)
        ]
        head, tail = clock(self._frames / self._rate).rjust(5), f"lost {lost}"
        columns = shutil.get_terminal_size().columns - 1
        width = (columns - len("  ".join((head, *figures, tail))) - len("L [] R [] ")) // 2
        bars = [f" [{self._bar(ear, width)}]" if width >= 4 else "" for ear in range(2)]
        ears = [f"{name}{bar} {figure}" for name, bar, figure in zip(EARS, bars, figures, strict=True)]
        return "  ".join((head, *ears, tail))[:columns]

    def _bar(self, ear: int, width: int) -> str:
        full = _bar_length(self._recent.rms(ear), width)
        held = _bar_length(max(part.peak(ear) for part in self._held), width)
        bar = ["#"] * full + ["-"] * (width - full)
        if held:
            bar[held - 1] = "|"
        return "".join(bar)


def _mark(parts: list[LevelMeter], ear: int) -> str:
    return " CLIP" if any(part.clipped[ear] for part in parts) else ""


def _bar_length(decibels: float, width: int) -> int:
    """Return the number of filled characters in a bar of `width` characters."""
    return max(0, min(width, round((decibels - FLOOR_DB) / -FLOOR_DB * width))) if decibels > FLOOR_DB else 0


def clock(seconds: float) -> str:
    """Return a duration as ``0:07``, ``12:34`` or ``1:02:03``."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02}:{second:02}" if hours else f"{minute}:{second:02}"
