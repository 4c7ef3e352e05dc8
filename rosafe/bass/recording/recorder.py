"""The recording loop: from a source into an output and a meter. No ROS in here."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from rosafe.bass.recording.levels import LevelMeter
from rosafe.bass.recording.outputs import Output
from rosafe.bass.sources import SoundSource
from rosafe.bass.sources.base import loss_text, wall_time_ns


class SoundRecorder:
    """One recording.

    Parameters
    ----------
    source : SoundSource
        Open; it stays the caller's to close.
    output : Output or None
        Where the sound goes.
    frames : int or None
        How many to record; None for all.
    show : callable
        Takes every piece of sound, int32 (2, n), and how many frames were lost so far.
    report : callable
        Takes a line about each loss.

    Attributes
    ----------
    frames : int
        Recorded so far, with silence for lost ones.
    lost : int
        How many of the source's frames were lost.
    levels : Levels
        Of all that was recorded.
    """

    def __init__(
        self,
        source: SoundSource,
        output: Output | None,
        frames: int | None,
        show: Callable[[np.ndarray, int], None],
        report: Callable[[str], None],
    ) -> None:
        self.frames = 0
        self.lost = 0
        self.levels = LevelMeter()
        self._source = source
        self._output = output
        self._limit = frames
        self._show = show
        self._report = report

    def run(self, stopping: threading.Event) -> bool:
        """Record until the source ends, which returns True, or enough is there, or told to stop.

        Raises ComponentError where the source fails, and OSError where the output does.
        """
        while not stopping.is_set() and self._room() > 0:
            chunk = self._source.read()
            if chunk is None:
                return not stopping.is_set()
            self._note_losses()
            gap = min(chunk.gap, self._room())
            if gap and self._output is not None:
                self._output.lose(gap)
            self.frames += gap
            samples = chunk.samples[:, : self._room()]
            left_over = chunk.samples.shape[1] - samples.shape[1]
            if self._output is not None and samples.shape[1]:
                self._output.write(samples, wall_time_ns(chunk.time - left_over / self._source.sample_rate))
            self.frames += samples.shape[1]
            self.levels.add(samples)
            self._show(samples, self.lost)
        return False

    def _room(self) -> int:
        return 2**62 if self._limit is None else self._limit - self.frames

    def _note_losses(self) -> None:
        lost = self._source.lost_frames - self.lost
        if lost > 0:
            self.lost += lost
            self._report(loss_text(lost, self.frames, self._source.sample_rate))
