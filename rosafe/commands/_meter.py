"""A level meter: on a terminal one live line, else a plain line every second."""

from __future__ import annotations

import shutil
import time
from typing import TextIO

import numpy as np

from rosafe.bass.recording.levels import EARS, LevelMeter
from rosafe.commands._progress import clock
from rosafe.terminal import printable

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
        self._recent = LevelMeter()  # since the last look
        self._due = 0.0
        self._held = [LevelMeter(), LevelMeter()]  # peaks of the hold time before, and of the one under way
        self._turn = 0.0

    def show(self, samples: np.ndarray, lost: int) -> None:
        """Sound has passed, int32 (2, n), and `lost` frames were lost so far."""
        self._frames += samples.shape[1]
        if self._quiet:
            return
        self._recent.add(samples)
        if not self._live:
            if self._recent.frames >= PLAIN_SECONDS * self._rate:
                self._write(self._plain(lost) + "\n")
                self._recent = LevelMeter()
            return
        now = time.monotonic()
        if now >= self._turn:
            self._held, self._turn = [self._held[1], LevelMeter()], now + HOLD_SECONDS
        self._held[1].add(samples)
        if now >= self._due:
            self._due = now + LIVE_SECONDS
            self._write(_CLEAR + self._look(lost))
            self._recent = LevelMeter()

    def message(self, text: str) -> None:
        """A line that stays, in the place of the live one."""
        self._write((_CLEAR if self._live and not self._quiet else "") + printable(text) + "\n")

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()

    def _plain(self, lost: int) -> str:
        ears = [
            f"{name} peak {self._recent.peak(ear):6.1f} rms {self._recent.rms(ear):6.1f}{_mark([self._recent], ear)}"
            for ear, name in enumerate(EARS)
        ]
        return "  ".join((clock(self._frames / self._rate).rjust(5), *ears, f"lost {lost}"))

    def _look(self, lost: int) -> str:
        """Bars of the RMS with the highest peak of late, and peak/RMS as numbers, in the terminal's width."""
        looks = [
            f"{self._recent.peak(ear):6.1f}/{self._recent.rms(ear):6.1f}{_mark(self._held, ear):5}" for ear in range(2)
        ]
        head, tail = clock(self._frames / self._rate).rjust(5), f"lost {lost}"
        columns = shutil.get_terminal_size().columns - 1
        width = (columns - len("  ".join((head, *looks, tail))) - len("L [] R [] ")) // 2
        bars = [f" [{self._bar(ear, width)}]" if width >= 4 else "" for ear in range(2)]
        ears = [f"{name}{bar} {look}" for name, bar, look in zip(EARS, bars, looks, strict=True)]
        return "  ".join((head, *ears, tail))[:columns]

    def _bar(self, ear: int, width: int) -> str:
        full = _place(self._recent.rms(ear), width)
        held = _place(max(part.peak(ear) for part in self._held), width)
        bar = ["#"] * full + ["-"] * (width - full)
        if held:
            bar[held - 1] = "|"
        return "".join(bar)


def _mark(parts: list[LevelMeter], ear: int) -> str:
    return " CLIP" if any(part.clipped[ear] for part in parts) else ""


def _place(decibels: float, width: int) -> int:
    """How many of a bar's `width` characters are filled."""
    return max(0, min(width, round((decibels - FLOOR_DB) / -FLOOR_DB * width))) if decibels > FLOOR_DB else 0
