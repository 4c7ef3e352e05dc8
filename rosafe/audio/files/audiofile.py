"""Audio files as int32 samples, with the same scaling in the capture node and in the offline tools."""

from __future__ import annotations

import io
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import soundfile

from rosafe.audio.files.containers import CONVERT, TAGS, Header, kind_of, read_header, unread
from rosafe.system.input import open_descriptor

FULL_SCALE = 2**31 - 1  # sample value of 1.0 in a float file
MAX_CHANNELS = 1024  # limit of libsndfile
_FLOAT_SUBTYPES = ("FLOAT", "DOUBLE", "VORBIS", "OPUS", "MPEG")  # the decoder computes in floating point
NOT_FINITE = "samples that are NaN or infinite are replaced by silence or full scale"
MAX_RATE = 1_000_000  # Hz
_FORMATS = ("WAV", "WAVEX", "RF64", "W64", "AIFF", "AU", "CAF", "NIST", "FLAC", "OGG", "MP3")  # `Header` checks these
_UNCODED = {  # bytes of a sample
    **dict.fromkeys(("PCM_S8", "PCM_U8", "ULAW", "ALAW"), 1),
    **dict.fromkeys(("PCM_32", "FLOAT"), 4),
    "PCM_16": 2,
    "PCM_24": 3,
    "DOUBLE": 8,
}
_BLOCK = 2**18  # samples that are read at once
_UNLIMITED = 2**62  # frames; libsndfile states more if it does not know the length
_LONGER = 64  # more than the ratio of the bit rates of MP3
_ID3V1 = 128  # bytes
_MPEG_FRAME = 1152  # some encoders count the one that contains the number of frames
_MPEG_PART = 576  # frames, of any version


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


class _Decoder(soundfile.SoundFile):
    """Reads without seeking. (`soundfile` seeks after each reading, which not all codecs support.)"""

    def seekable(self) -> bool:
        """Return False."""
        return False


class _Presented(io.FileIO):
    """A file as libsndfile shall see it: with other bytes in its header, or longer.

    libsndfile takes the length from some headers, and estimates that of an MP3 by the size of the file. It never reads
    beyond.
    """

    def __init__(self, descriptor: int, offset: int = 0, patch: bytes = b"", longer: int = 1) -> None:
        super().__init__(descriptor, closefd=False)
        self._offset, self._patch = offset, patch
        self._size = os.fstat(descriptor).st_size * longer
        super().seek(0)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position; the end is that of the longer file."""
        return super().seek(self._size + offset) if whence == os.SEEK_END else super().seek(offset, whence)

    def readinto(self, buffer: Any) -> int:
        """Fill `buffer`; behind the end of the file, with zeros in place of a tag only."""
        at, target = self.tell(), memoryview(buffer).cast("B")
        count = super().readinto(target) or 0
        for place, byte in enumerate(self._patch, self._offset - at):
            if 0 <= place < count:
                target[place] = byte
        if not count and at >= self._size - _ID3V1:  # libmpg123 requires these bytes
            target[:] = bytes(len(target))
            return len(target)
        return count


class AudioFile:
    """A sound file, read from disk in parts: WAV, RF64, W64, AIFF, AU, CAF, NIST, FLAC, Ogg, MP3, and others.

    The length of coded sound is that of the decoded samples, which are counted when the file is opened. The length that
    a header states is compared with the file. `read` returns the whole sound, or an error is raised, or `remark` names
    the bytes that are not read.

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
    remark : str
        One line about sound that may be missing, bytes behind the sound, or a length that cannot be verified, as of
        VOC; otherwise ''.
    not_finite : int
        Number of samples read so far that were NaN or infinite.
    clipped : int
        Number of samples read so far that were limited to full scale.

    Raises
    ------
    AudioFileError
        The file is missing, unreadable, not a sound file, empty, truncated or of an unsupported kind.
    """

    def __init__(self, path: str | Path, clip: bool = True) -> None:
        self.path = Path(os.path.expanduser(path))
        try:
            self._descriptor = open_descriptor(self.path)
        except (OSError, ValueError) as problem:  # ValueError: an invalid path
            reason = getattr(problem, "strerror", None) or str(problem)
            if str(path) == "-":
                reason = "expected the name of a sound file; the standard input is not read"
            raise AudioFileError(f"{self.path}: {reason}") from None
        self.not_finite = self.clipped = 0
        self.remark = ""
        self._file: _Decoder | None = None
        self._ears: list[int] | None = None  # channels to read, from 0; None for all
        self._presented: tuple[int, bytes, int] | None = None  # parameters of _Presented
        try:
            self._begin(clip)
        except ValueError as problem:
            self.close()
            raise AudioFileError(f"{self.path}: {problem}") from None
        except BaseException:
            self.close()
            raise

    def _begin(self, clip: bool) -> None:
        """Open the file and find its length."""
        size = os.fstat(self._descriptor).st_size
        header = self._header(size)
        self.remark = header.remark and f"{self.path}: {header.remark}"
        if header.patch and not header.frames:
            self._presented = header.offset, header.patch, 1
        file_format = self._open()
        self.sample_rate, self.channels = int(file_format.samplerate), int(file_format.channels)
        if not 1 <= self.sample_rate <= MAX_RATE:
            raise ValueError(f"expected a sample rate of 1 to {MAX_RATE} Hz, got {self.sample_rate}")
        verified = file_format.format in _FORMATS
        self._exact = verified and file_format.format != "FLAC" and file_format.subtype in _UNCODED
        self._float = file_format.subtype.startswith(_FLOAT_SUBTYPES)
        self.floats = self._float and not clip
        if self._exact:  # libsndfile can take bytes behind the sound as sound
            stated = header.size // (self.channels * _UNCODED[file_format.subtype]) if header.size else _UNLIMITED
            self.frames = min(int(file_format.frames), stated)
        else:
            self.frames = self._count(header, size)
        if not verified and not self.remark:
            self.remark = f"{self.path}: the length of {file_format.format} is not verified; the file may be truncated"
        if not self.frames:
            raise ValueError("expected samples, got none")
        if self._exact:
            self._check_last_frame()
        self.seek(0)
        self.not_finite = self.clipped = 0  # the last frame was read above

    def _check_last_frame(self) -> None:
        self.seek(self.frames - 1)
        if self.read(1).shape[1] != 1:
            raise ValueError(f"expected {self.frames} frames, got fewer; the file is truncated")

    def _header(self, size: int) -> Header:
        if not size:
            raise ValueError("expected a sound file, got an empty file")
        with open(self._descriptor, "rb", closefd=False) as file:
            if kind := kind_of(file.read(256)):
                raise ValueError(f"expected a sound file that libsndfile reads, got {kind}; {CONVERT}")
            return read_header(file, size)

    def _open(self) -> _Decoder:
        """Open the file again, at its beginning."""
        if self._file is not None:
            self._file.close()
        os.lseek(self._descriptor, 0, os.SEEK_SET)
        # If it got the name, libsndfile would also open resource forks, and accept any file as .gsm or .vox.
        source: Any = _Presented(self._descriptor, *self._presented) if self._presented else os.dup(self._descriptor)
        try:
            self._file = _Decoder(source)  # closes the copy of the descriptor, also if it fails
        except soundfile.LibsndfileError as problem:
            reason = f"expected a sound file, got another file: {problem.error_string.rstrip('.')}"
            advice = self._mp3_advice() or ("" if "not recognised" in reason else f"; {CONVERT}")
            raise ValueError(reason + advice) from None
        self._position = 0
        return self._file

    def _count(self, header: Header, size: int) -> int:
        """Return the number of frames that can be decoded. AudioFileError or ValueError if it is less than stated."""
        file = self._open()
        stated, mpeg = int(file.frames), file.subtype.startswith("MPEG")
        if header.frames:
            return self._count_flac(header, stated, size)
        if file.format == "MP3" and not header.exact:
            return self._count_mp3(size)
        count = self._skip(stated)
        if file.format == "OGG":
            if count < header.least * self.sample_rate - 1:
                raise ValueError(f"expected {header.least:.3f} s of sound, got fewer; the file is damaged")
        elif not mpeg or header.exact:
            self._check_count(count, stated - _MPEG_FRAME * mpeg)
        if mpeg or file.format == "FLAC" or file.format not in _FORMATS:
            self._note_rest(size)
        if count < stated and header.exact and not self.remark:
            self.remark = f"{self.path}: expected {stated} frames, got {count}; the last frame of MPEG may be missing"
        return count

    def _check_count(self, count: int, stated: int) -> None:
        if count < stated < _UNLIMITED:
            raise ValueError(f"expected {stated} frames, got {count}; the file is truncated")

    def _count_flac(self, header: Header, stated: int, size: int) -> int:
        """Return the number of frames of a FLAC file. The decoder does not read more than its header states."""
        self._presented = header.offset, header.patch, 1
        self._open()
        count = self._skip(stated)
        self._check_count(count, stated)
        if self._has_more():
            self._open()
            return self._skip(_UNLIMITED)
        self._presented = None
        self._note_rest(size)
        return count

    def _count_mp3(self, size: int) -> int:
        """Return the number of frames of an MP3 that does not state it. It can differ from libsndfile's estimate."""
        self._presented = 0, b"", _LONGER
        self._open()
        count = 0
        try:
            while new := self._skip(_MPEG_PART):
                count += new
        except AudioFileError:  # a part of an MPEG frame at the end, or other data
            self.remark = f"{self.path}: the last frame of MPEG is not complete; the file may be truncated"
        self._note_rest(size)
        return count

    def _has_more(self) -> bool:
        try:
            return self._skip(1) > 0
        except AudioFileError:  # other data
            return False

    def _note_rest(self, size: int) -> None:
        """Remark on bytes that the decoder has not read."""
        at = os.lseek(self._descriptor, 0, os.SEEK_CUR)
        rest = os.pread(self._descriptor, 2**16, at)
        if rest.strip(b"\0") and not rest.startswith(TAGS):
            self.remark = f"{self.path}: {unread(size - at)}"

    def _skip(self, frames: int) -> int:
        """Decode at most `frames` frames and return their number."""
        assert self._file is not None
        buffer = np.empty((max(1, _BLOCK // self._file.channels), self._file.channels), np.float32)
        count = 0
        try:
            while count < frames and (new := len(self._file.read(out=buffer[: frames - count]))):
                count += new
        except soundfile.LibsndfileError as problem:
            raise self._damaged(problem) from None
        self._position += count
        return count

    def _damaged(self, problem: soundfile.LibsndfileError) -> AudioFileError:
        reason = f"got a truncated or damaged one: {problem.error_string}"
        return AudioFileError(f"{self.path}: expected a complete sound file, {reason}")

    def _mp3_advice(self) -> str:
        """Return advice if the file is an MP3 and this version of libsndfile cannot read MP3; otherwise ''."""
        if self.path.suffix.lower() != ".mp3" or "MP3" in soundfile.available_formats():
            return ""
        version = soundfile.__libsndfile_version__
        return f" (MP3 needs libsndfile 1.1, this is {version}; {CONVERT})"

    def pick(self, ears: tuple[int, int]) -> None:
        """Select two channels (from 1, may be equal) for `read`. Raises AudioFileError if one does not exist."""
        if max(ears) > self.channels:
            raise AudioFileError(
                f"{self.path}: expected a file with channel {max(ears)}, got {channels_text(self.channels)}"
            )
        self._ears = [ear - 1 for ear in ears]
        self.channels = 2

    def seek(self, frame: int) -> None:
        """Set the position for `read` to `frame`, from 0 to `frames`. Coded sound is decoded up to there."""
        assert self._file is not None
        if self._exact:
            try:
                self._file.seek(frame)
            except soundfile.LibsndfileError as problem:
                raise self._damaged(problem) from None
            self._position = frame
            return
        if frame < self._position or frame == 0:
            self._open()
        self._skip(frame - self._position)

    def read(self, frames: int) -> np.ndarray:
        """Return the next `frames` frames, fewer at the end of the file.

        Returns
        -------
        ndarray of int32 or float64, (channels, n)
            Samples of 8, 16 or 24 bits fill the upper bits; float samples are converted by `to_int32` unless `floats`.
        """
        frames = min(frames, self.frames - self._position)
        assert self._file is not None
        block = max(1, _BLOCK // self._file.channels)
        if frames <= block:
            return self._next(frames)
        whole = np.empty((self.channels, frames), np.float64 if self.floats else np.int32)
        done = 0
        while done < frames and (part := self._next(min(block, frames - done))).shape[1]:
            whole[:, done : done + part.shape[1]] = part
            done += part.shape[1]
        return whole[:, :done]

    def _next(self, frames: int) -> np.ndarray:
        """Return one block of `read`."""
        assert self._file is not None
        try:
            samples = self._file.read(frames, dtype="float64" if self._float else "int32", always_2d=True).T
        except soundfile.LibsndfileError as problem:
            raise self._damaged(problem) from None
        self._position += samples.shape[1]
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
        if self._file is not None:
            self._file.close()
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1
