"""The sound of the node: it is captured from a device into a ring, from which the tree reads blocks."""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np

from rosafe.audio.devices import SoundSource
from rosafe.audio.devices.alsa import DeviceBusyError
from rosafe.audio.stream.capture import Capture, Snapshot
from rosafe.audio.stream.frame_clock import LinearClock
from rosafe.audio.stream.ring import AudioReader, AudioRing
from rosafe.audio.stream.ring_sound import BEFORE_SECONDS, RingSound, loss_report
from rosafe.audio.stream.truth import TruthLoop, TruthSource
from rosafe.interface import ROSAFE, ComponentError
from rosafe.localization.live import Status
from rosafe.system.log_throttle import ThrottledLog
from rosafe.tree.block import Source
from rosafe.tree.health import ERROR, OK, WARN
from rosafe.tree.processor import Processor
from rosafe.tree.tree_planner import NewProcessor

RETRY_SECONDS = 1.0  # between two attempts to acquire a lost device again
STOP_SECONDS = 1.0  # that the end of an acquisition is waited for
MAX_SEGMENTS = 100  # of a stream, between which sound is missing

OpenSource = Callable[[str, int, int, threading.Event], SoundSource]


class _Window(NamedTuple):
    """A chunk in the form in which the ring gets it."""

    sampleRate: int
    nChunksOnPort: int
    nFramesPerChunk: int
    lastFrameIndex: int
    left: np.ndarray
    right: np.ndarray
    stamp: dict[str, int]


class BlockReader:
    """Reads the blocks of the input from the ring, and knows the position of each of them.

    Parameters
    ----------
    reader : AudioReader
    """

    def __init__(self, reader: AudioReader) -> None:
        self.block = reader.frames_per_block
        self.sample_rate = reader.sample_rate
        self.open, self.stop = reader.open, reader.stop
        self._reader = reader
        self._blocks = 0
        self._segments: deque[tuple[int, int]] = deque([(0, 0)], MAX_SEGMENTS)  # first block, frames before it

    @property
    def ended(self) -> bool:
        """See `Source`."""
        return self._reader.ended

    @property
    def waiting(self) -> bool:
        """See `Source`."""
        return self._reader.waiting

    def read(self) -> tuple[np.ndarray, int] | None:
        """Return the next block, see `Source`."""
        got = self._reader.read()
        if got is not None:
            begin = got[1] - 1 - self.block
            if begin != self.end_of(self._blocks - 1):
                self._segments.append((self._blocks, begin))
            self._blocks += 1
        return got

    def end_of(self, number: int) -> int:
        """Return the number of audio frames of the stream up to the end of a block."""
        first, before = next(one for one in reversed(self._segments) if one[0] <= max(number, self._segments[0][0]))
        return before + (number + 1 - first) * self.block


class Sound:
    """The acquisition from one device at a time, and the ring of its newest frames.

    Parameters
    ----------
    clock_offset : callable
        Returns by how much the clock of the node is ahead of the system's (s); 0 without `use_sim_time`.
    log : object
        With `info`, `warning` and `error`.
    publish_truth : callable
        Called with (audio frame, time on time.monotonic, truth) while a scene is captured.
    open_device : callable
        As `rosafe.audio.devices.open_source`.

    Attributes
    ----------
    ring : AudioRing
    device : str
        The name of the acquired device; empty if there is none.
    reader : BlockReader or None
        Of the newest input.
    """

    def __init__(
        self,
        clock_offset: Callable[[], float],
        log: Any,
        publish_truth: Callable[[int, float, Any], object],
        open_device: OpenSource,
    ) -> None:
        self._clock_offset, self._log = clock_offset, log
        self._report = ThrottledLog(log.warning)
        self._publish_truth, self._open_device = publish_truth, open_device
        self.ring = AudioRing(self._report)
        self.device = ""
        self.reader: BlockReader | None = None
        self._state = OK, "no device; call ~/acquire or set the parameter device"
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._feed: Callable[[Any], None] = lambda message: None
        self._other_feeds: list[Callable[[Any], None]] = []
        self._line: LinearClock | None = None  # the clock of the newest frames

    # --- acquisition ---

    def acquire(
        self,
        device: str,
        rate: int,
        chunk: int,
        check: Callable[[float], object],
        prepare: Callable[[], object],
    ) -> None:
        """Capture chunks of `chunk` frames from a device instead of the present one.

        `check` is called with the sample rate (Hz) before anything changes, `prepare` before the first frame is read:
        the first block of an input that it creates begins with this frame. An error of either closes the device.
        """
        stopping = threading.Event()
        try:
            source = self._open_device(device, rate, chunk, stopping)
        except DeviceBusyError:  # probably by this node, perhaps under another name
            self.stop()
            source = self._open_device(device, rate, chunk, stopping)
        try:
            check(source.sample_rate)
            self.stop()
            self._feed = self.ring.connect()
            capture = Capture(source, chunk, 1, self._receive, self._report)
            capture.publish()  # announces the sample rate
            prepare()
        except BaseException:
            source.close()
            raise
        self._log.info(f"acquiring from {device} at {source.sample_rate} Hz")
        self.device, self._stopping = device, stopping
        self._state = OK, f"capturing from {device}"
        arguments = source, capture, chunk, stopping
        self._thread = threading.Thread(target=self._run, args=arguments, name="capture", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the acquisition."""
        self._stopping.set()
        thread, self._thread, self.device = self._thread, None, ""
        if thread is not None:
            thread.join(STOP_SECONDS)
            self._state = OK, "stopped"

    def _run(self, source: SoundSource, capture: Capture, chunk: int, stopping: threading.Event) -> None:
        """Capture until a stop or the end of the source. A device that is lost is acquired again."""
        device, rate = self.device, source.sample_rate
        while True:
            lost = self._capture(source, capture, stopping)
            if not lost or stopping.is_set():
                break
            since = time.monotonic()
            self._note(stopping, ERROR, f"{lost}; it is acquired again as soon as possible")
            reopened = self._reopen(device, rate, chunk, stopping)
            if reopened is None:
                return
            source = reopened
            before = capture.last_frame_index
            capture = Capture(source, chunk, 1, self._receive, self._report)
            capture.last_frame_index = before + round((time.monotonic() - since) * rate)  # the frames between are lost
            self._note(stopping, OK, f"capturing from {device} again")
        self._note(stopping, OK, f"the acquisition has ended: {device}: end of the source")

    def _capture(self, source: SoundSource, capture: Capture, stopping: threading.Event) -> str:
        """Capture until the end; return the reason if the device was lost."""
        truth = TruthLoop(cast(TruthSource, source), self._publish_truth) if hasattr(source, "truth") else None
        try:
            with truth or contextlib.nullcontext():
                capture.run(stopping, lambda seconds: None)
        except ComponentError as problem:
            return str(problem)
        finally:
            source.close()
        return ""

    def _reopen(self, device: str, rate: int, chunk: int, stopping: threading.Event) -> SoundSource | None:
        while not stopping.wait(RETRY_SECONDS):
            with contextlib.suppress(ComponentError):
                return self._open_device(device, rate, chunk, stopping)
        return None

    def _note(self, stopping: threading.Event, level: int, text: str) -> None:
        if not stopping.is_set():
            self._state = level, text
            (self._log.error if level == ERROR else self._log.info)(text)

    def _receive(self, new: Snapshot) -> None:
        """Give a chunk to the ring."""
        index = new.last_frame_index
        stamp = {"sec": 0, "nsec": new.time_ns}
        window = _Window(new.sample_rate, 1, new.frames_per_chunk, index, new.left, new.right, stamp)
        if new.time_ns:
            known = self.ring.captured(index) if index > new.frames_per_chunk else None
            self._line = known or LinearClock(index, new.time_ns / 1e9, new.sample_rate)
        for feed in (self._feed, *self._other_feeds):
            feed(window)

    def connect(self, ring: AudioRing) -> Callable[[], None]:
        """Fill another ring, too, from the last second on, until the returned function is called."""
        feed = ring.connect()
        with self.ring.lock:
            frames, rate = self.ring.frames, self.ring.sample_rate
            count = min(frames.newest + 1 - frames.oldest, round(BEFORE_SECONDS * rate))
            if count:
                left, right = frames.copy(frames.newest + 1 - count, count)
                feed(_Window(rate, 1, count, frames.newest, left, right, {"sec": 0, "nsec": 0}))
            self._other_feeds.append(feed)
        return functools.partial(self._other_feeds.remove, feed)

    # --- for the tree ---

    def open_input(self, new: NewProcessor, create: Callable[[Source], Processor | None]) -> None:
        """Create an input that begins with the next frame: see `OpenInput` of the tree."""
        reader = self.ring.open_reader(new.input_values["nFramesPerBlock"], 0.0, lambda: True)
        if reader is None:
            raise ROSAFE.error("e_noData", "no sound: call ~/acquire, or set the parameter device")
        before, self.reader = self.reader, BlockReader(reader)
        created = None
        try:
            created = create(self.reader)
        finally:
            if created is None:
                self.reader = before

    def time_of(self, frame: float) -> float:
        """Return the clock time (s) at which an audio frame, of which the first is 1, was captured; 0 if unknown.

        The clock of a simulation may be slow or stand still, so that no line fits its times: sound has those of the
        system's clock, and the difference of both clocks is added last.
        """
        return 0.0 if self._line is None else max(0.0, self._line.at(frame) + self._clock_offset())

    def report(self, status: Any) -> None:
        """Fill in a status of /diagnostics."""
        counters = self.ring.counters
        level, text = self._state
        if level == OK and self.ring.lag:
            level, text = WARN, self.ring.lag
        elif level == OK and counters.lost:
            level, text = WARN, f"{text}; {counters.lost} frames lost in {counters.gaps} gaps"
        status.summary(level, text)
        status.add("device", self.device or "none")
        status.add("sample rate (Hz)", self.ring.sample_rate)
        status.add("frames waiting", self.ring.behind)
        for name, value in vars(counters).items():
            status.add(name.replace("_", " "), value)


class SeparatedSound(RingSound):
    """The sound of which the localizer separates the sources, in a ring of its own: it may be read late.

    Parameters
    ----------
    sound : Sound
    sample_rate : float
        Hz; sound at another rate is not read.
    status : Status
        Warns about lost sound.
    """

    def __init__(self, sound: Sound, sample_rate: float, status: Status) -> None:
        ring = AudioRing(loss_report(status))
        super().__init__(ring, sample_rate, sound.time_of)
        self._disconnect = sound.connect(ring)

    def close(self) -> None:
        """End."""
        self._disconnect()
        super().close()
