"""The acquisition loop: from a source to snapshots of the window on the port Audio. Does not use ROS."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rosafe import interface
from rosafe.audio.devices import SoundSource
from rosafe.audio.devices.base import hwparams_error, loss_text, take_remarks, wall_time_ns
from rosafe.audio.files.windows import MAX_WINDOW

LATE_CHUNKS = 2  # if capture is later than this, chunks are published together


@dataclass(frozen=True)
class Snapshot:
    """The content of the port at one time. The arrays are read-only and do not change."""

    sample_rate: int
    chunks_on_port: int
    frames_per_chunk: int
    last_frame_index: int  # number of frames so far, including lost frames
    left: np.ndarray  # int32, (frames_per_chunk * chunks_on_port,), newest last
    right: np.ndarray
    time_ns: int  # when the newest frame was acquired, since 1970; 0 before the first frame


def check_window(frames_per_chunk: int, chunks_on_port: int) -> None:
    """Raise ``::bass::e_hwparams`` if the window on the port is too long."""
    if frames_per_chunk * chunks_on_port > MAX_WINDOW:
        raise hwparams_error(
            f"nChunksOnPort: expected at most {MAX_WINDOW} frames on the port, "
            f"got {chunks_on_port} chunks of {frames_per_chunk} frames"
        )


class AudioWindow:
    """The newest `frames` frames of a two-channel int32 signal, preceded by zeros until there are enough.

    Frames are appended to a buffer in which the window moves; at its end, a new buffer begins. The content of a view
    therefore never changes, and the cost of appending does not depend on the length of the window.
    """

    def __init__(self, frames: int) -> None:
        self.frames = frames
        self._buffer = np.zeros((2, 2 * frames), np.int32)
        self._end = frames

    def append(self, samples: np.ndarray) -> None:
        """Append `samples`, (2, n)."""
        samples = samples[:, -self.frames :]
        self._make_room(samples.shape[1])
        self._buffer[:, self._end : self._end + samples.shape[1]] = samples
        self._end += samples.shape[1]

    def skip(self, frames: int) -> None:
        """Append `frames` frames of silence."""
        frames = min(frames, self.frames)
        self._make_room(frames)
        self._end += frames  # still zero, as this part was never written

    def _make_room(self, frames: int) -> None:
        if self._end + frames > self._buffer.shape[1]:
            fresh = np.zeros_like(self._buffer)
            fresh[:, : self.frames] = self.view()
            self._buffer, self._end = fresh, self.frames

    def view(self) -> np.ndarray:
        """Return the current window: int32, (2, frames), read-only; it never changes."""
        view = self._buffer[:, self._end - self.frames : self._end]
        view.flags.writeable = False
        return view


class Capture:
    """One acquisition.

    Parameters
    ----------
    source : SoundSource
        Open; the caller closes it.
    frames_per_chunk, chunks_on_port : int
        Size of the window; see `check_window`.
    publish : callable
        Called with each new `Snapshot`.
    report : callable
        Called with one line for each loss of sound.

    Raises
    ------
    interface.ComponentError
        ``::bass::e_nomem`` if the window does not fit into memory.
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
                "e_nomem", f"not enough memory for {chunks_on_port} chunks of {frames_per_chunk} frames"
            ) from None

    def run(self, stopping: threading.Event, cycle: Callable[[float], None]) -> None:
        """Read and publish until the source ends or fails, or a stop; `cycle` gets the seconds that each chunk took."""
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
            for text in take_remarks(self.source):
                self._report(text)
            new = chunk.gap + chunk.samples.shape[1]
            if not new:  # a pause of the source has begun
                continue
            self._window.skip(chunk.gap)
            self._window.append(chunk.samples)
            self.last_frame_index += new
            self._unpublished += new
            self._time_ns = wall_time_ns(chunk.time)
            # stamps of other drivers may be from another clock
            if not self._may_defer_publish(getattr(self.source, "behind", begin - chunk.time)):
                self.publish()
            cycle(time.monotonic() - begin)
        if self._unpublished:
            self.publish()

    def _may_defer_publish(self, late: float) -> bool:
        """Return whether to publish with a later chunk, to catch up; never so late that a reader could miss a frame."""
        sample_rate, _, frames_per_chunk = self._sizes
        return late * sample_rate > LATE_CHUNKS * frames_per_chunk and self._unpublished * 2 <= self._window.frames

    def publish(self) -> None:
        """Publish the current window; before the first frame all zeros, with index 0 and without a stamp."""
        left, right = self._window.view()
        self._unpublished = 0
        self._publish(Snapshot(*self._sizes, self.last_frame_index, left, right, self._time_ns))
