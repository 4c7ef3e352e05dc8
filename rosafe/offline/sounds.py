"""Where offline processing reads from: two channels of a sound file, or the port Audio in a rosbag."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Protocol

import numpy as np

from rosafe.sound.audiofile import AudioFile, AudioFileError
from rosafe.sound.bagsound import BagSoundError, Piece, Recording

BAG = ".bag"
DEFAULT_TOPIC = "/bass/Audio"
# What is a sound in a folder: what libsndfile reads, but for formats that need to be told what is in them, and bags.
SOUNDS = frozenset(
    f".{one}"
    for one in (
        *("wav", "wave", "w64", "rf64", "flac", "ogg", "oga", "opus", "mp3"),
        *("aif", "aiff", "aifc", "au", "snd", "caf", "sph", "nist", "bag"),
    )
)


class SoundReader(Protocol):
    """Two ears, read from the beginning to the end."""

    path: Path
    sample_rate: int  # Hz
    frames: int
    not_finite: int  # samples that were NaN or infinite, so far

    def read(self, frames: int) -> np.ndarray:
        """The next `frames` frames, int32 (2, n); fewer at the end."""

    def close(self) -> None:
        """Close the file."""


def open_sound(path: str | Path, channels: tuple[int, int] | None = None, topic: str | None = None) -> SoundReader:
    """Open a sound file or a bag.

    Parameters
    ----------
    path : path
        A bag where its name ends in .bag.
    channels : tuple of two int, optional
        Which of the file's channels (from 1) are the left and the right ear; needed unless it has two.
    topic : str, optional
        The port Audio in a bag; by default /bass/Audio, or the only one.

    Raises
    ------
    AudioFileError
        The file cannot be read, or has not two channels and none were chosen, or not those that were.
    """
    if Path(path).suffix.lower() == BAG:
        return BagSound(path, topic, channels)
    file = AudioFile(path)
    try:
        if channels is not None:
            file.pick(channels)
        if file.channels != 2:
            kind = "is mono (one channel)" if file.channels == 1 else f"has {file.channels} channels"
            cure = "--channels 1,1 gives it to both" if file.channels == 1 else "--channels 1,2 takes those"
            raise AudioFileError(f"{file.path} {kind}; wanted are two: left and right ear ({cure})")
    except AudioFileError:
        file.close()
        raise
    return file


class BagSound:
    """The one stream of sound in a bag. What was lost while it was recorded is silence in its place."""

    not_finite = 0

    def __init__(self, path: str | Path, topic: str | None, channels: tuple[int, int] | None) -> None:
        self.path = Path(path)
        ears = channels or (1, 2)
        if max(ears) > 2:
            raise AudioFileError(f"{path} has 2 channels: there is no channel {max(ears)}")
        self._ears = [ear - 1 for ear in ears]
        try:
            self._recording = Recording(path, topic, threading.Event(), DEFAULT_TOPIC, "pick one with --topic")
        except BagSoundError as problem:
            raise AudioFileError(str(problem)) from None
        self.sample_rate = self.frames = 0
        try:
            self._measure()
        except BaseException:
            self.close()
            raise
        self._rest = np.zeros((2, 0), np.int32)
        self._pieces = self._from_start()

    def _measure(self) -> None:
        """Go through it once: how long it is shows at its end only."""
        try:
            for number, (sample_rate, pieces) in enumerate(self._recording.streams(), 1):
                if number > 1:
                    raise AudioFileError(
                        f"{self.path} holds several streams of sound one after the other; take one out with "
                        f"`rosafe record OUT.wav --device 'bag:{self.path}?stream=2'`"
                    )
                self.sample_rate = sample_rate
                self.frames = sum(lost + samples.shape[1] for lost, samples in _from_sound(pieces))
        except BagSoundError as problem:
            raise AudioFileError(str(problem)) from None
        if not self.frames:
            raise AudioFileError(f"{self.path} holds no sound on {self._recording.topic}")

    def _from_start(self) -> Iterator[np.ndarray]:
        (_, pieces), *_ = islice(self._recording.streams(), 1)
        for lost, samples in _from_sound(pieces):
            for at in range(0, lost, 2**20):
                yield np.zeros((2, min(2**20, lost - at)), np.int32)
            yield samples

    def read(self, frames: int) -> np.ndarray:
        """The next `frames` frames, int32 (2, n); fewer at the end."""
        taken = [self._rest]
        count = self._rest.shape[1]
        try:
            while count < frames and (piece := next(self._pieces, None)) is not None:
                taken.append(piece)
                count += piece.shape[1]
        except BagSoundError as problem:
            raise AudioFileError(str(problem)) from None
        whole = np.concatenate(taken, axis=1)
        self._rest = whole[:, frames:]
        return np.ascontiguousarray(whole[self._ears, :frames])

    def close(self) -> None:
        """Close the bag."""
        self._recording.close()


def _from_sound(pieces: Iterator[Piece]) -> Iterator[Piece]:
    """From the first sound on: what was lost before it is none of it."""
    begun = False
    for lost, samples in pieces:
        if begun or samples.shape[1]:
            yield lost * begun, samples
            begun = True
