"""The source `file:PATH`: a sound file in real time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rosafe.audio.devices.base import (
    PacedSource,
    check_sample_rate,
    device_error,
    hwparams_error,
    parse_options,
    split_path,
)
from rosafe.audio.files.audiofile import NOT_FINITE, AudioFile, AudioFileError, channel_pair
from rosafe.interface import BASS
from rosafe.system.option_types import seconds, whole_number

_MAX_RATE = BASS.service("Acquire").parameter("sampleRate").maximum or 0
_OPTIONS: dict[str, Callable[[str], Any]] = {
    "channels": channel_pair,
    "loop": whole_number(0, 1),
    "start": seconds(0, 1e9),
}


class FileSource(PacedSource):
    """Two channels of a sound file, read from disk as it is played.

    Parameters
    ----------
    text : str
        ``PATH`` or ``PATH?OPTIONS``. PATH is relative to the process's folder, ``~`` is the user's home. Options:
        ``channels=3,4`` selects two channels (from 1) of a file with more, ``channels=1,1`` one for both ears;
        ``start=SECONDS`` skips the beginning; ``loop=1`` repeats the rest without a gap until a stop. If a file of
        this whole name exists, a question mark is part of the name.
    sample_rate : int
        Hz; must be the file's own, or 0.
    frames_per_chunk : int
        The last chunk is padded with zeros.
    """

    def __init__(self, text: str, sample_rate: int, frames_per_chunk: int, stopping: threading.Event) -> None:
        super().__init__(f"file:{text}", stopping)
        path, options_text = split_path(text)
        options = parse_options(self.name, options_text, _OPTIONS)
        if not path:
            raise device_error("file: expected file:PATH, got an empty path")
        try:
            self._file = AudioFile(path)
        except AudioFileError as problem:
            raise device_error(str(problem)) from None
        begin = round(options.get("start", 0.0) * self._file.sample_rate)
        try:
            if "channels" in options:
                self._pick(options["channels"])
            self._check(sample_rate, begin)
            self.remarks += filter(None, [self._file.remark])
            self.frames = None if options.get("loop") else self._file.frames - begin  # None without an end
            pieces = self._play(begin, frames_per_chunk, options.get("loop", 0))
            self._start(self._file.sample_rate, frames_per_chunk, pieces)
        except BaseException:
            self.close()
            raise

    def _pick(self, channels: tuple[int, int]) -> None:
        try:
            self._file.pick(channels)
        except AudioFileError as problem:
            raise hwparams_error(str(problem)) from None

    def _check(self, sample_rate: int, begin: int) -> None:
        path, channels, rate = self._file.path, self._file.channels, self._file.sample_rate
        if begin >= self._file.frames:
            length = self._file.frames / rate
            raise device_error(f"{path}: expected a start below its length of {length:g} s, got start={begin / rate:g}")
        if channels != 2:
            advice = "?channels=1,1 uses it for both ears" if channels == 1 else "choose two with ?channels=1,2"
            raise hwparams_error(f"{path}: expected 2 channels, got {channels}; {advice}")
        if rate > _MAX_RATE:
            raise hwparams_error(f"{path}: expected at most {_MAX_RATE:.0f} Hz, got {rate} Hz")
        check_sample_rate(path, sample_rate, rate)

    def _play(self, begin: int, frames_per_chunk: int, loop: int) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the samples from frame `begin`, repeatedly if looped."""
        repeated, replaced, clipped = True, False, False
        while repeated:
            try:
                self._file.seek(begin)
                position = begin
                while position < self._file.frames:
                    expected = min(frames_per_chunk, self._file.frames - position)
                    samples = self._file.read(expected)
                    position += samples.shape[1]
                    if samples.shape[1] < expected:
                        raise AudioFileError(f"{self._file.path}: expected {self._file.frames} frames, got {position}")
                    if self._file.not_finite and not replaced:
                        replaced = True
                        self.remarks.append(f"{self._file.path}: {NOT_FINITE}")
                    if self._file.clipped and not clipped:
                        clipped = True
                        self.remarks.append(f"{self._file.path}: samples beyond full scale are clipped")
                    yield 0, samples
            except AudioFileError as problem:
                raise device_error(str(problem)) from None
            repeated = bool(loop)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
