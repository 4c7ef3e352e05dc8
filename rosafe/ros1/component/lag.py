"""Detection of a reader of the audio ring that does not keep up with the stream, and of a sufficient block size."""

from __future__ import annotations

from collections.abc import Callable

from rosafe.declarations.block_length import DEFAULT_FRAMES_PER_BLOCK

LAG_SECONDS = 0.4  # for which at least one whole block may be waiting
BLOCK_SIZES = (110, 220, 441, 882, 2205, 4410, DEFAULT_FRAMES_PER_BLOCK)  # frames; the proposed sizes
HEADROOM = 3.0  # duration of a proposed block, divided by the computing time of a block


class LagMonitor:
    """Monitors the number of frames that wait for one reader.

    After each audio message, less than a whole block waits for a reader that keeps up. If at least one block has been
    waiting for `LAG_SECONDS` without a break, the tree does not keep up.

    Parameters
    ----------
    sample_rate : float
        In Hz.
    frames_per_block : int
        Block size of the reader.
    report : callable
        Called with one line when the tree falls behind, and when it has caught up.
    """

    def __init__(self, sample_rate: float, frames_per_block: int, report: Callable[[str], None]) -> None:
        self.problem = ""  # one line while the tree does not keep up
        self._sample_rate = sample_rate
        self._frames_per_block = frames_per_block
        self._report = report
        self._behind_since: float | None = None
        self._blocks = 0  # read since then

    def blocks_read(self, count: int) -> None:
        """Count blocks that were read."""
        self._blocks += count

    def update(self, waiting: int, now: float) -> None:
        """Update the number of waiting frames at the time `now` (s, monotonic)."""
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
        # Most of the computing time of a short block is independent of its length: a longer one takes about as long.
        required = max(HEADROOM * block_seconds * self._sample_rate, self._frames_per_block + 1)
        longer = next((size for size in BLOCK_SIZES if size >= required), None)
        less = "use fewer processors or channels"
        if longer is None:
            return f"longer blocks do not help: {less}"
        advice = f"call InputProc with nFramesPerBlock {longer}"
        return advice if self._frames_per_block < BLOCK_SIZES[3] else f"{advice}, or {less}"
