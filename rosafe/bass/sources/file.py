"""The source `file:PATH`: a sound file in real time."""

from __future__ import annotations

import os
import threading

import numpy as np

from rosafe.bass.sources.base import Chunk, Pacer, device_error, flag, hwparams_error, number, parse_options
from rosafe.interface import BASS
from rosafe.sound.audiofile import AudioFile, AudioFileError, channel_pair


def split_path(text: str) -> tuple[str, str]:
    """Path and options of a device name; where all of it is the name of a file, a question mark belongs to that."""
    if "?" not in text or os.path.isfile(os.path.expanduser(text)):
        return text, ""
    path, _, options = text.rpartition("?")
    return path, options


_MAX_RATE = BASS.service("Acquire").parameter("sampleRate").maximum or 0
_OPTIONS = {"channels": channel_pair, "loop": flag, "start": number(0, 1e9)}


class FileSource:
    """Two channels of a sound file, read from disk as it is played.

    Parameters
    ----------
    text : str
        ``PATH`` or ``PATH?OPTIONS``. PATH is relative to the process's folder, ``~`` is the user's home. Options:
        ``channels=3,4`` takes those two (from 1) of a file with more, ``channels=1,1`` one for both ears;
        ``start=SECONDS`` leaves out the beginning; ``loop=1`` goes on from there again at the end, for ever, without
        a gap. Where the whole text is the name of a file, a question mark in it is part of the name.
    sample_rate : int
        Hz; must be the file's own, or 0.
    frames_per_chunk : int
        The last chunk is filled up with zeros.
    """

    overruns = 0
    lost_frames = 0

    def __init__(self, text: str, sample_rate: int, frames_per_chunk: int, stopping: threading.Event) -> None:
        self.name = f"file:{text}"
        path, options_text = split_path(text)
        options = parse_options(self.name, options_text, _OPTIONS)
        if not path:
            raise device_error("file: names no file; write file:PATH")
        try:
            self._file = AudioFile(path)
        except AudioFileError as problem:
            raise device_error(str(problem)) from None
        self._loop = options.get("loop", False)
        self._start = self._position = round(options.get("start", 0.0) * self._file.sample_rate)
        self.sample_rate = self._file.sample_rate
        try:
            if "channels" in options:
                self._pick(options["channels"])
            self._check(sample_rate)
            self._file.seek(self._start)
        except BaseException:
            self.close()
            raise
        self._frames_per_chunk = frames_per_chunk
        self._pacer = Pacer(self.sample_rate, stopping)

    def _pick(self, channels: tuple[int, int]) -> None:
        try:
            self._file.pick(channels)
        except AudioFileError as problem:
            raise hwparams_error(str(problem)) from None

    def _check(self, sample_rate: int) -> None:
        path, channels = self._file.path, self._file.channels
        if self._start >= self._file.frames:
            seconds = self._file.frames / self.sample_rate
            raise device_error(
                f"{path} lasts {seconds:g} s, start={self._start / self.sample_rate:g} is behind its end"
            )
        if channels != 2:
            cure = "?channels=1,1 gives it to both ears" if channels == 1 else "?channels=1,2 takes those"
            raise hwparams_error(f"{path} has {channels} channel{'s' * (channels > 1)}, two are needed: {cure}")
        if self.sample_rate > _MAX_RATE:
            raise hwparams_error(f"{path} has a sample rate of {self.sample_rate} Hz, at most {_MAX_RATE:.0f} go")
        if sample_rate not in (0, self.sample_rate):
            raise hwparams_error(
                f"{path} has a sample rate of {self.sample_rate} Hz, asked for were {sample_rate}; 0 is the file's own"
            )

    def read(self) -> Chunk | None:
        """The next chunk in its time; None after the end of the file."""
        samples = np.zeros((2, self._frames_per_chunk), np.int32)
        filled = 0
        while filled < self._frames_per_chunk:
            piece = self._next(self._frames_per_chunk - filled)
            if piece.shape[1] == 0:
                break
            samples[:, filled : filled + piece.shape[1]] = piece
            filled += piece.shape[1]
        if filled == 0:
            return None
        due = self._pacer.wait(self._frames_per_chunk)
        return None if due is None else Chunk(samples, 0, due)

    def _next(self, frames: int) -> np.ndarray:
        """Up to `frames` frames; none at the end of a file that is not looped."""
        try:
            left = self._file.frames - self._position
            if left == 0 and self._loop:
                self._file.seek(self._start)
                self._position, left = self._start, self._file.frames - self._start
            piece = self._file.read(min(frames, left))
        except AudioFileError as problem:
            raise device_error(str(problem)) from None
        self._position += piece.shape[1]
        if piece.shape[1] < min(frames, left):
            raise device_error(f"{self._file.path} ended early, at frame {self._position} of {self._file.frames}")
        return piece

    def close(self) -> None:
        """Close the file."""
        self._file.close()
