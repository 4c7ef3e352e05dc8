"""Audio files as int32 samples, scaled the same way wherever the project reads one (capture node, offline tools)."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import soundfile

from rosafe.input import open_descriptor

FULL_SCALE = 2**31 - 1  # what 1.0 in a float file becomes
MAX_CHANNELS = 1024  # that libsndfile opens
_FLOAT_SUBTYPES = ("FLOAT", "DOUBLE", "VORBIS", "OPUS", "MPEG")  # the decoder's own numbers are floats
_UNKNOWN_LENGTH = 0x7FFFF000  # a writer to a pipe leaves a data size from here up: it could not know the length


class AudioFileError(Exception):
    """The file cannot be read; the text is one line that says why."""


def to_int32(signal: np.ndarray) -> np.ndarray:
    """Float samples, full scale 1.0, as int32: scaled by 2^31 - 1, rounded, clipped; NaN is silence."""
    finite = np.nan_to_num(np.asarray(signal, dtype=np.float64), posinf=1.0, neginf=-1.0)
    limited = np.clip(finite, -2.0, 2.0)  # else 1e308 overflows
    return np.clip(np.rint(limited * FULL_SCALE), -(2**31), FULL_SCALE).astype(np.int32)


def channel_pair(text: str) -> tuple[int, int]:
    """The two channels, from 1, that a text such as ``3,4`` names: left and right ear; ValueError for other texts."""
    words = text.split(",")
    if len(words) != 2 or not all(word.isascii() and word.isdigit() and len(word) <= 4 for word in words):
        raise ValueError(f"two channel numbers from 1 to {MAX_CHANNELS}, such as 3,4")
    left, right = (int(word) for word in words)
    if not (1 <= left <= MAX_CHANNELS and 1 <= right <= MAX_CHANNELS):
        raise ValueError(f"two channel numbers from 1 to {MAX_CHANNELS}, such as 3,4")
    return left, right


class AudioFile:
    """A sound file of any kind that libsndfile knows (WAV, FLAC, Ogg, AIFF, MP3...), read from disk bit by bit.

    Attributes
    ----------
    sample_rate : int
        Hz.
    channels, frames : int
        Size of what is read; at least 1 each.
    not_finite : int
        How many samples that were read so far were NaN or infinite.

    Raises
    ------
    AudioFileError
        The file is missing, unreadable, not a sound file, empty or cut off.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(os.path.expanduser(path))
        try:
            descriptor = open_descriptor(self.path)
        except (OSError, ValueError) as problem:  # ValueError: a path that no file can have
            raise AudioFileError(f"{self.path}: {getattr(problem, 'strerror', None) or problem}") from None
        if not os.fstat(descriptor).st_size:
            os.close(descriptor)
            raise AudioFileError(f"{self.path} is empty")
        try:
            # Given the name, libsndfile would open resource forks too, and take any file as .gsm or .vox.
            self._file = soundfile.SoundFile(descriptor)
        except soundfile.LibsndfileError as problem:
            raise AudioFileError(
                f"{self.path} is not a sound file: {problem.error_string}{self._replace_non_finite()}"
            ) from None
        self.not_finite = 0
        self.sample_rate = int(self._file.samplerate)
        self.channels = int(self._file.channels)
        self.frames = int(self._file.frames)
        self._float = self._file.subtype.startswith(_FLOAT_SUBTYPES)
        self._ears: list[int] | None = None
        try:
            self._check_whole()
        except AudioFileError:
            self.close()
            raise

    def _replace_non_finite(self) -> str:
        """What to do where this libsndfile is too old for the file."""
        if self.path.suffix.lower() != ".mp3" or "MP3" in soundfile.available_formats():
            return ""
        version = soundfile.__libsndfile_version__
        return f" (libsndfile {version} knows no MP3, 1.1 does; `ffmpeg -i IN.mp3 OUT.wav` makes a WAV of it)"

    def _check_whole(self) -> None:
        if self.frames == 0:
            raise AudioFileError(f"{self.path} holds no samples")
        # libsndfile shortens a WAV or AIFF that was cut off to what is there; only its log tells.
        cut = re.search(r"^\s*(?:data|SSND)\s*:\s*(\d+) \(should be (\d+)\)", self._file.extra_info, re.MULTILINE)
        if cut and int(cut[2]) < int(cut[1]) < _UNKNOWN_LENGTH:
            raise AudioFileError(f"{self.path} is cut off: {cut[2]} of {cut[1]} bytes of sound are there")
        self.seek(self.frames - 1)  # compressed files show it where their end cannot be reached
        if self.read(1).shape[1] != 1:
            raise AudioFileError(f"{self.path} is cut off before its {self.frames} frames")
        self.seek(0)

    def pick(self, ears: tuple[int, int]) -> None:
        """From now on read these two channels (from 1); one may be named twice. AudioFileError where one is missing."""
        if max(ears) > self.channels:
            there = "is mono" if self.channels == 1 else f"has {self.channels} channels"
            raise AudioFileError(f"{self.path} {there}: there is no channel {max(ears)}")
        self._ears = [ear - 1 for ear in ears]
        self.channels = 2

    def seek(self, frame: int) -> None:
        """Go on reading at `frame`, from 0 to `frames`."""
        try:
            self._file.seek(frame)
        except soundfile.LibsndfileError as problem:
            raise AudioFileError(f"{self.path} is cut off or damaged: {problem.error_string}") from None

    def read(self, frames: int) -> np.ndarray:
        """The next `frames` frames, fewer at the end of the file.

        Returns
        -------
        ndarray of int32, (channels, n)
            Samples of 8, 16 or 24 bits fill the upper bits; float samples are converted by `to_int32`.
        """
        try:
            samples = self._file.read(frames, dtype="float64" if self._float else "int32", always_2d=True).T
        except soundfile.LibsndfileError as problem:
            raise AudioFileError(f"{self.path} is cut off or damaged: {problem.error_string}") from None
        if self._ears is not None:
            samples = samples[self._ears]
        if self._float:
            self.not_finite += samples.size - int(np.count_nonzero(np.isfinite(samples)))
            return to_int32(samples)
        return np.asarray(samples)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
