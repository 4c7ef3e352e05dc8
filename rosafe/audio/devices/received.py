"""The source `topic:`, sound in the messages of another driver: formats, lost messages, waiting. Does not use ROS.

The nodes of both versions of ROS subscribe, and call `ReceivedSource` for each message.
"""

from __future__ import annotations

import functools
import itertools
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rosafe.audio.devices.base import (
    Chunk,
    Chunker,
    check_sample_rate,
    device_error,
    hwparams_error,
    parse_options,
)
from rosafe.audio.files.audiofile import NOT_FINITE, channel_pair, to_int32
from rosafe.audio.files.windows import MAX_JUMP_SECONDS
from rosafe.interface import BASS, ComponentError
from rosafe.system.clocks import wall_difference
from rosafe.system.option_types import whole_number

BYTES = {"S16LE": 2, "S24LE": 3, "S32LE": 4, "F32LE": 4}  # in a sample
MAX_CHANNELS = 64
MAX_MESSAGE = 2**22  # frames in a message
MAX_WAITING = 2**24  # received frames that wait to be read, 128 MB; further frames are lost
PAUSE_SECONDS = 1.0  # without a message, until the source reports a pause
FIRST_SECONDS = 3.0  # timeout for the first message
DESCRIPTION_SECONDS = 11.0  # the same with a description of the format; drivers repeat it every 5 s, one may be missed
_CLOCK = wall_difference()  # of times of arrival, which no change of the clock may alter
_UNCODED = ("", "wave", "wav", "raw", "pcm")
_CODED = {b"ID3": "MP3", b"OggS": "Ogg", b"fLaC": "FLAC", b"RIFF": "a WAV file"}  # by their first bytes
_SNIFFED = 8  # messages in which coded sound is detected
_MAX_RATE = int(BASS.service("Acquire").parameter("sampleRate").maximum or 0)


class SoundFormat(NamedTuple):
    """The format of the samples in messages."""

    samples: str  # a key of BYTES
    rate: int  # Hz
    channels: int

    def __str__(self) -> str:
        """Return the format for messages to users."""
        return f"{self.samples} at {self.rate} Hz with {self.channels} channel{'s' * (self.channels > 1)}"

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame."""
        return BYTES[self.samples] * self.channels


def decode(data: Any, form: SoundFormat, ears: tuple[int, int]) -> np.ndarray:
    """Return two channels of a message.

    Parameters
    ----------
    data : bytes-like
        Interleaved samples, whole frames.
    form : SoundFormat
        Their format.
    ears : tuple of two int
        Channels of the left and right ear, from 1.

    Returns
    -------
    ndarray of int32, or of float32 for F32LE, (2, n)
        Samples of 16 and 24 bits fill the upper bits.
    """
    columns = [ear - 1 for ear in ears]
    if form.samples == "S24LE":
        packed = np.frombuffer(data, np.uint8).reshape(-1, form.channels, 3)[:, columns]
        wide = np.zeros((*packed.shape[:2], 4), np.uint8)
        wide[..., 1:] = packed
        return np.ascontiguousarray(wide.view("<i4")[..., 0].T, np.int32)
    kind = {"S16LE": "<i2", "S32LE": "<i4", "F32LE": "<f4"}[form.samples]
    samples = np.frombuffer(data, kind).reshape(-1, form.channels)[:, columns].T
    if form.samples == "F32LE":
        return np.ascontiguousarray(samples, np.float32)
    return np.ascontiguousarray(samples, np.int32) << (32 - 8 * BYTES[form.samples])


# --- lost messages ----------------------------------------------------------------------------------------------------


class Received(NamedTuple):
    """One message."""

    frames: int
    samples: np.ndarray | None  # int32, (2, frames); None if its sound is lost
    start: float  # s: clock time of its first frame
    skipped: int | None  # messages that are missing before it according to their numbers; None if not numbered


class MessageOrder:
    """Finds lost sound between messages by the times and numbers of the messages.

    The stamp of a message that continues the sound is that of the previous one plus its length. Stamps that are taken
    when a message is published are later than that by a changing delay, but soon return. A message that does not
    continue the sound is therefore held until those after it show which of the two it is. The more the delays have
    changed before, the longer this takes.

    Parameters
    ----------
    sample_rate : int
        Hz.
    slack : float
        s; smaller deviations of times do not count as losses.
    confirm : float
        s for which later messages have to show the same loss.

    Attributes
    ----------
    remarks : list of str
        Lines about events that lose no sound; the caller clears them.
    """

    CONFIRM_MESSAGES = 2  # that have to show the same loss
    CONFIRM_JITTERS = 20.0  # additional time for that, in units of the jitter
    UNBROKEN_SECONDS = 1.0  # the same for messages that are complete by their numbers
    JITTER_SECONDS = 2.0  # time constant with which the jitter is forgotten; at the beginning,
    FIRST_JITTER_SECONDS = 0.1  # when it is only assumed, it is shorter
    MAX_JITTER = 0.05  # s
    LARGE_JITTER = 1.5  # in units of the jitter, whose largest value is partly forgotten
    MAX_HELD = 1024  # messages
    DRIFT = 5e-4  # s per s, of the sample clock against the clock of the stamps
    LONGEST_TOLERANCE = 0.25  # s
    START_SECONDS = 1.0  # in which the first stamp may turn out to be late
    MEASURED_SECONDS = 2.0  # after which the number of frames per second is compared with the sample rate
    RATES = (0.8, 1.25)  # expected quotient

    def __init__(self, sample_rate: int, slack: float, confirm: float) -> None:
        self.remarks: list[str] = []
        self._rate = sample_rate
        self._slack = slack
        self._confirm = confirm
        self._jitter = 0.01  # s, by which the lateness of messages has changed; at first it is not known
        self._late = 0.0  # s, of the last message that was not held
        self._origin: float | None = None  # time of the first frame, by the earliest stamps
        self._end = 0  # frames so far, including lost ones
        self._length = 0  # frames of the last message
        self._held: list[Received] = []
        self._measured: tuple[float, int] | None = None  # time of the first message, and frames since then

    @property
    def newest(self) -> float:
        """Clock time (s) at which the newest frame ended."""
        return (self._origin or 0.0) + self._end / self._rate

    def add(self, message: Received) -> Iterator[tuple[int, Received]]:
        """Yield the messages that are complete up to here, each with the number of frames lost before it."""
        self._held.append(message)
        self._measure(message)
        full = len(self._held) > self.MAX_HELD or sum(held.frames for held in self._held) > MAX_MESSAGE
        while self._held and (gap := self._gap(final=full)) is not None:
            yield self._place(gap)

    def flush(self) -> Iterator[tuple[int, Received]]:
        """Yield the messages that are held, because no further one arrives."""
        while self._held and (gap := self._gap(final=True)) is not None:
            yield self._place(gap)

    def _place(self, gap: int) -> tuple[int, Received]:
        message = self._held.pop(0)
        self._end += gap + message.frames
        seconds = min(self.JITTER_SECONDS, self.FIRST_JITTER_SECONDS + self._end / self._rate)
        self._jitter *= 1 - min(0.5, message.frames / self._rate / seconds)
        self._length = message.frames
        return gap, message

    def _measure(self, message: Received) -> None:
        """Remark once on a number of frames per second that does not fit the sample rate."""
        first, frames = self._measured or (message.start, 0)
        seconds, before = message.start - first, frames / self._rate
        self._measured = first, frames + message.frames
        if before < self.MEASURED_SECONDS or seconds < self.MEASURED_SECONDS:
            return
        self._measured = math.inf, 0  # only once
        if not self.RATES[0] < before / seconds < self.RATES[1]:
            measured = before * self._rate / seconds
            self.remarks.append(
                f"expected {self._rate} frames per second, got {measured:.0f}; check ?rate=, ?of= and other publishers"
            )

    def _gap(self, final: bool) -> int | None:
        """Return the number of frames lost before the first held message; None if it is not known yet."""
        first, last = self._held[0], len(self._held) - 1
        if self._origin is None:
            self._origin = first.start
        length = self._length or first.frames
        tolerance = max(self._slack, self._jitter, min(self.LONGEST_TOLERANCE, length / 2 / self._rate))
        # s by which each message is late if those before it, and those skipped since the first, continue the sound
        missing = [(message.skipped or 0) * length for message in self._held]
        lengths = (message.frames + skipped for message, skipped in zip(self._held, missing[1:], strict=False))
        begins = itertools.accumulate(lengths, initial=0)
        late = [m.start - self.newest - begin / self._rate for m, begin in zip(self._held, begins, strict=True)]
        if missing[0] and -tolerance <= late[0] - missing[0] / self._rate <= self.LONGEST_TOLERANCE:
            return missing[0]  # a further delay is that of messages that are complete
        if self._continues(late[0], tolerance):
            self._origin += min(late[0], self.DRIFT * first.frames / self._rate)
            return 0
        if abs(late[last]) <= tolerance:  # the times of those before were wrong
            self._jitter = max(self._jitter, min(self.MAX_JITTER, abs(late[0])))
            return 0
        if last and first.skipped is None and abs(self._held[last].start - self.newest) <= tolerance:
            self.remarks.append("messages are not used, as another message has their time; stop other publishers")
            del self._held[:-1]
            return self._gap(final)
        return self._lasting(late, length, final)

    def _continues(self, late: float, tolerance: float) -> bool:
        if abs(late) <= tolerance:
            self._jitter = max(self._jitter, min(self.MAX_JITTER, abs(late - self._late)))
            self._late = late
            return True
        return self._end < self.START_SECONDS * self._rate and -self.LONGEST_TOLERANCE < late < 0

    def _lasting(self, late: list[float], length: int, final: bool) -> int | None:
        """Return the number of frames lost before the first message; None if the lateness may not last."""
        least = min(map(abs, late))
        # from this message on, all are late by at least about as much
        slack = max(self._slack, self._jitter)
        since = next(index for index, value in enumerate(late) if abs(value) <= least + slack)
        seconds = self._confirm + self.CONFIRM_JITTERS * self._jitter
        if self._held[0].skipped == 0:
            seconds = max(seconds, self.UNBROKEN_SECONDS)
        shown = self._held[-1].start - self._held[since].start
        if shown >= seconds and len(late) - since > self.CONFIRM_MESSAGES:
            return self._lost(self._held[0], math.copysign(least, late[since]), length)
        if final:
            lost = least > self.LARGE_JITTER * self._jitter
            return self._lost(self._held[0], math.copysign(least, late[since]), length) if lost else 0
        return None

    def _lost(self, first: Received, late: float, length: int) -> int:
        """Return the number of frames for a lasting change (s) of the lateness, or follow a clock that was set back."""
        assert self._origin is not None
        if late < 0:
            self._origin += late
            if late < -self.LONGEST_TOLERANCE:
                self.remarks.append(f"the clock of the stamps was set back by {-late:.3f} s; the sound continues")
            return 0
        if late > MAX_JUMP_SECONDS:
            raise ValueError(f"a new stream begins (its stamps jump by {late:.0f} s)")
        frames, whole = round(late * self._rate), round(late * self._rate / length) * length
        # Drivers may lose any number of frames; without numbers, mostly whole messages are lost.
        difference, jitter = length / 4, self._jitter * self._rate
        if first.skipped == 0:
            difference = min(difference, self._slack * self._rate + jitter)
        elif frames % length <= self.LARGE_JITTER * jitter:  # delays make a message later, never earlier
            return frames // length * length
        return whole if whole and abs(frames - whole) <= difference else frames


# --- the source -------------------------------------------------------------------------------------------------------


class ReceivedSound:
    """A source whose sound arrives in pieces on other threads.

    Parameters
    ----------
    name : str
        The device.
    frames_per_chunk : int
        Of the chunks of `read`; 0: as they arrive.
    stopping : threading.Event
        Once set, a waiting `read` returns None.
    patience : float
        s without new sound until the source counts as ended; infinite: it waits until sound arrives again.
    """

    POLL_SECONDS = 0.1

    def __init__(self, name: str, frames_per_chunk: int, stopping: threading.Event, patience: float = math.inf) -> None:
        self.name = name
        self.sample_rate = 0  # Hz; 0 until it is known
        self.overruns = 0
        self.lost_frames = 0
        self.remarks: list[str] = []  # that `take_remarks` has not returned yet
        self.problem = ""  # why no sound arrives; empty if it does
        self.arrived = threading.Condition()  # also guards the attributes that several threads use
        self._stopping = stopping
        self._patience = patience
        self._chunks = Chunker(frames_per_chunk) if frames_per_chunk else None
        self._queue: deque[tuple[int, np.ndarray, float]] = deque()
        self._waiting = 0  # frames in the queue
        self._missed = 0  # frames after the newest one in the queue that were dropped, as it was full
        self._end = ""  # why the stream has ended
        # Clock time of the newest frame that was taken from the queue, and the frames that were taken with it.
        self._taken = 0.0, 0

    # --- threads that receive; they hold the lock ---

    def put(self, gap: int, samples: np.ndarray | None, newest: float) -> None:
        """Append samples, int32 (2, n), after `gap` lost frames; the last one was captured at clock time `newest`."""
        frames = 0 if samples is None else samples.shape[1]
        if not frames or self._waiting + frames > MAX_WAITING:
            self._missed += gap + frames
        elif samples is not None:
            self._queue.append((gap + self._missed, samples, newest))
            self._waiting += frames
            self._missed = 0
        self.arrived.notify_all()

    def end(self, why: str) -> None:
        """End the stream; `read` raises ``::bass::e_device`` after the sound that has arrived."""
        self._end = self._end or why
        self.arrived.notify_all()

    def flush(self) -> None:
        """Put sound that was held back, as no more arrives for the moment."""

    # --- the thread that reads ---

    def wait(self, condition: Callable[[], object], seconds: float) -> bool:
        """Wait for a condition, which notified threads check, for a time or until a stop. Return whether it is true."""
        end = time.monotonic() + seconds
        with self.arrived:
            while not condition():
                rest = end - time.monotonic()
                if rest <= 0 or self._stopping.is_set():
                    return False
                self.arrived.wait(min(rest, self.POLL_SECONDS))
        return True

    def read(self) -> Chunk | None:
        """Return the next chunk, or an empty one when a pause begins; None at the end, or after a stop.

        Raises ``::bass::e_device`` if the stream has ended for another reason.
        """
        pause = PAUSE_SECONDS + 2 * self._taken[1] / max(1, self.sample_rate)
        while (chunk := self._take()) is None:
            if not self._next(self._patience if self.problem else pause):
                if self._stopping.is_set() or self.problem:
                    return None
                self.problem = f"no sound for {pause:.3g} s"
                self.remarks.append(f"{self.name}: {self.problem}; waiting for its publisher")
                return Chunk(np.zeros((2, 0), np.int32), 0, self._monotonic())
        return Chunk(*chunk, self._monotonic())

    def _take(self) -> tuple[np.ndarray, int] | None:
        if self._chunks is not None:
            return self._chunks.take()
        if not self._queue:
            return None
        gap, samples = self._count()
        return samples, gap

    def _next(self, seconds: float) -> bool:
        """Wait for a piece, and append it to the chunks. Return whether there was one."""
        end = time.monotonic() + seconds
        while not self.wait(lambda: self._queue or self._end, min(PAUSE_SECONDS, end - time.monotonic())):
            with self.arrived:
                self.flush()
            if self._stopping.is_set() or (time.monotonic() >= end and not self._queue):
                return False
        if not self._queue:
            raise device_error(f"{self.name}: {self._end}")
        self.problem = ""
        if self._chunks is not None:
            gap, samples = self._count()
            self._chunks.lose(gap)
            self._chunks.add(samples)
        return True

    def _count(self) -> tuple[int, np.ndarray]:
        """Take a piece from the queue."""
        with self.arrived:
            gap, samples, newest = self._queue.popleft()
            self._waiting -= samples.shape[1]
        self._taken = newest, samples.shape[1]
        self.overruns += gap > 0
        self.lost_frames += gap
        return gap, samples

    @property
    def behind(self) -> float:
        """Seconds of sound that have arrived and were not read."""
        return (self._waiting + self._pending) / max(1, self.sample_rate)

    @property
    def _pending(self) -> int:
        return 0 if self._chunks is None else self._chunks.pending

    def _monotonic(self) -> float:
        """Return when the last frame of the chunk that was taken was captured."""
        captured = self._taken[0] - self._pending / max(1, self.sample_rate)
        return captured - wall_difference()

    def close(self) -> None:
        """Release the source."""


def _sample_format(text: str) -> str:
    if text.upper() not in BYTES:
        raise ValueError(f"expected one of {', '.join(BYTES)}, got {text!r}")
    return text.upper()


_OPTIONS: dict[str, Callable[[str], Any]] = {
    "format": _sample_format,
    "rate": whole_number(1, _MAX_RATE),
    "of": whole_number(1, MAX_CHANNELS),
    "channels": functools.partial(channel_pair, max_channel=MAX_CHANNELS),
}


class ReceivedSource(ReceivedSound):
    """Two channels of the sound in `audio_common_msgs/AudioData` or `AudioDataStamped`.

    The node that subscribes calls `describe` for each `AudioInfo`, `receive` for each message with sound, on any
    thread, and then `begin`.

    Parameters
    ----------
    text : str
        ``TOPIC`` or ``TOPIC?OPTIONS``, the device's name after ``topic:``. Options: ``format=S16LE``, ``rate=16000``
        and ``of=4`` (the number of channels in the messages) instead of those of `AudioInfo`; ``channels=2,3`` selects
        two channels (from 1), ``channels=1,1`` one for both ears.
    sample_rate : int
        Hz; must be that of the messages, or 0.
    frames_per_chunk, stopping, patience
        As for `ReceivedSound`.

    Attributes
    ----------
    topic : str
        The topic.
    needs_description : bool
        Whether the options do not give the whole format.

    Raises
    ------
    interface.ComponentError
        ``::bass::e_device`` for unknown options, ``::bass::e_hwparams`` for options that do not fit together.
    """

    # Slack and confirm of MessageOrder, s. Times of arrival depend on the load of two computers.
    STAMPS = 0.0005, 0.1
    ARRIVALS = 0.25, 1.0

    def __init__(
        self,
        text: str,
        sample_rate: int,
        frames_per_chunk: int,
        stopping: threading.Event,
        patience: float = math.inf,
    ) -> None:
        super().__init__(f"topic:{text}", frames_per_chunk, stopping, patience)
        self.topic, _, options = text.partition("?")
        if not self.topic:
            raise device_error("topic: expected topic:NAME, such as topic:/audio, got an empty name")
        self._options = parse_options(self.name, options, _OPTIONS)
        self._requested_rate = sample_rate
        self._format: SoundFormat | None = None
        self._failure: ComponentError | None = None  # why the format cannot be used
        self._order: MessageOrder | None = None
        self._publisher = ""  # whose messages are used
        self._last: tuple[float, int | None] = (-math.inf, None)  # its last message: when it arrived, its number
        self._sniffed: list[bytes] = []  # the beginnings of the first messages
        self._said: set[str] = set()  # kinds of remarks that were made
        self.needs_description = not {"format", "rate", "of"} <= self._options.keys()
        if not self.needs_description:
            self._use("", 0, 0)
            if self._failure is not None:
                raise self._failure

    # --- threads that receive ---

    def describe(self, channels: int, sample_rate: int, sample_format: str, coding_format: str) -> None:
        """Use the fields of an `AudioInfo`."""
        with self.arrived:
            if coding_format.lower() not in _UNCODED:
                self._fail(device_error(self._coded(coding_format)))
            else:
                self._use(sample_format, sample_rate, channels)
            self.arrived.notify_all()

    def _coded(self, coding: str) -> str:
        return (
            f"{self.name}: expected uncoded samples, got {coding[:40]!r}; set the driver's format to wave, or decode "
            "the sound in another node"
        )

    def _use(self, samples: str, rate: int, channels: int) -> None:
        """Take a format, with the options in place of its values."""
        options = self._options
        form = SoundFormat(
            options.get("format", samples.upper()), options.get("rate", rate), options.get("of", channels)
        )
        if form == self._format:
            return
        try:
            self._check(form)
        except ComponentError as problem:
            self._fail(problem)
            return
        if self._format is not None:
            self.end(f"the format changes from {self._format} to {form}; call Acquire")
        elif self._failure is None:
            self._format, self.sample_rate = form, form.rate

    def _fail(self, problem: ComponentError) -> None:
        """End the stream with an error, or let `begin` raise it."""
        if not self._begun:
            self._failure = problem
        else:
            self.end(problem.reason.removeprefix(f"{self.name}: "))

    def _check(self, form: SoundFormat) -> None:
        if form.samples not in BYTES:
            formats = ", ".join(BYTES)
            raise hwparams_error(f"{self.name}: expected one of {formats}, got {form.samples[:40]!r}")
        if not 1 <= form.rate <= _MAX_RATE:
            raise hwparams_error(f"{self.name}: expected 1 to {_MAX_RATE} Hz, got {form.rate}; choose one with ?rate=")
        if not 1 <= form.channels <= MAX_CHANNELS:
            raise hwparams_error(f"{self.name}: expected 1 to {MAX_CHANNELS} channels, got {form.channels}")
        ears = self._options.get("channels")
        if ears is None and form.channels != 2:
            advice = "?channels=1,1 uses it for both ears" if form.channels == 1 else "choose two with ?channels=1,2"
            raise hwparams_error(f"{self.name}: expected 2 channels, got {form.channels}; {advice}")
        if ears is not None and max(ears) > form.channels:
            raise hwparams_error(f"{self.name}: expected channels from 1 to {form.channels}, got {max(ears)}")
        check_sample_rate(self.name, self._requested_rate, form.rate)

    def receive(self, data: Any, stamp_ns: int = 0, number: int | None = None, publisher: str = "") -> None:
        """Use a message.

        Parameters
        ----------
        data : bytes-like
            The samples.
        stamp_ns : int
            Clock time of the first frame, ns; 0 if it has no stamp: the time of arrival is used then.
        number : int or None
            Of the message, if its publisher or ROS numbers them in order.
        publisher : str
            Name of the node that has sent it, if it is known.
        """
        now = time.monotonic()
        with self.arrived:
            if self._end or self._format is None or not len(data) or not self._is_ours(publisher, now):
                return
            if problem := self._unusable(data):
                self._fail(problem)
                self.arrived.notify_all()
                return
            frames = min(len(data) // self._format.frame_bytes, MAX_MESSAGE)
            samples = None if self._size_problem(len(data)) else self._decoded(data)
            start = stamp_ns * 1e-9 if stamp_ns else _CLOCK + now - frames / self._format.rate
            self._append(Received(frames, samples, start, self._skipped(number)), bool(stamp_ns))
            self._note_message(now, number)

    def _unusable(self, data: Any) -> ComponentError | None:
        """Return an error if the stream cannot be used: coded sound, or a first message with a wrong size."""
        assert self._format is not None
        if coded := self._sniff(bytes(data[:4])):
            return device_error(coded)
        problem = self._size_problem(len(data))
        if problem and not self._begun:
            return hwparams_error(f"{self.name}: {problem}")
        if problem:
            self._remark("size", f"{problem}; the message counts as lost")
        return None

    def _append(self, message: Received, stamped: bool) -> None:
        if self._order is None:
            self._order = MessageOrder(self.sample_rate, *(self.STAMPS if stamped else self.ARRIVALS))
        self._put_all(self._order.add(message))

    def _put_all(self, messages: Iterator[tuple[int, Received]]) -> None:
        assert self._order is not None
        try:
            for gap, message in messages:
                lost = 0 if message.samples is not None else message.frames
                self.put(gap + lost, message.samples, self._order.newest)
        except ValueError as problem:
            self.end(f"{problem}; call Acquire")
        for text in self._order.remarks:
            self._remark(text, text)
        self._order.remarks.clear()

    def flush(self) -> None:
        """Put the messages that are held, if no more arrive for the moment."""
        silent = time.monotonic() - self._last[0]
        if self._order is not None and silent > (PAUSE_SECONDS + 2 * self._taken[1] / self.sample_rate) / 2:
            self._put_all(self._order.flush())

    def _is_ours(self, publisher: str, now: float) -> bool:
        """Return whether a message is from the publisher whose messages are used; another one may follow it."""
        if publisher == self._publisher:
            return True
        if now - self._last[0] > PAUSE_SECONDS:
            if self._publisher:
                self.remarks.append(f"{self.name}: the sound continues with messages of {publisher}")
            self._publisher, self._last = publisher, (self._last[0], None)
            return True
        self._remark(publisher, f"messages of a second publisher, {publisher}, are not used")
        return False

    @property
    def _begun(self) -> bool:
        """Whether a message was used."""
        return self._last[0] > -math.inf

    def _note_message(self, now: float, number: int | None = None) -> None:
        """Note that a message is used."""
        self._last = now, number
        self._failure = None
        self.arrived.notify_all()

    def _remark(self, kind: str, text: str) -> None:
        """Make a remark once."""
        if kind not in self._said and len(self._said) < 100:
            self._said.add(kind)
            self.remarks.append(f"{self.name}: {text}")

    def _skipped(self, number: int | None) -> int | None:
        """Return how many messages are missing before one with this number; None if this is not known."""
        before = self._last[1]
        return number - before - 1 if number is not None and before is not None and number > before else None

    def _sniff(self, begin: bytes) -> str:
        """Return an error for coded sound, by the beginnings of the first messages; '' if it may be samples."""
        if len(self._sniffed) >= _SNIFFED:
            return ""
        self._sniffed.append(begin)
        kind = next((kind for magic, kind in _CODED.items() if begin.startswith(magic)), "")
        # Frames of MPEG, layer III. Three of eight messages with samples hardly begin like that.
        mpeg = [one for one in self._sniffed if one[:1] == b"\xff" and len(one) > 1 and one[1] & 0xE6 == 0xE2]
        return self._coded(kind or "MP3") if kind or len(mpeg) > 2 else ""

    def _size_problem(self, size: int) -> str:
        assert self._format is not None
        frame = self._format.frame_bytes
        if size % frame:
            return f"expected a multiple of {frame} bytes ({self._format}), got {size}; check ?format= and ?of="
        longest = MAX_MESSAGE * frame
        return f"expected at most {longest} bytes, got {size}" if size > longest else ""

    def _decoded(self, data: Any) -> np.ndarray:
        assert self._format is not None
        samples = decode(data, self._format, self._options.get("channels", (1, 2)))
        if samples.dtype != np.float32:
            return samples
        if not np.isfinite(samples).all():
            self._remark("finite", NOT_FINITE)
        if np.abs(np.nan_to_num(samples)).max(initial=0.0) > 1.0:
            self._remark("clipped", "samples beyond full scale are clipped")
        return to_int32(samples)

    # --- the thread that reads ---

    def begin(self, absent: str = "", seconds: float = FIRST_SECONDS) -> None:
        """Wait for the first message.

        Parameters
        ----------
        absent : str
            Why no message can arrive, such as a topic without a publisher, for the error.
        seconds : float
            To wait at most.

        Raises
        ------
        interface.ComponentError
            ``::bass::e_device`` if none arrives or the sound is coded, ``::bass::e_hwparams`` if its format cannot be
            used.
        """
        self.wait(lambda: self._begun or self._failure, seconds)
        if self._failure is not None:
            raise self._failure
        if self._stopping.is_set():
            raise device_error(f"{self.name}: stopped before the first message arrived")
        if self._begun:
            return
        advice = "start the driver, or call Acquire of its bass"
        if self._format is None and not absent:
            absent = "no message in a known format has arrived"
            advice = "without AudioInfo, add ?format=S16LE&rate=16000&of=2 with the driver's values"
        raise device_error(f"{self.name}: {absent or 'no message has arrived'}; {advice}")
