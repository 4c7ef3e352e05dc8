"""What all sources share: the protocol, errors, options in device names, cutting into chunks, pacing in real time."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from rosafe import interface
from rosafe.interface import ComponentError


class Chunk(NamedTuple):
    """One chunk of sound."""

    samples: np.ndarray  # int32, (2, frames_per_chunk): left, right
    gap: int  # frames that were lost between the chunk before and this one
    time: float  # when its last frame was acquired, on time.monotonic's clock


def wall_time_ns(moment: float) -> int:
    """A moment of time.monotonic's clock as ns since 1970, by the wall clock as it is now.

    A clock that somebody sets shows in the result, as it should.
    """
    return time.time_ns() - int((time.monotonic() - moment) * 1e9)


def loss_text(frames: int, index: int, sample_rate: int) -> str:
    """How it is told that `frames` frames were lost soon after frame `index` of a stream."""
    return f"lost {frames} frames ({frames / sample_rate:.3f} s) after frame {index} ({index / sample_rate:.2f} s)"


class SoundSource(Protocol):
    """Something to read sound from, already open."""

    name: str
    sample_rate: int  # Hz
    overruns: int  # how often sound was lost so far
    lost_frames: int  # how many frames were lost so far; they count in the stream's index

    def read(self) -> Chunk | None:
        """Wait for the next chunk; None at the end of the source or when it is told to stop.

        Raises ComponentError where the source fails for good.
        """

    def close(self) -> None:
        """Give the device back; `read` must not be called any more."""


def device_error(why: str) -> ComponentError:
    """``::bass::e_device``: not there, busy, unreadable or gone."""
    return interface.BASS.error("e_device", why)


def hwparams_error(why: str) -> ComponentError:
    """``::bass::e_hwparams``: there, but not offering what was asked for."""
    return interface.BASS.error("e_hwparams", why)


def parse_options(device: str, text: str, known: Mapping[str, Callable[[str], Any]]) -> dict[str, Any]:
    """The options `text` (``loop=1&start=2.5``) of a device name, each converted by its function in `known`.

    Raises ``::bass::e_device`` for an option that is unknown or cannot be converted, naming it and what there is.
    """
    values = {}
    for item in filter(None, text.split("&")):
        name, _, value = item.partition("=")
        if name not in known:
            raise device_error(f"{device}: no option {name!r}; there are: {', '.join(known)}")
        try:
            values[name] = known[name](value)
        except ValueError as problem:
            raise device_error(f"{device}: {name}={value} is not {problem}") from None
    return values


def number(low: float, high: float) -> Callable[[str], float]:
    """A converter for `parse_options`: a number from `low` to `high`."""

    def convert(text: str) -> float:
        wanted = f"a number from {low:g} to {high:g}"
        try:
            value = float(text)
        except ValueError:
            raise ValueError(wanted) from None
        if not low <= value <= high:  # NaN too
            raise ValueError(wanted)
        return value

    return convert


def flag(text: str) -> bool:
    """A converter for `parse_options`: 0 or 1."""
    if text not in ("0", "1"):
        raise ValueError("0 or 1")
    return text == "1"


class Chunker:
    """Cuts a stream that comes in pieces of any length, with losses between them, into chunks.

    A loss at the beginning of a chunk is the gap before it. One within a chunk fills that up with zeros, and what is
    left of it is the gap before the next.
    """

    def __init__(self, frames_per_chunk: int) -> None:
        self.pending = 0  # frames, lost ones included, that came and were not taken yet
        self._length = frames_per_chunk
        self._chunk = np.zeros((2, frames_per_chunk), np.int32)
        self._filled = 0
        self._gap = 0  # before the chunk at hand
        self._queue: deque[np.ndarray | int] = deque()  # what is beyond it: samples, or how many frames were lost

    def add(self, samples: np.ndarray) -> None:
        """Frames that came, int32 (2, n)."""
        self._push(samples, samples.shape[1])

    def lose(self, frames: int) -> None:
        """Frames that did not come."""
        self._push(frames, frames)

    def _push(self, piece: np.ndarray | int, frames: int) -> None:
        if frames > 0:
            self._queue.append(piece)
            self.pending += frames
            self._fill()

    def _fill(self) -> None:
        while self._queue and self._filled < self._length:
            piece = self._queue.popleft()
            room = self._length - self._filled
            rest: np.ndarray | int
            if isinstance(piece, np.ndarray):
                taken = min(room, piece.shape[1])
                self._chunk[:, self._filled : self._filled + taken] = piece[:, :taken]
                rest = piece[:, taken:] if taken < piece.shape[1] else 0
                self._filled += taken
            elif self._filled:
                taken = min(room, piece)
                rest = piece - taken
                self._filled += taken  # a chunk is made of zeros
            else:
                taken, rest = piece, 0
                self._gap += taken
            if isinstance(rest, np.ndarray) or rest:
                self._queue.appendleft(rest)

    def take(self, whole: bool = True) -> tuple[np.ndarray, int] | None:
        """The next chunk, int32 (2, frames_per_chunk), and the gap before it; None where it is not complete.

        With `whole` false, what has come of it, filled up with zeros; None where nothing has.
        """
        if self._filled < (self._length if whole else 1):
            return None
        taken = self._chunk, self._gap
        self.pending -= self._gap + self._filled
        self._chunk, self._filled, self._gap = np.zeros_like(self._chunk), 0, 0
        self._fill()
        return taken


class Pacer:
    """Lets frames pass in real time: one that is late is followed without waiting, so nothing ever drifts."""

    def __init__(self, sample_rate: int, stopping: threading.Event) -> None:
        self.sample_rate = sample_rate
        self.frames = 0
        self._stopping = stopping
        self._start: float | None = None  # the clock starts at the first wait

    def wait(self, frames: int) -> float | None:
        """Wait until `frames` more frames have had their time; when that was, or None when told to stop."""
        if self._start is None:
            self._start = time.monotonic()
        self.frames += frames
        due = self._start + self.frames / self.sample_rate
        if self._stopping.wait(max(0.0, due - time.monotonic())):
            return None
        return due
