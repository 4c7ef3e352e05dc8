"""How far a long piece of work is, on a terminal as one live line, else as a plain line now and then."""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from typing import TextIO

from rosafe.terminal import printable

LIVE_SECONDS = 0.1  # at least, between two looks of the live line
PLAIN_SECONDS = 10.0  # between two plain lines
BAR = 24  # characters
_CLEAR = "\r\x1b[K"


class Display:
    """Shows how far several things are together.

    Parameters
    ----------
    stream : text file
        Where it goes; a live line if that is a terminal.
    sizes : sequence of float
        How much each thing counts.
    quiet : bool
        Show nothing but messages.
    """

    def __init__(self, stream: TextIO, sizes: Sequence[float], quiet: bool) -> None:
        self._stream = stream
        self._sizes = [max(size, 1.0) for size in sizes]
        self._parts = [0.0] * len(sizes)
        self._all = sum(self._sizes)
        self._done = self._skipped = 0.0  # sizes
        self._ended = self._computed = 0  # files
        self._quiet = quiet
        self._live = stream.isatty()
        self._begun = time.monotonic()
        self._due = self._begun + (0.0 if self._live else PLAIN_SECONDS)

    def update(self, index: int, part: float, last: bool = False, skipped: bool = False) -> None:
        """Of thing `index`, `part` (0 to 1) is done; with `last` it is over, with `skipped` without any work."""
        self._done += self._sizes[index] * (part - self._parts[index])
        self._parts[index] = part
        self._ended += last
        self._computed += last and not skipped
        self._skipped += self._sizes[index] * skipped
        now = time.monotonic()
        if self._quiet or now < self._due:
            return
        if self._live:
            self._due = now + LIVE_SECONDS
            width = shutil.get_terminal_size().columns - 1
            self._write(_CLEAR + f"[{self._bar()}] {self._text(now)}"[:width])
        else:
            self._due = now + PLAIN_SECONDS
            self._write(self._text(now) + "\n")

    def message(self, text: str) -> None:
        """A line that stays."""
        self.clear()
        self._write(printable(text) + "\n")
        if self._live:
            self._due = 0.0  # draw it again at once

    def clear(self) -> None:
        """Take the live line away."""
        if self._live and not self._quiet:
            self._write(_CLEAR)

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()

    def _bar(self) -> str:
        full = int(self._done / self._all * BAR + 1e-9)
        return "#" * full + "-" * (BAR - full)

    def _text(self, now: float) -> str:
        passed = now - self._begun
        text = f"{100 * self._done / self._all:3.0f} %"
        if len(self._parts) > 1:
            text += f"  {self._ended} of {len(self._parts)} files"
            if self._computed and passed > 0:
                text += f"  {self._computed / passed:.3g} files/s"
        worked = self._done - self._skipped
        if worked > 0 and passed > 1:
            text += f"  {clock(passed * (self._all - self._done) / worked)} left"
        return text


def clock(seconds: float) -> str:
    """``0:07``, ``12:34`` or ``1:02:03``."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02}:{second:02}" if hours else f"{minute}:{second:02}"


def bytes_text(count: float) -> str:
    """``12 bytes``, ``3.4 MB``."""
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count:.0f} bytes"
