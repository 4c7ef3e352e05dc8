"""Recording: sound from any source, with its levels, into a WAV file of any length, or a bag as of the port Audio."""

from __future__ import annotations

import os
import struct
import threading
from collections.abc import Callable
from typing import IO

import numpy as np

from rosafe.audio.devices import SoundSource
from rosafe.audio.devices.base import loss_text, take_remarks, wall_time_ns
from rosafe.audio.files.levels import LevelMeter
from rosafe.audio.stream.capture import AudioWindow

HEADER_SECONDS = 1.0  # of sound: the maximum loss of a WAV if the process is killed
RIFF_LIMIT = 2**32 - 1  # bytes; a longer file is written as RF64
BAG_CHUNKS = 4  # in a window of a bag, so that a reader can miss three consecutive messages
BAG_RESERVE = 64 * 2**20  # bytes of free disk space that are needed to close a bag


class WavFile:
    """A WAV file of two channels with 32 bits; from 4 GiB on an RF64 (EBU Tech 3306), which libsndfile reads as a WAV.

    Its header is updated every second of sound, so that an interrupted recording can be read.

    Parameters
    ----------
    descriptor : int
        Of an empty file, open for writing; `close` leaves it open.
    sample_rate : int
        Hz.
    """

    _FRAME = 8  # bytes
    _HEADER = 80  # bytes

    def __init__(self, descriptor: int, sample_rate: int) -> None:
        self._sample_rate = sample_rate
        self.frames = 0  # number of frames in the file, including lost frames
        self._in_header = 0  # number of frames according to the header
        self._file: IO[bytes] = os.fdopen(descriptor, "wb", buffering=0, closefd=False)
        self._write_header()

    def write(self, samples: np.ndarray, time_ns: int) -> None:
        """Append `samples`, int32 (2, n). A WAV cannot store their time. Raises OSError."""
        # Unbuffered, so that the number of frames always follows from the file's length.
        rest = np.ascontiguousarray(samples.T, "<i4").data.cast("B")
        while rest:
            rest = rest[self._file.write(rest) :]
        self.frames += samples.shape[1]
        if self.frames - self._in_header >= HEADER_SECONDS * self._sample_rate:
            self._write_header()

    def lose(self, frames: int) -> None:
        """Append silence in place of `frames` lost frames. Raises OSError."""
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
        """Truncate the file to complete frames and update the header, also after an OSError."""
        if not self._file.closed:
            self.frames = max(0, os.fstat(self._file.fileno()).st_size - self._HEADER) // self._FRAME
            os.ftruncate(self._file.fileno(), self._HEADER + self.frames * self._FRAME)
            self._write_header()
            self._file.close()


class BagWriter:
    """A bag for `rosbag play` and the source `bag:`: overlapping windows on one topic, with the stream's frame indices.

    Parameters
    ----------
    descriptor : int
        Of an empty file, open for reading and writing; `close` leaves it open.
    sample_rate : int
        Hz.
    frames_per_chunk : int
        Maximum number of new frames in a message.
    topic : str
        Name of the port in the bag.
    newest : int
        Index of the frame before the first one that will be written.
    """

    def __init__(self, descriptor: int, sample_rate: int, frames_per_chunk: int, topic: str, newest: int = 0) -> None:
        import rosbag

        from rosafe.interface import BASS
        from rosafe.ros1.component import serialization

        self._descriptor = descriptor
        self._sample_rate = sample_rate
        self._chunk = frames_per_chunk
        self._topic = topic
        self.frames = 0  # number of frames in the file, including lost frames
        self._newest = newest
        self._held = 0  # number of frames in the window that belong to this recording
        self._time_ns = 0  # when the newest frame was acquired
        self._message_class = serialization.message_class("bass", BASS.port("Audio").idl)
        self._window = AudioWindow(BAG_CHUNKS * frames_per_chunk)
        self._bag = rosbag.Bag(os.fdopen(descriptor, "w+b", closefd=False), "w")

    def write(self, samples: np.ndarray, time_ns: int) -> None:
        """Append messages with `samples`, int32 (2, n), the last of which was acquired at `time_ns` since 1970."""
        disk = os.fstatvfs(self._descriptor)
        if disk.f_bavail * disk.f_frsize < BAG_RESERVE:
            raise OSError(28, f"expected at least {BAG_RESERVE >> 20} MiB of free disk space")
        count = samples.shape[1]
        for begin in range(0, count, self._chunk):
            piece = samples[:, begin : begin + self._chunk]
            if self._held + piece.shape[1] > self._window.frames:
                self._write_incomplete_window()  # its first frames leave the window now
            self._window.append(piece)
            self._count(piece.shape[1])
            behind = count - begin - piece.shape[1]
            self._time_ns = time_ns - behind * 1_000_000_000 // self._sample_rate
            # The first window must be full, as readers use all of it.
            if self._held == self._window.frames:
                self._write_message()

    def _count(self, frames: int) -> None:
        self.frames += frames
        self._newest += frames
        self._held = min(self._held + frames, self._window.frames)

    def _write_message(self) -> None:
        """Append a message with the part of the window that belongs to this recording."""
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
        """Append silence in place of `frames` lost frames, and advance the frame index."""
        self._write_incomplete_window()
        self._window.skip(frames)
        self._count(frames)

    def _write_incomplete_window(self) -> None:
        """Write the first frames if they have not filled a window yet."""
        if 0 < self._held < self._window.frames:
            self._write_message()

    def close(self) -> None:
        """Write the bag's index, also after an OSError."""
        try:
            self._write_incomplete_window()
        finally:
            self._bag.close()


Output = WavFile | BagWriter


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
            if not chunk.gap + chunk.samples.shape[1]:  # a pause of the source has begun
                continue
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
