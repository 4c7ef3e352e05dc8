"""The recording loop: from a source to an output and a level meter. Does not use ROS."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from rosafe.audio.devices import SoundSource
from rosafe.audio.devices.base import loss_text, take_remarks, wall_time_ns
from rosafe.audio.files.levels import LevelMeter
from rosafe.ros1.bass.recording.outputs import Output


class SoundRecorder:
    """One recording.

    Parameters
    ----------
    source : SoundSource
        Open; the caller closes it.
    output : Output or None
        Destination of the sound.
    frames : int or None
        Number of frames to record; None for all.
    show : callable
        Called with each piece of sound, int32 (2, n), and the number of frames lost so far.
    report : callable
        Called with a line about each loss, and about sound that the source replaces or does not read.

    Attributes
    ----------
    frames : int
        Number of frames recorded so far, including silence for lost frames.
    lost : int
        Number of frames that the source has lost.
    levels : LevelMeter
        Levels of the recording.
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
        """Record until the requested length, a stop, or the end of the source; return whether the source has ended.

        Raises ComponentError if the source fails, and OSError if the output fails.
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
        for text in take_remarks(self._source):
            self._report(text)
