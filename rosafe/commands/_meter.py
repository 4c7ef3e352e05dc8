"""A level meter: on a terminal one live line, else a plain line every second."""

from __future__ import annotations

import shutil
import time
from typing import TextIO

import numpy as np

from rosafe.bass.recording.levels import EARS, Levels
from rosafe.commands._progress import clock

LIVE_SECONDS = 0.1  # between two looks of the live line
PLAIN_SECONDS = 1.0  # of sound, between two plain lines
FLOOR_DB = -60.0  # the left end of a bar
HOLD_SECONDS = 1.5  # how long a bar shows its highest peak, and a clipping its mark
_CLEAR = "\r\x1b[K"


class Meter:
    """Shows the levels of what passes.

    Parameters
    ----------
    stream : text file
        Where it goes; a live line if that is a terminal.
    sample_rate : int
        Hz.
    quiet : bool
        Show nothing but messages.
    """

    def __init__(self, stream: TextIO, sample_rate: int, quiet: bool) -> None:
        self._stream = stream
        self._rate = sample_rate
        self._quiet = quiet
        self._live = stream.isatty()
        self._frames = 0
        self._recent = Levels()  # since the last look
        self._due = 0.0
        self._held = [Levels(), Levels()]  # peaks of the hold time before, and of the one under way
        self._turn = 0.0

    def show(self, samples: np.ndarray, lost: int) -> None:
        """Sound has passed, int32 (2, n), and `lost` frames were lost so far."""
        self._frames += samples.shape[1]
        if self._quiet:
            return
        self._recent.add(samples)
        if not self._live:
            if self._recent.frames >= PLAIN_SECONDS * self._rate:
                self._write(self._text(lost, self._recent) + "\n")
                self._recent = Levels()
            return
        now = time.monotonic()
        if now >= self._turn:
            self._held, self._turn = [self._held[1], Levels()], now + HOLD_SECONDS
        self._held[1].add(samples)
        if now >= self._due:
            self._due = now + LIVE_SECONDS
            self._write(_CLEAR + self._text(lost, self._recent)[: shutil.get_terminal_size().columns - 1])
            self._recent = Levels()

    def message(self, text: str) -> None:
        """A line that stays."""
        self.clear()
        self._write(text + "\n")

    def clear(self) -> None:
        """Take the live line away."""
        if self._live and not self._quiet:
            self._write(_CLEAR)

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()

    def _text(self, lost: int, levels: Levels) -> str:
        parts = [f"{clock(self._frames / self._rate):>5}"]
        for ear, name in enumerate(EARS):
            bar = f" [{self._bar(levels, ear)}]" if self._live else ""
            clipped = any(held.clipped[ear] for held in (*self._held, levels))
            mark = " CLIP" if clipped else "     " * self._live
            parts.append(f"{name}{bar} peak {decibel_text(levels.peak(ear))} rms {decibel_text(levels.rms(ear))}{mark}")
        return "  ".join(parts) + f"  lost {lost}"

    def _bar(self, levels: Levels, ear: int) -> str:
        width = max(6, min(30, (shutil.get_terminal_size().columns - 80) // 2))
        full = _place(levels.rms(ear), width)
        held = _place(max(part.peak(ear) for part in self._held), width)
        bar = ["#"] * full + ["-"] * (width - full)
        if held:
            bar[held - 1] = "|"
        return "".join(bar)


def _place(decibels: float, width: int) -> int:
    return max(0, min(width, round((decibels - FLOOR_DB) / -FLOOR_DB * width))) if decibels > FLOOR_DB else 0


def decibel_text(value: float) -> str:
    """``-12.3`` or ``-inf``, always as wide."""
    return f"{value:6.1f}"
