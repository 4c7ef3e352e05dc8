"""The Audio input port: a ring of frames that is filled from sliding windows, and the readers of it.

If audio is missing, the processors get this (docs/audio-stream.md):

* Lost frames are replaced by zeros, so that all later frames keep their numbers.
* If the tree falls behind by more than the ring holds, its next block begins after the frames that it missed.
* A new stream (the index decreased, or increased by more than the ring holds, or the sample rate changed) begins a new
  block, and unread frames of the old stream are dropped.
* If the index continues but the samples do not fit the previous ones (the source has restarted unnoticed), the frames
  are used as they are numbered.

All of this is counted, and logged once per event.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from rosafe.audio.files.windows import rows_of, split_new_frames, window_error
from rosafe.ros1.component.frame_clock import FrameTime, LinearClock
from rosafe.ros1.component.frame_ring import FrameRing
from rosafe.ros1.component.lag import LagMonitor

RING_SECONDS = 10.0  # the tree may fall behind by this much before frames are lost
OVERLAP_CHECK_FRAMES = 1000  # frames of a window that are compared with the previous window
CURRENT_CHUNKS = 2  # a message is of a running acquisition if its newest frame is at most this old
NEXT_MESSAGE_SECONDS = 0.25  # that a new reader waits for another message if the last one is older
COMBINED_SECONDS = 0.1  # of sound; the most that a reader of unobserved blocks reads at once
PAUSE_SECONDS = 0.05  # after a message; then such a reader does not wait for more sound


@dataclass
class Counters:
    """Events of the audio since the node has started."""

    messages: int = 0
    refused: int = 0  # malformed messages
    lost: int = 0  # frames that were not received, or were overwritten before the tree read them
    gaps: int = 0  # events in which frames were lost
    streams: int = 0
    dropped: int = 0  # unread frames of old streams
    breaks: int = 0  # windows whose samples did not fit the previous ones
    last_loss: str = "none"  # position of the last loss


class AudioRing:
    """The last seconds of a binaural stream, written by one thread and read by others.

    Frames are numbered as in bass: the first frame of a stream is 1, and `lastFrameIndex` is the newest one.

    Parameters
    ----------
    report : callable
        Called with one line for the log per event.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self.counters = Counters()
        self.sample_rate = 0  # of the stream; 0 before the first message
        self._frames = FrameRing()
        self._times = FrameTime()
        self._report = report
        self._arrived = threading.Condition()  # also guards all attributes
        self._window = 0  # frames in the last message
        self._current_until = 0.0  # s since 1970, of the last message; infinite if it has no stamp
        self._arrived_at = 0.0  # s, monotonic, of the last message
        self._discontinuity = 1  # number of the first frame after the last one
        self._readers: list[AudioReader] = []
        self._connection: object = None
        self._refusing = self._in_discontinuity = False  # whether this was reported already

    # --- the writer: rospy's thread ---

    def connect(self) -> Callable[[Any], None]:
        """Start a new connection. Return its callback for messages (`binaudio_portStruct` with arrays).

        Messages of previous connections are ignored from now on.
        """
        connection = object()
        with self._arrived:
            self._drop_unread()
            self.sample_rate = 0
            self._connection = connection
        return lambda message: self._feed(connection, message)

    def _feed(self, connection: object, message: Any) -> None:
        """Append the new frames of a window."""
        with self._arrived:
            if connection is not self._connection:
                return
            if problem := window_error(message):
                self._refuse(problem)
                return
            self.counters.messages += 1
            self._refusing = False
            newest, window = int(message.lastFrameIndex), len(message.left)
            self._join_stream(int(message.sampleRate), newest, window)
            lost, fresh = split_new_frames(newest - self._frames.newest, window)
            self._check_overlap(message, window - fresh)
            if lost:
                self._record_gap(self._frames.newest + 1, lost)
                self._frames.append(np.zeros((2, lost), np.int32))
            self._frames.append(rows_of(message, window - fresh, window))
            stamp = message.stamp["sec"] + 1e-9 * message.stamp["nsec"]  # s since 1970; 0 if it is not given
            if fresh or lost:
                self._times.add(newest, stamp or time.time())
            chunk_seconds = message.nFramesPerChunk / message.sampleRate
            self._current_until = stamp + CURRENT_CHUNKS * chunk_seconds if stamp else math.inf
            self._arrived.notify_all()
            self._arrived_at = now = time.monotonic()
            callbacks = []
            for reader in self._readers:
                reader.lag.update(self._unread(reader), now)
                if self._is_complete(reader, now):
                    callbacks.append(reader.wake)
        for wake in callbacks:
            wake()

    def refuse(self, why: str) -> None:
        """Count a message that could not be deserialized."""
        with self._arrived:
            self._refuse(why)

    def _refuse(self, why: str) -> None:
        self.counters.messages += 1
        self.counters.refused += 1
        if not self._refusing:
            self._report(f"Audio: malformed messages are ignored: {why}")
        self._refusing = True

    def _join_stream(self, sample_rate: int, newest: int, window: int) -> None:
        """Continue the stream if frame `newest` belongs to it, else begin a new one."""
        before = self._frames.newest
        if self.sample_rate == 0:
            why = ""
        elif sample_rate != self.sample_rate:
            why = f"it was at {self.sample_rate} Hz"
        elif newest < before:
            why = f"its index fell from {before} to {newest}"
        elif newest - before > max(self._frames.capacity, window):
            self._record_gap(before + 1, newest - before - window)
            why = f"its index jumped from {before} to {newest}"
        else:
            if window != self._window:
                self._report(f"Audio: the window changed from {self._window} to {window} frames")
                self._window = window
                self._frames.reserve(window)
            return
        self._begin(sample_rate, newest, window)
        if why:
            self._report(f"Audio: a new stream at {sample_rate} Hz, frame {newest} ({why})")
        for rate in {reader.sample_rate for reader in self._readers} - {sample_rate}:
            self._report(f"Audio: the tree runs at {rate:g} Hz and does not read this stream; call Stop")

    def _begin(self, sample_rate: int, newest: int, window: int) -> None:
        """Begin a new stream. The current message contains its newest min(window, newest) frames."""
        self._drop_unread()
        capacity = max([int(RING_SECONDS * sample_rate), window, *(r.required_frames for r in self._readers)])
        self._frames.clear(capacity, max(0, newest - window))
        self._discontinuity = self._frames.oldest
        self.sample_rate, self._window = sample_rate, window
        self._times.begin(sample_rate)
        self.counters.streams += 1
        for reader in self._readers:
            reader.position, reader.awaited = self._frames.oldest, 0

    def _drop_unread(self) -> None:
        unread = self._max_unread()
        if unread:
            self.counters.dropped += unread
            self._report(f"Audio: {unread} unread frames of the old stream are dropped")
        for reader in self._readers:
            reader.position = self._frames.newest + 1

    def _check_overlap(self, message: Any, known: int) -> None:
        """Compare the last of the first `known` samples of a window with those in the ring."""
        after = self._frames.newest + 1
        count = min(known, after - max(self._frames.oldest, self._discontinuity), OVERLAP_CHECK_FRAMES)
        fits = self._frames.holds(after - count, rows_of(message, known - count, known))
        if not fits:
            self._discontinuity = after
            self._times.begin(self.sample_rate)
            self.counters.breaks += 1
            if not self._in_discontinuity:
                self._report(
                    f"Audio: the index continued to {message.lastFrameIndex}, but the samples up to {after - 1} differ "
                    "from those received before: another stream began"
                )
        self._in_discontinuity = not fits

    def _record_gap(self, first: int, count: int) -> None:
        if count <= 0:
            return
        self.counters.lost += count
        self.counters.gaps += 1
        self.counters.last_loss = f"{count} frames from frame {first} on"
        self._report(f"Audio: lost {self.counters.last_loss} ({count / self.sample_rate:.3f} s)")

    # --- the readers ---

    def open_reader(self, frames_per_block: int, timeout: float, give_up: Callable[[], bool]) -> AudioReader | None:
        """Return a reader that begins with the next frame.

        Waits up to `timeout` seconds for a first message, unless `give_up()`. Returns None if there is none. If the
        last message is from an acquisition that has ended, waits a moment for another one: the first message of a new
        acquisition, perhaps at another sample rate, may still be on its way.
        """
        start = time.monotonic()
        with self._arrived:
            while self.sample_rate == 0 or time.time() > self._current_until:
                limit = min(timeout, NEXT_MESSAGE_SECONDS) if self.sample_rate else timeout
                left = start + limit - time.monotonic()
                if left <= 0 or give_up():
                    break
                self._arrived.wait(min(left, 0.05))
            if self.sample_rate == 0:
                return None
            lag = LagMonitor(self.sample_rate, frames_per_block, self._report)
            reader = AudioReader(self, frames_per_block, self.sample_rate, self._frames.newest + 1, lag)
            self._frames.reserve(reader.required_frames)
            self._readers.append(reader)
            return reader

    def _max_unread(self) -> int:
        return max(map(self._unread, self._readers), default=0)

    def _unread(self, reader: AudioReader) -> int:
        """Return the number of frames that `reader` has not read yet."""
        if reader.sample_rate != self.sample_rate:
            return 0
        return self._frames.newest + 1 - max(reader.position, self._frames.oldest)

    def read(self, reader: AudioReader) -> tuple[np.ndarray, int] | None:
        """Return the next block of `reader`, or several unobserved ones, and the number of the frame after it."""
        count, frames = reader.frames_per_block, self._frames
        with self._arrived:
            if reader.ended or self.sample_rate != reader.sample_rate:
                return None
            if reader.position < frames.oldest:
                self._record_gap(reader.position, frames.oldest - reader.position)
                reader.position = frames.oldest
            blocks = min((frames.newest + 1 - reader.position) // count, reader.planned or reader.combined_blocks())
            if blocks < 1:
                return None
            first, reader.position = reader.position, reader.position + blocks * count
            reader.lag.blocks_read(blocks)
            reader.lag.update(self._unread(reader), time.monotonic())
            return frames.copy(first, blocks * count), reader.position

    def _is_complete(self, reader: AudioReader, now: float) -> bool:
        """Return whether there are as many unread blocks as `reader` reads at once."""
        unread = self._unread(reader) // reader.frames_per_block
        reader.planned = reader.combined_blocks() if unread >= 1 else 0
        if not 1 <= unread < reader.planned:
            return unread >= 1
        return reader.position <= reader.awaited or now - self._arrived_at > PAUSE_SECONDS

    def waiting(self, reader: AudioReader) -> bool:
        """Return whether `reader` has nothing to read yet."""
        with self._arrived:
            return not self._is_complete(reader, time.monotonic())

    def catch_up(self) -> bool:
        """Let all readers read the blocks that have arrived. Return whether there were any."""
        with self._arrived:
            late = [reader for reader in self._readers if self._unread(reader) >= reader.frames_per_block]
            for reader in late:
                reader.awaited, reader.planned = self._frames.newest, 0
        for reader in late:
            reader.wake()
        return bool(late)

    def stop(self, reader: AudioReader) -> None:
        """Remove a reader."""
        with self._arrived:
            reader.ended = True
            if reader in self._readers:
                self._readers.remove(reader)

    def captured(self, frame: int) -> LinearClock | None:
        """Return the clock that says when frame `frame` of the stream was captured, or None if this is not known."""
        with self._arrived:
            return self._times.line(frame)

    @property
    def behind(self) -> int:
        """The number of frames that have been received and not read."""
        with self._arrived:
            return self._max_unread()

    @property
    def lag(self) -> str:
        """One line if a reader does not keep up with the stream, otherwise an empty string."""
        with self._arrived:
            return next((reader.lag.problem for reader in self._readers if reader.lag.problem), "")


class AudioReader:
    """The source of the input processor: successive blocks of one stream.

    Audio at another rate than at the start is not delivered, because the tree was built for that rate.
    """

    def __init__(
        self, ring: AudioRing, frames_per_block: int, sample_rate: float, position: int, lag: LagMonitor
    ) -> None:
        self.frames_per_block = frames_per_block
        self.required_frames = 2 * frames_per_block  # the block to read, and the one that arrives meanwhile
        self.sample_rate = float(sample_rate)
        self.position = position  # number of the next frame to read; set by the ring
        self.lag = lag
        self.awaited = 0  # number of the last frame that a request waits for
        self.planned = 0  # blocks to read at once, from the last check whether there are enough; 0 before the first
        self.ended = False
        # Called with the length of a block. Blocks that end before the returned frame are not needed yet.
        self.next_output: Callable[[int], float] = lambda _: 0
        self.wake: Callable[[], None] = lambda: None
        self._ring = ring

    def combined_blocks(self) -> int:
        """Return the number of blocks to read at once."""
        most = int(COMBINED_SECONDS * self.sample_rate / self.frames_per_block)
        needed = (self.next_output(self.frames_per_block) - self.position) / self.frames_per_block
        return max(1, most if needed > most else math.ceil(needed))

    def open(self, wake: Callable[[], None]) -> None:
        """Call `wake` whenever audio has arrived."""
        self.wake = wake

    def read(self) -> tuple[np.ndarray, int] | None:
        """Return the next block, int32 (2, n), and the number of the frame after it, or None if it is incomplete."""
        return self._ring.read(self)

    @property
    def waiting(self) -> bool:
        """Whether there is nothing to read yet; `wake` is called when there is."""
        return not self.ended and self._ring.waiting(self)

    def stop(self) -> None:
        """Read no further block, and forget the function of `open`, which refers to the caller."""
        self._ring.stop(self)
        self.wake = lambda: None
