"""The Audio input port: a ring addressed by absolute frame number, filled from the sliding windows that come in.

What the processors see when something is missing (docs/audio-stream.md):

* Frames that never came are zeros in their place, so that every later frame keeps its number.
* Where the tree falls behind by more than the ring holds, its next block begins after the frames that it missed.
* A new stream (the index fell, or jumped by more than the ring holds; another sample rate) begins a new block, and
  unread frames of the old stream are dropped.
* Where the index goes on but the samples do not fit those before (somebody began anew, unnoticed), the frames are
  taken as they are numbered.

All of it is counted, and logged once per event.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from rosafe.component.frame_clock import FrameTime, LinearClock
from rosafe.component.lag import LagMonitor
from rosafe.sound.windows import split_new_frames, window_error

RING_SECONDS = 10.0  # how far the tree may fall behind before frames are lost
OVERLAP_CHECK_FRAMES = 1000  # frames of a window that are compared with what came before


@dataclass
class Counters:
    """What happened to the audio since the node started."""

    messages: int = 0
    refused: int = 0  # malformed messages
    lost: int = 0  # frames that never came, or came and were overwritten before the tree read them
    gaps: int = 0  # events in which frames were lost
    streams: int = 0  # streams begun
    dropped: int = 0  # unread frames of old streams
    breaks: int = 0  # times that the samples of a window did not fit those before
    last_loss: str = "none"  # where the last loss was


class AudioRing:
    """The newest seconds of a binaural stream, written by one thread and read by others.

    Frames are numbered as bass does: the first frame of a stream is 1, and `lastFrameIndex` is the newest one.

    Parameters
    ----------
    report : callable
        Gets one line for the log per event.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self.counters = Counters()
        self.sample_rate = 0  # of the stream; 0 where nothing has come yet
        self._times = FrameTime()
        self._report = report
        self._turn = threading.Condition()
        self._samples = np.zeros((2, 0), np.int32)
        self._window = 0  # frames in the last message
        self._newest = 0  # number of the newest frame
        self._oldest = 1  # number of the oldest frame that the ring holds
        self._discontinuity = 1  # number of the first frame after the last break
        self._readers: list[AudioReader] = []
        self._connection: object = None
        self._refusing = self._in_discontinuity = False  # told the log so already

    # --- the writing side: rospy's thread ---

    def connect(self) -> Callable[[Any], None]:
        """Forget what there was, and return what takes the messages (`binaudio_portStruct` with arrays) from now on.

        What earlier connections still deliver is ignored.
        """
        connection = object()
        with self._turn:
            self._drop_unread()
            self.sample_rate = 0
            self._connection = connection
        return lambda message: self._feed(connection, message)

    def _feed(self, connection: object, message: Any) -> None:
        """Take what is new in a window."""
        with self._turn:
            if connection is not self._connection:
                return
            self.counters.messages += 1
            problem = window_error(message)
            if problem:
                self._refuse(problem)
                return
            self._refusing = False
            newest, window = int(message.lastFrameIndex), len(message.left)
            self._join_stream(int(message.sampleRate), newest, window)
            lost, fresh = split_new_frames(newest - self._newest, window)
            self._compare(message, window - fresh)
            if lost:
                self._record_gap(self._newest + 1, lost)
                self._write(np.zeros((2, lost), np.int32))
            self._write(np.stack((message.left[window - fresh :], message.right[window - fresh :])))
            if fresh or lost:
                self._times.add(newest, _stamp(message) or time.time())
            self._turn.notify_all()
            now = time.monotonic()
            for reader in self._readers:
                reader.lag.update(self._waiting(reader), now)
            waiting = [reader.wake for reader in self._readers]
        for wake in waiting:
            wake()

    def refuse(self, why: str) -> None:
        """Count a message that could not even be read."""
        with self._turn:
            self.counters.messages += 1
            self._refuse(why)

    def _refuse(self, why: str) -> None:
        self.counters.refused += 1
        if not self._refusing:
            self._report(f"Audio: malformed messages are ignored: {why}")
        self._refusing = True

    def _join_stream(self, sample_rate: int, newest: int, window: int) -> None:
        """Go on with the stream that `newest` belongs to, be it the one so far or a new one."""
        if self.sample_rate == 0:
            why = ""
        elif sample_rate != self.sample_rate:
            why = f"it was at {self.sample_rate} Hz"
        elif newest < self._newest:
            why = f"its index fell from {self._newest} to {newest}"
        elif newest - self._newest > max(self._capacity, window):
            self._record_gap(self._newest + 1, newest - self._newest - window)
            why = f"its index jumped from {self._newest} to {newest}"
        else:
            if window != self._window:
                self._report(f"Audio: the window changed from {self._window} to {window} frames")
                self._window = window
                self._reserve(window)
            return
        self._begin(sample_rate, newest, window)
        if why:
            self._report(f"Audio: a new stream at {sample_rate} Hz, frame {newest} ({why})")
        for waiting in {reader.sample_rate for reader in self._readers} - {sample_rate}:
            self._report(f"Audio: the tree runs at {waiting:g} Hz and takes nothing of this stream; call Stop")

    def _begin(self, sample_rate: int, newest: int, window: int) -> None:
        """A new stream, of which the newest min(window, newest) frames are in the message at hand."""
        capacity = max([int(RING_SECONDS * sample_rate), window, *(r.room for r in self._readers)])
        self._drop_unread()
        self._samples = np.zeros((2, capacity), np.int32)
        self._newest = max(0, newest - window)
        self._oldest = self._discontinuity = self._newest + 1
        self.sample_rate, self._window = sample_rate, window
        self._times.begin(sample_rate)
        self.counters.streams += 1
        for reader in self._readers:
            reader.position = self._oldest

    def _drop_unread(self) -> None:
        unread = self._unread()
        if unread:
            self.counters.dropped += unread
            self._report(f"Audio: {unread} unread frames of the old stream are dropped")
        for reader in self._readers:
            reader.position = self._newest + 1

    def _compare(self, message: Any, known: int) -> None:
        """Look whether the first `known` samples of a window are those that came before; few of them tell."""
        count = min(known, self._newest + 1 - max(self._oldest, self._discontinuity), OVERLAP_CHECK_FRAMES)
        held = self._copy(self._newest + 1 - count, count)
        fits = all(
            np.array_equal(ear, came[known - count : known])
            for ear, came in zip(held, (message.left, message.right), strict=True)
        )
        if not fits:
            self._discontinuity = self._newest + 1
            self._times.begin(self.sample_rate)
            self.counters.breaks += 1
            if not self._in_discontinuity:
                self._report(
                    f"Audio: the index went on to {message.lastFrameIndex}, but the samples up to {self._newest} are "
                    "not those that came before: another stream began"
                )
        self._in_discontinuity = not fits

    def _record_gap(self, first: int, count: int) -> None:
        if count <= 0:
            return
        self.counters.lost += count
        self.counters.gaps += 1
        self.counters.last_loss = f"{count} frames from frame {first} on"
        self._report(f"Audio: lost {self.counters.last_loss} ({count / self.sample_rate:.3f} s)")

    @property
    def _capacity(self) -> int:
        return self._samples.shape[1]

    def _reserve(self, capacity: int) -> None:
        """Make room for so many frames; those that are here stay."""
        if self._capacity < capacity:
            held = self._copy(self._oldest, self._newest + 1 - self._oldest)
            self._samples = np.zeros((2, capacity), np.int32)
            self._newest = self._oldest - 1
            self._write(held)

    def _write(self, samples: np.ndarray) -> None:
        """Append (2, n) frames, at most as many as the ring holds."""
        count = samples.shape[1]
        at = (self._newest + 1) % self._capacity
        head = min(count, self._capacity - at)
        self._samples[:, at : at + head] = samples[:, :head]
        self._samples[:, : count - head] = samples[:, head:]
        self._newest += count
        self._oldest = max(self._oldest, self._newest - self._capacity + 1)

    def _copy(self, first: int, count: int) -> np.ndarray:
        """Frames `first` and on, (2, count); they must be in the ring."""
        samples = np.empty((2, count), np.int32)
        if count:
            at = first % self._capacity
            head = min(count, self._capacity - at)
            samples[:, :head] = self._samples[:, at : at + head]
            samples[:, head:] = self._samples[:, : count - head]
        return samples

    # --- the reading side ---

    def open_reader(self, frames_per_block: int, timeout: float, give_up: Callable[[], bool]) -> AudioReader | None:
        """A reader that begins with the next frame to come.

        Waits up to `timeout` seconds for a first message, unless `give_up()`; None where there is none.
        """
        deadline = time.monotonic() + timeout
        with self._turn:
            while self.sample_rate == 0:
                left = deadline - time.monotonic()
                if left <= 0 or give_up():
                    return None
                self._turn.wait(min(left, 0.05))
            lag = LagMonitor(self.sample_rate, frames_per_block, self._report)
            reader = AudioReader(self, frames_per_block, self.sample_rate, self._newest + 1, lag)
            self._reserve(reader.room)
            self._readers.append(reader)
            return reader

    def _unread(self) -> int:
        return max(map(self._waiting, self._readers), default=0)

    def _waiting(self, reader: AudioReader) -> int:
        """Return how many frames `reader` has not read yet."""
        if reader.sample_rate != self.sample_rate:
            return 0
        return self._newest + 1 - max(reader.position, self._oldest)

    def read(self, reader: AudioReader) -> tuple[np.ndarray, int] | None:
        """The next block of `reader`, and the number of the frame after it; None where it has not come yet."""
        count = reader.frames_per_block
        with self._turn:
            if reader.ended or self.sample_rate != reader.sample_rate:
                return None
            if reader.position < self._oldest:
                self._record_gap(reader.position, self._oldest - reader.position)
                reader.position = self._oldest
            if self._newest + 1 - reader.position < count:
                return None
            reader.position += count
            reader.lag.block_read()
            reader.lag.update(self._newest + 1 - reader.position, time.monotonic())
            return self._copy(reader.position - count, count), reader.position

    def stop(self, reader: AudioReader) -> None:
        """Nobody reads with `reader` any more."""
        with self._turn:
            reader.ended = True
            if reader in self._readers:
                self._readers.remove(reader)

    def captured(self, frame: int) -> LinearClock | None:
        """When frame `frame` of the stream was captured; None where that is not known."""
        with self._turn:
            return self._times.line(frame)

    @property
    def behind(self) -> int:
        """Frames that have come and were not read yet."""
        with self._turn:
            return self._unread()

    @property
    def lag(self) -> str:
        """One line if a reader does not keep up with the stream, else an empty text."""
        with self._turn:
            return next((reader.lag.problem for reader in self._readers if reader.lag.problem), "")


def _stamp(message: Any) -> float:
    """When the newest frame of a message was captured (s since 1970); 0 where it does not say."""
    return float(message.stamp.sec + 1e-9 * message.stamp.nsec)


class AudioReader:
    """What the input processor reads: whole blocks of one stream after the other.

    Audio at another rate than at the start is not given to the tree, which was built for that rate.
    """

    def __init__(
        self, ring: AudioRing, frames_per_block: int, sample_rate: float, position: int, lag: LagMonitor
    ) -> None:
        self.frames_per_block = frames_per_block
        self.sample_rate = float(sample_rate)
        self.position = position  # number of the next frame to read; kept by the ring
        self.lag = lag
        self.ended = False
        self.wake: Callable[[], None] = lambda: None
        self._ring = ring

    @property
    def room(self) -> int:
        """Frames that the ring must hold for it: one block to read, and one that comes meanwhile."""
        return 2 * self.frames_per_block

    def open(self, wake: Callable[[], None]) -> None:
        """From now on call `wake` whenever sound has come."""
        self.wake = wake

    def read(self) -> tuple[np.ndarray, int] | None:
        """The next block, int32 (2, n), and the number of the frame after it; None where it has not come yet."""
        return self._ring.read(self)

    def stop(self) -> None:
        """Nothing is read any more."""
        self._ring.stop(self)
