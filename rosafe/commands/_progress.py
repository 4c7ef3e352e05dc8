"""Progress of work on files: one live line on a terminal, otherwise a plain line now and then."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TextIO

from tqdm import tqdm

from rosafe.system.terminal import printable

LIVE_SECONDS = 0.1  # minimum time between two updates of the live line
PLAIN_SECONDS = 10.0  # minimum time between two plain lines
_PLAIN = "{percentage:3.0f} %{postfix}  {remaining} left"
_LIVE = "[{bar:24}] " + _PLAIN


class ProgressDisplay:
    """Display of the progress of several files together.

    Parameters
    ----------
    stream : text file
        The output; a live line is drawn if it is a terminal.
    sizes : sequence of float
        The weight of each file.
    quiet : bool
        Show messages only.
    """

    def __init__(self, stream: TextIO, sizes: Sequence[float], quiet: bool) -> None:
        tqdm.monitor_interval = 0  # no extra thread, because the command forks
        self._stream = stream
        self._sizes = [max(size, 1.0) for size in sizes]
        self._fractions = [0.0] * len(sizes)
        self._ended = self._computed = 0
        live = stream.isatty()
        self._bar = tqdm(
            total=sum(self._sizes),
            file=stream if live else _LineWriter(stream),
            disable=quiet,
            leave=False,
            delay=0.0 if live else PLAIN_SECONDS,
            mininterval=LIVE_SECONDS if live else PLAIN_SECONDS,
            miniters=0,
            smoothing=0,
            dynamic_ncols=live,
            ascii="-#",
            bar_format=_LIVE if live else _PLAIN,
        )

    def update(self, index: int, fraction: float, last: bool = False, skipped: bool = False) -> None:
        """Set the finished `fraction` of a file; `last` marks its end, `skipped` a file that needed no work."""
        step = self._sizes[index] * (fraction - self._fractions[index])
        self._fractions[index] = fraction
        self._ended += last
        self._computed += last and not skipped
        if self._bar.disable:
            return
        if skipped:
            self._bar.initial += self._sizes[index]  # the estimate of the remaining time ignores it
        if len(self._sizes) > 1:
            text = f"{self._ended} of {len(self._sizes)} files"
            elapsed = self._bar.format_dict["elapsed"]
            if self._computed and elapsed > 0:
                text += f", {self._computed / elapsed:.3g} files/s"
            self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(step)

    def message(self, text: str) -> None:
        """Write a line that remains above the live line."""
        self._bar.clear()
        self._stream.write(printable(text) + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Remove the live line."""
        self._bar.close()


class _LineWriter:
    """Text file for tqdm that writes each new state of the bar as a line of its own."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> None:
        if line := text.strip():
            self._stream.write(f"{line}\n")

    def flush(self) -> None:
        self._stream.flush()
