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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rosafe.audio.files.windows import rows_of, split_new_frames, window_error
from rosafe.audio.stream.frame_clock import FrameTime, LinearClock
from rosafe.declarations.block_length import DEFAULT_FRAMES_PER_BLOCK

RING_SECONDS = 10.0  # the tree may fall behind by this much before frames are lost
OVERLAP_CHECK_FRAMES = 1000  # frames of a window that are compared with the previous window
CURRENT_CHUNKS = 2  # a message is of a running acquisition if its newest frame is at most this old
NEXT_MESSAGE_SECONDS = 0.25  # that a new reader waits for another message if the last one is older
COMBINED_SECONDS = 0.1  # of sound; the most that is read at once, in short blocks of which no output is awaited
PAUSE_SECONDS = 0.05  # after a message; then such a reader does not wait for more sound
LAG_SECONDS = 0.4  # for which at least one whole block may be waiting
BLOCK_SIZES = (110, 220, 441, 882, 2205, 4410, DEFAULT_FRAMES_PER_BLOCK)  # frames; the proposed sizes
HEADROOM = 3.0  # duration of a proposed block, divided by the computing time of a block


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


class FrameRing:
    """The newest frames of a stream, int32.

    Attributes
    ----------
    newest, oldest : int
        Numbers of the newest and the oldest frame in the ring. It is empty if `newest` is `oldest` - 1.
    """

    def __init__(self) -> None:
        self.clear(0, 0)

    def clear(self, capacity: int, newest: int) -> None:
        """Drop all frames. The next one has the number `newest` + 1."""
        self._samples = np.zeros((2, capacity), np.int32)
        self.newest, self.oldest = newest, newest + 1

    @property
    def capacity(self) -> int:
        """Maximum number of frames."""
        return self._samples.shape[1]

    def reserve(self, capacity: int) -> None:
        """Increase the capacity to at least `capacity` frames, and keep the present ones."""
        if self.capacity < capacity:
            frames = self.copy(self.oldest, self.newest + 1 - self.oldest)
            self.clear(capacity, self.oldest - 1)
            self.append(frames)

    def append(self, samples: np.ndarray | Sequence[np.ndarray]) -> None:
        """Append the samples of both ears, (2, n) or two of (n,), at most the capacity."""
        count, capacity = len(samples[0]), self.capacity
        at = (self.newest + 1) % capacity
        head = min(count, capacity - at)
        for row, new in zip(self._samples, samples, strict=True):
            row[at : at + head] = new[:head]
            if head < count:
                row[: count - head] = new[head:]
        self.newest += count
        self.oldest = max(self.oldest, self.newest - capacity + 1)

    def holds(self, first: int, samples: Sequence[np.ndarray]) -> bool:
        """Return whether the frames from number `first` on, which must be in the ring, are `samples`, int32."""
        count, at = len(samples[0]), first % max(1, self.capacity)
        if at + count > self.capacity:
            return np.array_equal(self.copy(first, count), samples)
        # Bytes are compared many times faster than short arrays.
        first_ear, second_ear = self._samples[:, at : at + count]
        return first_ear.tobytes() == samples[0].tobytes() and second_ear.tobytes() == samples[1].tobytes()

    def copy(self, first: int, count: int) -> np.ndarray:
        """Return `count` frames from number `first` on, (2, count). They must be in the ring."""
        samples = np.empty((2, count), np.int32)
        if count:
            at = first % self.capacity
            head = min(count, self.capacity - at)
            samples[:, :head] = self._samples[:, at : at + head]
            samples[:, head:] = self._samples[:, : count - head]
        return samples


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
        self.frames = FrameRing()
        self._times = FrameTime()
        self._report = report
        self.lock = threading.Condition()  # also guards all attributes
        self._window = 0  # frames in the last message
        self._current_until = 0.0  # s since 1970, of the last message; infinite if it has no stamp
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
        with self.lock:
            self._drop_unread()
            self.sample_rate = 0
            self._connection = connection
        return lambda message: self._feed(connection, message)

    def _feed(self, connection: object, message: Any) -> None:
        """Append the new frames of a window."""
        with self.lock:
            if connection is not self._connection:
                return
            if problem := window_error(message):
                self._refuse(problem)
                return
            self.counters.messages += 1
            self._refusing = False
            newest, window = int(message.lastFrameIndex), len(message.left)
            self._join_stream(int(message.sampleRate), newest, window)
            lost, fresh = split_new_frames(newest - self.frames.newest, window)
            self._check_overlap(message, window - fresh)
            if lost:
                self.record_gap(self.frames.newest + 1, lost)
                self.frames.append(np.zeros((2, lost), np.int32))
            self.frames.append(rows_of(message, window - fresh, window))
            stamp = message.stamp["sec"] + 1e-9 * message.stamp["nsec"]  # s since 1970; 0 if it is not given
            if fresh or lost:
                self._times.add(newest, stamp or time.time())
            chunk_seconds = message.nFramesPerChunk / message.sampleRate
            self._current_until = stamp + CURRENT_CHUNKS * chunk_seconds if stamp else math.inf
            self.lock.notify_all()
            readers = list(self._readers)
        for reader in readers:
            reader.notice_message()

    def refuse(self, why: str) -> None:
        """Count a message that could not be deserialized."""
        with self.lock:
            self._refuse(why)

    def _refuse(self, why: str) -> None:
        self.counters.messages += 1
        self.counters.refused += 1
        if not self._refusing:
            self._report(f"Audio: malformed messages are ignored: {why}")
        self._refusing = True

    def _join_stream(self, sample_rate: int, newest: int, window: int) -> None:
        """Continue the stream if frame `newest` belongs to it, and otherwise begin a new one."""
        before = self.frames.newest
        if self.sample_rate == 0:
            why = ""
        elif sample_rate != self.sample_rate:
            why = f"it was at {self.sample_rate} Hz"
        elif newest < before:
            why = f"its index fell from {before} to {newest}"
        elif newest - before > max(self.frames.capacity, window):
            self.record_gap(before + 1, newest - before - window)
            why = f"its index jumped from {before} to {newest}"
        else:
            if window != self._window:
                self._report(f"Audio: the window changed from {self._window} to {window} frames")
                self._window = window
                self.frames.reserve(window)
            return
        self._begin(sample_rate, newest, window)
        if why:
            self._report(f"Audio: a new stream at {sample_rate} Hz, frame {newest} ({why})")
        for rate in {reader.sample_rate for reader in self._readers} - {sample_rate}:
            self._report(f"Audio: the tree runs at {rate:g} Hz and does not read this stream; call Stop")

    def _begin(self, sample_rate: int, newest: int, window: int) -> None:
        """Begin a new stream. The current message contains its newest min(window, newest) frames."""
        self._drop_unread()
        capacity = max([int(RING_SECONDS * sample_rate), window, *(2 * r.frames_per_block for r in self._readers)])
        self.frames.clear(capacity, max(0, newest - window))
        self._discontinuity = self.frames.oldest
        self.sample_rate, self._window = sample_rate, window
        self._times.begin(sample_rate)
        self.counters.streams += 1
        for reader in self._readers:
            reader.begin(self.frames.oldest)

    def _drop_unread(self) -> None:
        unread = max((reader.unread for reader in self._readers), default=0)
        if unread:
            self.counters.dropped += unread
            self._report(f"Audio: {unread} unread frames of the old stream are dropped")
        for reader in self._readers:
            reader.begin(self.frames.newest + 1)

    def _check_overlap(self, message: Any, known: int) -> None:
        """Compare the last of the first `known` samples of a window with those in the ring."""
        after = self.frames.newest + 1
        count = min(known, after - max(self.frames.oldest, self._discontinuity), OVERLAP_CHECK_FRAMES)
        fits = self.frames.holds(after - count, rows_of(message, known - count, known))
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

    def record_gap(self, first: int, count: int) -> None:
        """Count and report `count` lost frames; none if it is not positive. To be called with `lock`."""
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
        with self.lock:
            while self.sample_rate == 0 or time.time() > self._current_until:
                limit = min(timeout, NEXT_MESSAGE_SECONDS) if self.sample_rate else timeout
                left = start + limit - time.monotonic()
                if left <= 0 or give_up():
                    break
                self.lock.wait(min(left, 0.05))
            if self.sample_rate == 0:
                return None
            reader = AudioReader(self, frames_per_block, self._report)
            self.frames.reserve(2 * frames_per_block)  # the block to read, and the one that arrives meanwhile
            self._readers.append(reader)
            return reader

    def catch_up(self) -> bool:
        """Let all readers read the blocks that have arrived. Return whether there were any."""
        with self.lock:
            readers = list(self._readers)
        late = [reader for reader in readers if reader.catch_up()]
        return bool(late)

    def remove(self, reader: AudioReader) -> None:
        """Remove a reader that is stopped. To be called with `lock`."""
        if reader in self._readers:
            self._readers.remove(reader)

    def captured(self, frame: int) -> LinearClock | None:
        """Return the clock that says when frame `frame` of the stream was captured, or None if this is not known."""
        with self.lock:
            return self._times.line(frame)

    @property
    def behind(self) -> int:
        """The number of frames that have been received and not read."""
        with self.lock:
            return max((reader.unread for reader in self._readers), default=0)

    @property
    def lag(self) -> str:
        """One line if a reader does not keep up with the stream, otherwise an empty string."""
        with self.lock:
            return next((reader.lag.problem for reader in self._readers if reader.lag.problem), "")


class AudioReader:
    """The source of the input processor: successive blocks of one stream, from the next frame on.

    It decides how many short blocks are read at once: as many as the next awaited output needs (see `Source.open`), up
    to `COMBINED_SECONDS`.

    Audio at another rate than at the start is not delivered, because the tree was built for that rate. To be created
    with the lock of the ring.
    """

    def __init__(self, ring: AudioRing, frames_per_block: int, report: Callable[[str], None]) -> None:
        self.frames_per_block = frames_per_block
        self.sample_rate = float(ring.sample_rate)
        self.position = ring.frames.newest + 1  # number of the next frame to read
        self.lag = LagMonitor(self.sample_rate, frames_per_block, report)
        self.ended = False
        self._ring = ring
        self._arrived_at = 0.0  # s, monotonic, of the last message
        self._requested = 0  # number of the last frame that a request waits for
        self._delivered = 0  # frames read in total
        self.open(lambda: None)

    # --- called by the ring ---

    def begin(self, position: int) -> None:
        """Continue with frame `position`, for which no request waits. To be called with the lock of the ring."""
        self.position, self._requested = position, 0

    def notice_message(self) -> None:
        """Note that a message has arrived, and wake the tree if there are enough blocks."""
        with self._ring.lock:
            self._arrived_at = time.monotonic()
            self.lag.update(self.unread, self._arrived_at)
            due = self._due_blocks()
        if due:
            self._wake()

    def catch_up(self) -> bool:
        """Let the tree read all blocks that have arrived. Return whether there are any."""
        with self._ring.lock:
            late = self.unread >= self.frames_per_block
            if late:
                self._requested = self._ring.frames.newest
        if late:
            self._wake()
        return late

    @property
    def unread(self) -> int:
        """The number of frames that have arrived and are to be read. To be called with the lock of the ring."""
        if self.ended or self.sample_rate != self._ring.sample_rate:
            return 0
        return self._ring.frames.newest + 1 - max(self.position, self._ring.frames.oldest)

    def _due_blocks(self) -> int:
        """Return the number of blocks to read now; 0 to wait for more sound."""
        block = self.frames_per_block
        arrived = self.unread // block
        if not arrived:
            return 0
        most = COMBINED_SECONDS * self.sample_rate // block * block
        due = max(1, math.ceil(min(self._required_frames() - self._delivered, most) / block))
        if arrived >= due:
            return due
        late = self.position <= self._requested or time.monotonic() - self._arrived_at > PAUSE_SECONDS
        return arrived if late else 0

    # --- called by the tree ---

    def open(self, wake: Callable[[], None], required_frames: Callable[[], float] = lambda: 0) -> None:
        """See `Source`."""
        self._wake, self._required_frames = wake, required_frames

    def read(self) -> tuple[np.ndarray, int] | None:
        """Return the next blocks, int32 (2, n), and the number of the frame after them, or None if none are due."""
        frames = self._ring.frames
        with self._ring.lock:
            blocks = self._due_blocks()
            if not blocks:
                return None
            self._ring.record_gap(self.position, frames.oldest - self.position)
            first = max(self.position, frames.oldest)
            count = blocks * self.frames_per_block
            self.position, self._delivered = first + count, self._delivered + count
            self.lag.blocks_read(blocks)
            self.lag.update(self.unread, time.monotonic())
            return frames.copy(first, count), self.position

    @property
    def waiting(self) -> bool:
        """See `Source`."""
        with self._ring.lock:
            return not self.ended and not self._due_blocks()

    def stop(self) -> None:
        """Read no further block, and forget the functions of `open`, which refer to the caller."""
        with self._ring.lock:
            self.ended = True
            self._ring.remove(self)
        self.open(lambda: None)


class LagMonitor:
    """Monitors the number of frames that wait for one reader.

    After each audio message, less than a whole block waits for a reader that keeps up. If at least one block has been
    waiting for `LAG_SECONDS` without a break, the tree does not keep up.

    Parameters
    ----------
    sample_rate : float
        In Hz.
    frames_per_block : int
        Block size of the reader.
    report : callable
        Called with one line when the tree falls behind, and when it has caught up.
    """

    def __init__(self, sample_rate: float, frames_per_block: int, report: Callable[[str], None]) -> None:
        self.problem = ""  # one line while the tree does not keep up
        self._sample_rate = sample_rate
        self._frames_per_block = frames_per_block
        self._report = report
        self._behind_since: float | None = None
        self._blocks = 0  # read since then

    def blocks_read(self, count: int) -> None:
        """Count blocks that were read."""
        self._blocks += count

    def update(self, waiting: int, now: float) -> None:
        """Update the number of waiting frames at the time `now` (s, monotonic)."""
        if waiting < self._frames_per_block:
            if self.problem:
                self.problem = ""
                self._report("Audio: the tree has caught up")
            self._behind_since = None
        elif self._behind_since is None:
            self._behind_since, self._blocks = now, 0
        elif not self.problem and now - self._behind_since >= LAG_SECONDS:
            self.problem = self._describe(waiting, (now - self._behind_since) / max(self._blocks, 1))
            self._report(f"Audio: {self.problem}")

    def _describe(self, waiting: int, block_seconds: float) -> str:
        frames, rate = self._frames_per_block, self._sample_rate
        return (
            f"the tree does not keep up: {waiting / rate:.2f} s of sound wait; a block of {frames} frames lasts "
            f"{1e3 * frames / rate:.3g} ms and takes {1e3 * block_seconds:.3g} ms; {self._remedy(block_seconds)}"
        )

    def _remedy(self, block_seconds: float) -> str:
        # Most of the computing time of a short block is independent of its length: a longer one takes about as long.
        required = max(HEADROOM * block_seconds * self._sample_rate, self._frames_per_block + 1)
        longer = next((size for size in BLOCK_SIZES if size >= required), None)
        less = "use fewer processors or channels"
        if longer is None:
            return f"longer blocks do not help: {less}"
        advice = f"call InputProc with nFramesPerBlock {longer}"
        return advice if self._frames_per_block < BLOCK_SIZES[3] else f"{advice}, or {less}"
