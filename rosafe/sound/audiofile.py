"""Audio files as int32 samples, with the same scaling in the capture node and in the offline tools."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import soundfile

from rosafe.input import open_descriptor

FULL_SCALE = 2**31 - 1  # sample value of 1.0 in a float file
MAX_CHANNELS = 1024  # limit of libsndfile
_FLOAT_SUBTYPES = ("FLOAT", "DOUBLE", "VORBIS", "OPUS", "MPEG")  # the decoder computes in floating point
_UNKNOWN_LENGTH = 0x7FFFF000  # a program that writes to a pipe sets a data size from here up, as the length is unknown


class AudioFileError(Exception):
    """The file cannot be read; the text is one line with the reason."""


def channels_text(count: int) -> str:
    """Return a number of channels for an error message."""
    return "1 (the file is mono)" if count == 1 else str(count)


def to_int32(signal: np.ndarray) -> np.ndarray:
    """Convert float samples (full scale 1.0) to int32: scaled by 2^31 - 1, rounded, clipped; NaN becomes 0."""
    return _rounded(signal)[0]


def _rounded(signal: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the samples as `to_int32`, and the number of finite samples that were clipped."""
    limited = np.clip(_finite(np.asarray(signal, np.float64)), -2.0, 2.0)  # so that 1e308 does not overflow when scaled
    rounded = np.rint(limited * FULL_SCALE)
    clipped = int(np.count_nonzero((rounded > FULL_SCALE) | (rounded < -(2**31))))
    return np.clip(rounded, -(2**31), FULL_SCALE).astype(np.int32), clipped


def _finite(samples: np.ndarray) -> np.ndarray:
    """Replace NaN by silence and infinity by full scale."""
    return np.nan_to_num(samples, posinf=1.0, neginf=-1.0)


def channel_pair(text: str, max_channel: int = MAX_CHANNELS) -> tuple[int, int]:
    """Return the channels of the left and right ear (from 1) in a text such as ``3,4``. Raises ValueError."""
    found = re.fullmatch(r"(\d{1,4}),(\d{1,4})", text, re.ASCII)
    channels = (int(found[1]), int(found[2])) if found else (0, 0)
    if not all(1 <= channel <= max_channel for channel in channels):
        raise ValueError(f"expected two channel numbers from 1 to {max_channel}, such as 3,4, got {text!r}")
    return channels


class AudioFile:
    """A sound file in any format of libsndfile (WAV, FLAC, Ogg, AIFF, MP3...), read from disk in parts.

    Parameters
    ----------
    path : path
    clip : bool
        Whether float samples are converted by `to_int32`; otherwise they are returned as float64.

    Attributes
    ----------
    sample_rate : int
        Hz.
    channels, frames : int
        Size of the array that `read` would return for the whole file; at least 1 each.
    floats : bool
        Whether `read` returns float64.
    not_finite : int
        Number of samples read so far that were NaN or infinite.
    clipped : int
        Number of samples read so far that were limited to full scale.

    Raises
    ------
    AudioFileError
        The file is missing, unreadable, not a sound file, empty or truncated.
    """

    def __init__(self, path: str | Path, clip: bool = True) -> None:
        self.path = Path(os.path.expanduser(path))
        try:
            descriptor = open_descriptor(self.path)
        except (OSError, ValueError) as problem:  # ValueError: an invalid path
            raise AudioFileError(f"{self.path}: {getattr(problem, 'strerror', None) or problem}") from None
        if not os.fstat(descriptor).st_size:
            os.close(descriptor)
            raise AudioFileError(f"{self.path}: expected a sound file, got an empty file")
        try:
            # If it got the name, libsndfile would also open resource forks, and accept any file as .gsm or .vox.
            self._file = soundfile.SoundFile(descriptor)
        except soundfile.LibsndfileError as problem:
            raise AudioFileError(
                f"{self.path}: expected a sound file, got another file: {problem.error_string}{self._mp3_advice()}"
            ) from None
        self.not_finite = self.clipped = 0
        self.sample_rate = int(self._file.samplerate)
        self.channels = int(self._file.channels)
        self.frames = int(self._file.frames)
        self._float = self._file.subtype.startswith(_FLOAT_SUBTYPES)
        self.floats = self._float and not clip
        self._ears: list[int] | None = None  # channels to read, from 0; None for all
        try:
            self._check_complete()
        except AudioFileError:
            self.close()
            raise

    def _damaged(self, problem: soundfile.LibsndfileError) -> AudioFileError:
        reason = f"got a truncated or damaged one: {problem.error_string}"
        return AudioFileError(f"{self.path}: expected a complete sound file, {reason}")

    def _mp3_advice(self) -> str:
        """Return advice if the file is an MP3 and this version of libsndfile cannot read MP3; otherwise ''."""
        if self.path.suffix.lower() != ".mp3" or "MP3" in soundfile.available_formats():
            return ""
        version = soundfile.__libsndfile_version__
        return f" (MP3 needs libsndfile 1.1, this is {version}; convert the file: `ffmpeg -i IN.mp3 OUT.wav`)"

    def _check_complete(self) -> None:
        if self.frames == 0:
            raise AudioFileError(f"{self.path}: expected samples, got none")
        # libsndfile silently shortens a truncated WAV or AIFF; only its log shows that bytes are missing.
        cut = re.search(r"^\s*(?:data|SSND)\s*:\s*(\d+) \(should be (\d+)\)", self._file.extra_info, re.MULTILINE)
        if cut and int(cut[2]) < int(cut[1]) < _UNKNOWN_LENGTH:
            raise AudioFileError(f"{self.path}: expected {cut[1]} bytes of sound, got {cut[2]}; the file is truncated")
        self.seek(self.frames - 1)  # fails for a truncated compressed file
        if self.read(1).shape[1] != 1:
            raise AudioFileError(f"{self.path}: expected {self.frames} frames, got fewer; the file is truncated")
        self.seek(0)
        self.not_finite = self.clipped = 0  # the last frame was read above

    def pick(self, ears: tuple[int, int]) -> None:
        """Select two channels (from 1, may be equal) for `read`. Raises AudioFileError if one does not exist."""
        if max(ears) > self.channels:
            raise AudioFileError(
                f"{self.path}: expected a file with channel {max(ears)}, got {channels_text(self.channels)}"
            )
        self._ears = [ear - 1 for ear in ears]
        self.channels = 2

    def seek(self, frame: int) -> None:
        """Set the position for `read` to `frame`, from 0 to `frames`."""
        try:
            self._file.seek(frame)
        except soundfile.LibsndfileError as problem:
            raise self._damaged(problem) from None

    def read(self, frames: int) -> np.ndarray:
        """Return the next `frames` frames, fewer at the end of the file.

        Returns
        -------
        ndarray of int32 or float64, (channels, n)
            Samples of 8, 16 or 24 bits fill the upper bits; float samples are converted by `to_int32` unless `floats`.
        """
        try:
            samples = self._file.read(frames, dtype="float64" if self._float else "int32", always_2d=True).T
        except soundfile.LibsndfileError as problem:
            raise self._damaged(problem) from None
        if self._ears is not None:
            samples = samples[self._ears]
        if self._float:
            self.not_finite += samples.size - int(np.count_nonzero(np.isfinite(samples)))
            if self.floats:
                return _finite(samples)
            samples, clipped = _rounded(samples)
            self.clipped += clipped
            return samples
        return np.asarray(samples)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
