"""Detects that a reader of the audio ring does not keep up with the stream, and names a block size that would."""

from __future__ import annotations

from collections.abc import Callable

LAG_SECONDS = 0.4  # for which whole blocks may wait without a break
BLOCK_SIZES = (110, 220, 441, 882, 2205, 4410, 12000)  # frames; those that are proposed
HEADROOM = 3.0  # how much longer a proposed block lasts than a block has taken


class LagMonitor:
    """Follows how many frames wait for one reader.

    A reader that takes its blocks in time leaves less than a whole block waiting after each audio message. If at least
    one block has waited without a break for `LAG_SECONDS`, the tree does not keep up.

    Parameters
    ----------
    sample_rate : float
        In Hz.
    frames_per_block : int
        What the reader takes at a time.
    report : callable
        Gets one line when the tree falls behind, and one when it has caught up.
    """

    def __init__(self, sample_rate: float, frames_per_block: int, report: Callable[[str], None]) -> None:
        self.problem = ""  # one line while the tree does not keep up
        self._sample_rate = sample_rate
        self._frames_per_block = frames_per_block
        self._report = report
        self._behind_since: float | None = None
        self._blocks = 0  # read since then

    def block_read(self) -> None:
        """Count a block that the reader has taken."""
        self._blocks += 1

    def update(self, waiting: int, now: float) -> None:
        """Note that `waiting` frames wait for the reader at the time `now` (s, monotonic)."""
        if waiting < self._frames_per_block:
            if self.problem:
                self.problem = ""
                self._report("Audio: the tree has caught up")
            self._behind_since = None
        elif self._behind_since is None:
            self._behind_since, self._blocks = now, 0
        elif not self.problem and now - self._behind_since >= LAG_SECONDS:
            self.problem = self._describe(waiting, (now - self._behind_since) / max(self._blocks, 1))
            self._report(f"Audio: {self.problem}")

    def _describe(self, waiting: int, block_seconds: float) -> str:
        frames, rate = self._frames_per_block, self._sample_rate
        return (
            f"the tree does not keep up: {waiting / rate:.2f} s of sound wait; a block of {frames} frames lasts "
            f"{1e3 * frames / rate:.3g} ms and takes {1e3 * block_seconds:.3g} ms; {self._remedy(block_seconds)}"
        )

    def _remedy(self, block_seconds: float) -> str:
        # Most of the time of a short block does not depend on its length, so a longer one takes about as long.
        wanted = max(HEADROOM * block_seconds * self._sample_rate, self._frames_per_block + 1)
        longer = next((size for size in BLOCK_SIZES if size >= wanted), None)
        less = "use fewer processors or channels"
        if longer is None:
            return f"longer blocks do not help: {less}"
        advice = f"call InputProc with nFramesPerBlock {longer}"
        return advice if self._frames_per_block < BLOCK_SIZES[3] else f"{advice}, or {less}"
