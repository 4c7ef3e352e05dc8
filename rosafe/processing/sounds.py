"""Input of offline processing: two channels of a sound file, or the port Audio in a rosbag."""

from __future__ import annotations

import contextlib
import os
import threading
import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Protocol

import numpy as np

from rosafe.audio.files.audiofile import NOT_FINITE, AudioFile, AudioFileError, channels_text
from rosafe.audio.files.bagsound import BagSoundError, Recording, from_first_samples
from rosafe.results.hdf5_reading import check_arrays
from rosafe.tree.sizes import MAX_BYTES, check_memory

BAG = ".bag"
DEFAULT_TOPIC = "/bass/Audio"
_MAX_LOST, _MAX_LOST_SECONDS = 10, 60.0  # of a bag; lost frames are replaced by silence
# Endings of sound files in a folder: bags, and all formats of libsndfile that have a header
SOUNDS = frozenset(
    f".{one}"
    for one in (
        *("wav", "wave", "w64", "rf64", "flac", "ogg", "oga", "opus", "mp3"),
        *("aif", "aiff", "aifc", "au", "snd", "caf", "sph", "nist", "bag"),
    )
)


class SoundReader(Protocol):
    """A sound of two ears that is read once from beginning to end."""

    path: Path
    sample_rate: int  # Hz
    frames: int
    channels: int  # 1 or 2
    floats: bool  # whether `read` returns float64
    not_finite: int  # number of NaN or infinite samples so far
    clipped: int  # number of samples so far that were limited to full scale
    remark: str  # one line about sound that is not read, or ''

    def read(self, frames: int) -> np.ndarray:
        """Return the next `frames` frames, int32 or float64 (channels, n); fewer at the end."""

    def close(self) -> None:
        """Close the file."""


def open_sound(
    path: str | Path,
    channels: tuple[int, int] | None = None,
    topic: str | None = None,
    one_ear: bool = False,
    clip: bool = True,
    mono_advice: str = "a direction is the difference of two ears",
) -> SoundReader:
    """Open a sound file or a bag.

    Parameters
    ----------
    path : path
        A bag if its name ends in .bag.
    channels : tuple of two int, optional
        The channels of the file (from 1) for the left and the right ear; required unless it has two.
    topic : str, optional
        The port Audio in a bag; by default /bass/Audio, or the only one.
    one_ear : bool
        Whether a mono file is accepted.
    clip : bool
        Whether samples of float files are converted to int32; see `rosafe.audio.files.audiofile.AudioFile`.
    mono_advice : str
        Appended to the error for a mono file that is not accepted.

    Raises
    ------
    AudioFileError
        The file cannot be read, or lacks the chosen channels, or has not two and none were chosen.
    """
    if Path(path).suffix.lower() == BAG:
        return BagSound(path, topic, channels)
    file = AudioFile(path, clip)
    try:
        if channels is not None:
            file.pick(channels)
        if file.channels != 2 and not (one_ear and file.channels == 1):
            advice = mono_advice if file.channels == 1 else "--channels 1,2 takes the first two"
            kind = channels_text(file.channels)
            raise AudioFileError(f"{file.path}: expected two channels, left and right ear, got {kind}; {advice}")
    except AudioFileError:
        file.close()
        raise
    return file


def read_ears(path: str | Path, channels: tuple[int, int] | None = None) -> tuple[np.ndarray, int]:
    """Return the sound of both ears (2, N) in a file or a bag, and its sample rate; AudioFileError as `open_sound`."""
    with contextlib.closing(open_sound(path, channels)) as file:
        return read_whole(file), file.sample_rate


def read_whole(file: SoundReader) -> np.ndarray:
    """Return a whole sound, int32 or float64 (channels, frames), with a UserWarning for each remark about it.

    AudioFileError if it is too long for the memory, or damaged.
    """
    size = file.frames * file.channels * (8 if file.floats else 4)
    try:
        if isinstance(file, BagSound):  # its sound can be compressed to almost nothing
            check_arrays(os.path.getsize(file.path), size)
        check_memory("its sound", MAX_BYTES, size, "choose a part, as by `ffmpeg -ss 0 -t 600 -i IN OUT.wav`")
    except (OSError, ValueError) as problem:
        raise AudioFileError(f"{file.path}: {problem}") from None
    sound = file.read(file.frames)
    if sound.shape[1] != file.frames:
        raise AudioFileError(f"{file.path}: expected {file.frames} frames, got {sound.shape[1]}; the file is truncated")
    replaced = f"{file.path}: {file.not_finite} {NOT_FINITE}" if file.not_finite else ""
    for text in filter(None, (file.remark, replaced)):
        warnings.warn(text, UserWarning, stacklevel=2)
    return sound


class BagSound:
    """The stream of sound in a bag. Frames that were lost while it was recorded are replaced by silence."""

    channels, floats, not_finite, clipped, remark = 2, False, 0, 0, ""

    def __init__(self, path: str | Path, topic: str | None, channels: tuple[int, int] | None) -> None:
        self.path = Path(path)
        ears = channels or (1, 2)
        if max(ears) > 2:
            raise AudioFileError(f"{path}: expected channels 1 to 2, got {max(ears)}")
        self._ears = [ear - 1 for ear in ears]
        try:
            self._recording = Recording(path, topic, threading.Event(), DEFAULT_TOPIC, "choose one with --topic")
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
        """Read the bag once to find its length and sample rate."""
        try:
            for number, (sample_rate, pieces) in enumerate(self._recording.streams(), 1):
                if number > 1:
                    raise AudioFileError(
                        f"{self.path}: expected one stream of sound, got several successive ones; extract one with "
                        f"`rosafe record OUT.wav --device 'bag:{self.path}?stream=2'`"
                    )
                self.sample_rate = sample_rate
                counts = [(lost, samples.shape[1]) for lost, samples in from_first_samples(pieces)]
                lost, received = map(sum, zip(*counts, strict=True)) if counts else (0, 0)
                if lost > _MAX_LOST * received + _MAX_LOST_SECONDS * sample_rate:
                    raise AudioFileError(
                        f"{self.path}: expected at most {_MAX_LOST} times as many lost frames as frames of sound, got "
                        f"{lost} and {received}; extract the parts with `rosafe record`"
                    )
                self.frames = lost + received
        except BagSoundError as problem:
            raise AudioFileError(str(problem)) from None
        if not self.frames:
            raise AudioFileError(f"{self.path}: expected sound on {self._recording.topic}, got none")

    def _from_start(self) -> Iterator[np.ndarray]:
        (_, pieces), *_ = islice(self._recording.streams(), 1)
        for lost, samples in from_first_samples(pieces):
            for at in range(0, lost, 2**20):
                yield np.zeros((2, min(2**20, lost - at)), np.int32)
            yield samples

    def read(self, frames: int) -> np.ndarray:
        """Return the next `frames` frames, int32 (2, n); fewer at the end."""
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
