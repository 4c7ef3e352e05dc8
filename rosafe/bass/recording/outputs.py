"""Where recorded sound goes: a WAV of any length, or a bag of windows as on the port Audio."""

from __future__ import annotations

import os
import struct
from typing import IO, Protocol

import numpy as np

from rosafe.bass.capture import AudioWindow

HEADER_SECONDS = 1.0  # of sound; that much of a WAV is lost at most where the process is killed
RIFF_LIMIT = 2**32 - 1  # bytes of a WAV; what is longer becomes an RF64
BAG_CHUNKS = 4  # in the windows of a bag, so that a reader may miss three messages in a row
BAG_RESERVE = 64 * 2**20  # bytes of the disk that a bag leaves free: what it needs to be closed


class Output(Protocol):
    """A file that grows."""

    frames: int  # in it, lost ones included

    def write(self, samples: np.ndarray, time_ns: int) -> None:
        """Append int32 (2, n), the last of which was acquired at `time_ns` since 1970. OSError where it fails."""

    def lose(self, frames: int) -> None:
        """Append that many frames of silence, in the place of lost ones."""

    def close(self) -> None:
        """Make the file complete: what was written is in it, even after an OSError."""


class WavFile:
    """A WAV of two channels of 32 bits; from 4 GiB on an RF64 (EBU Tech 3306), which libsndfile reads like any WAV.

    Its header is brought up to date every second of sound, so that a recording is never lost as a whole.

    Parameters
    ----------
    descriptor : int
        Of an empty file, open for writing; it stays open.
    sample_rate : int
        Hz.
    """

    _FRAME = 8  # bytes
    _HEADER = 80  # bytes

    def __init__(self, descriptor: int, sample_rate: int) -> None:
        self._sample_rate = sample_rate
        self.frames = 0
        self._in_header = 0  # frames that the header knows of
        self._file: IO[bytes] = os.fdopen(descriptor, "wb", buffering=0, closefd=False)
        self._write_header()

    def write(self, samples: np.ndarray, time_ns: int) -> None:
        """Append `samples`; a WAV has no place for the time."""
        # Unbuffered: the file's length always says how many frames are in it.
        rest = np.ascontiguousarray(samples.T, "<i4").data.cast("B")
        while rest:
            rest = rest[self._file.write(rest) :]
        self.frames += samples.shape[1]
        if self.frames - self._in_header >= HEADER_SECONDS * self._sample_rate:
            self._write_header()

    def lose(self, frames: int) -> None:
        """Append silence."""
        while frames > 0:
            count = min(frames, 2**16)
            self.write(np.zeros((2, count), np.int32), 0)
            frames -= count

    def _write_header(self) -> None:
        size = self.frames * self._FRAME
        whole = self._HEADER - 8 + size
        long = whole > RIFF_LIMIT
        sizes = struct.pack("<QQQI", whole, size, self.frames, 0) if long else bytes(28)
        header = b"".join(
            (
                struct.pack("<4sI4s", b"RF64" if long else b"RIFF", 2**32 - 1 if long else whole, b"WAVE"),
                struct.pack("<4sI", b"ds64" if long else b"JUNK", len(sizes)) + sizes,
                struct.pack("<4sIHHIIHH", b"fmt ", 16, 1, 2, self._sample_rate, self._sample_rate * 8, 8, 32),
                struct.pack("<4sI", b"data", 2**32 - 1 if long else size),
            )
        )
        os.pwrite(self._file.fileno(), header, 0)
        if not self.frames:
            self._file.seek(self._HEADER)
        self._in_header = self.frames

    def close(self) -> None:
        """Cut off what is no whole frame, and complete the header."""
        if not self._file.closed:
            self.frames = max(0, os.fstat(self._file.fileno()).st_size - self._HEADER) // self._FRAME
            os.ftruncate(self._file.fileno(), self._HEADER + self.frames * self._FRAME)
            self._write_header()
            self._file.close()


class BagWriter:
    """A bag for `rosbag play` and the source `bag:`: overlapping windows on one topic, in which every frame has the
    number that it has in the stream.

    Parameters
    ----------
    descriptor : int
        Of an empty file, open for reading and writing; it stays open.
    sample_rate : int
        Hz.
    frames_per_chunk : int
        A message at most brings so many new frames.
    topic : str
        Name of the port in the bag.
    newest : int
        Number of the frame before the first one that will be written.
    """

    def __init__(self, descriptor: int, sample_rate: int, frames_per_chunk: int, topic: str, newest: int = 0) -> None:
        import rosbag

        from rosafe.component import serialization
        from rosafe.interface import BASS

        self._descriptor = descriptor
        self._sample_rate = sample_rate
        self._chunk = frames_per_chunk
        self._topic = topic
        self.frames = 0
        self._newest = newest
        self._held = 0  # frames of the window that are of this recording
        self._time_ns = 0  # when the newest one was acquired
        self._message_class = serialization.message_class("bass", BASS.port("Audio").idl)
        self._window = AudioWindow(BAG_CHUNKS * frames_per_chunk)
        self._bag = rosbag.Bag(os.fdopen(descriptor, "w+b", closefd=False), "w")

    def write(self, samples: np.ndarray, time_ns: int) -> None:
        """Append messages that show `samples`."""
        disk = os.fstatvfs(self._descriptor)
        if disk.f_bavail * disk.f_frsize < BAG_RESERVE:
            raise OSError(28, f"the disk is full but for {BAG_RESERVE >> 20} MiB")
        count = samples.shape[1]
        for begin in range(0, count, self._chunk):
            piece = samples[:, begin : begin + self._chunk]
            self._window.append(piece)
            self._count(piece.shape[1])
            behind = count - begin - piece.shape[1]
            self._time_ns = time_ns - behind * 1_000_000_000 // self._sample_rate
            # Not before the window is full, for readers take all of a first window for sound.
            if self._held == self._window.frames:
                self._put()

    def _count(self, frames: int) -> None:
        self.frames += frames
        self._newest += frames
        self._held = min(self._held + frames, self._window.frames)

    def _put(self) -> None:
        """Append a message that shows what there is of the window."""
        import genpy

        full = self._held == self._window.frames
        seconds, nanoseconds = divmod(self._time_ns, 1_000_000_000)
        left, right = self._window.view()[:, -self._held :]
        message = self._message_class(
            sampleRate=self._sample_rate,
            nChunksOnPort=BAG_CHUNKS if full else 1,
            nFramesPerChunk=self._chunk if full else self._held,
            lastFrameIndex=self._newest,
            left=left,
            right=right,
            stamp={"sec": seconds, "nsec": nanoseconds},
        )
        self._bag.write(self._topic, message, genpy.Time(seconds, nanoseconds))

    def lose(self, frames: int) -> None:
        """Let the numbers go on, and silence be in the windows."""
        self._put_unshown()
        self._window.skip(frames)
        self._count(frames)

    def _put_unshown(self) -> None:
        """Show what has filled no window yet."""
        if 0 < self._held < self._window.frames:
            self._put()

    def close(self) -> None:
        """Write the bag's index."""
        try:
            self._put_unshown()
        finally:
            self._bag.close()
