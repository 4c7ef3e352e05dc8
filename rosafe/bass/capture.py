"""The acquisition loop: from a source to snapshots of the window on the port Audio. No ROS in here."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rosafe import interface
from rosafe.bass.sources import SoundSource
from rosafe.bass.sources.base import hwparams_error, loss_text, wall_time_ns

MAX_WINDOW = 2**24  # frames on the port, 380 s at 44.1 kHz; what goes beyond is a slip of the finger
LATE_CHUNKS = 2  # behind the clock by more than this, chunks are published together


@dataclass(frozen=True)
class Snapshot:
    """The port's content at one moment. The arrays are read-only and stay as they are."""

    sample_rate: int
    chunks_on_port: int
    frames_per_chunk: int
    last_frame_index: int  # frames streamed so far, lost ones included
    left: np.ndarray  # int32, (frames_per_chunk * chunks_on_port,), newest last
    right: np.ndarray
    time_ns: int  # when the newest frame was acquired, since 1970; 0 before there was one


def check_window(frames_per_chunk: int, chunks_on_port: int) -> None:
    """Refuse a window that nobody can want, by ``::bass::e_hwparams``."""
    if frames_per_chunk * chunks_on_port > MAX_WINDOW:
        raise hwparams_error(
            f"{chunks_on_port} chunks of {frames_per_chunk} frames are too many for the port, "
            f"at most {MAX_WINDOW} frames go together"
        )


class AudioWindow:
    """The newest `frames` frames of a two-channel int32 signal; before there are so many, zeros come first.

    Frames are appended to a buffer in which the window moves; where it ends, a new one begins. So what a view shows
    never changes, and appending costs the same for long and short windows.
    """

    def __init__(self, frames: int) -> None:
        self.frames = frames
        self._buffer = np.zeros((2, 2 * frames), np.int32)
        self._end = frames

    def append(self, samples: np.ndarray) -> None:
        """Shift left and put `samples`, (2, n), at the end."""
        samples = samples[:, -self.frames :]
        self._make_room(samples.shape[1])
        self._buffer[:, self._end : self._end + samples.shape[1]] = samples
        self._end += samples.shape[1]

    def skip(self, frames: int) -> None:
        """Shift left by `frames` frames of silence."""
        frames = min(frames, self.frames)
        self._make_room(frames)
        self._end += frames  # never written before, so zero

    def _make_room(self, frames: int) -> None:
        if self._end + frames > self._buffer.shape[1]:
            fresh = np.zeros_like(self._buffer)
            fresh[:, : self.frames] = self.view()
            self._buffer, self._end = fresh, self.frames

    def view(self) -> np.ndarray:
        """The window as it is now: int32, (2, frames), read-only, valid for ever."""
        view = self._buffer[:, self._end - self.frames : self._end]
        view.flags.writeable = False
        return view


class Capture:
    """One acquisition.

    Parameters
    ----------
    source : SoundSource
        Open; it stays the caller's to close.
    frames_per_chunk, chunks_on_port : int
        Size of the window; see `check_window`.
    publish : callable
        Takes every new `Snapshot`.
    report : callable
        Takes one line about each loss of sound.

    Raises
    ------
    interface.ComponentError
        ``::bass::e_nomem`` where the window does not fit into memory.
    """

    def __init__(
        self,
        source: SoundSource,
        frames_per_chunk: int,
        chunks_on_port: int,
        publish: Callable[[Snapshot], None],
        report: Callable[[str], None],
    ) -> None:
        self.source = source
        self.last_frame_index = 0
        self._sizes = source.sample_rate, chunks_on_port, frames_per_chunk
        self._publish = publish
        self._report = report
        self._time_ns = 0
        self._unpublished = 0
        try:
            self._window = AudioWindow(frames_per_chunk * chunks_on_port)
        except MemoryError:
            raise interface.BASS.error(
                "e_nomem", f"no memory for {chunks_on_port} chunks of {frames_per_chunk} frames"
            ) from None

    def run(self, stopping: threading.Event, cycle: Callable[[float], None]) -> None:
        """Read and publish until the source ends, fails or is told to stop; `cycle` takes the seconds of each turn."""
        known_lost = 0
        while not stopping.is_set():
            chunk = self.source.read()
            if chunk is None:
                break
            begin = time.monotonic()
            lost = self.source.lost_frames - known_lost
            if lost:
                known_lost += lost
                self._report(loss_text(lost, self.last_frame_index, self.source.sample_rate))
            self._window.skip(chunk.gap)
            self._window.append(chunk.samples)
            new = chunk.gap + chunk.samples.shape[1]
            self.last_frame_index += new
            self._unpublished += new
            self._time_ns = wall_time_ns(chunk.time)
            if not self._may_defer_publish(begin - chunk.time):
                self.publish()
            cycle(time.monotonic() - begin)
        if self._unpublished:
            self.publish()

    def _may_defer_publish(self, late: float) -> bool:
        """Whether to catch up first, and publish with a later chunk; never so long that a reader could miss a frame."""
        sample_rate, _, frames_per_chunk = self._sizes
        return late * sample_rate > LATE_CHUNKS * frames_per_chunk and self._unpublished * 2 <= self._window.frames

    def publish(self) -> None:
        """Publish the window as it is: at first all zeros, with index 0 and no stamp."""
        left, right = self._window.view()
        self._unpublished = 0
        self._publish(Snapshot(*self._sizes, self.last_frame_index, left, right, self._time_ns))
