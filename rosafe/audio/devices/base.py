"""Code shared by the sources: protocol, errors, options in device names, division into chunks, real-time pacing."""

from __future__ import annotations

import argparse
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from rosafe import interface
from rosafe.interface import ComponentError
from rosafe.system.clocks import wall_difference


class Chunk(NamedTuple):
    """One chunk of sound."""

    samples: np.ndarray  # int32, (2, frames_per_chunk): left, right
    gap: int  # number of frames lost between the previous chunk and this one
    time: float  # when its last frame was acquired, on the clock of time.monotonic


def wall_time_ns(moment: float) -> int:
    """Convert a time on the clock of time.monotonic to ns since 1970.

    The current wall clock is used, so the result follows when the clock is set.
    """
    return round((moment + wall_difference()) * 1e9)


def loss_text(frames: int, index: int, sample_rate: int) -> str:
    """Return the message that `frames` frames were lost after frame `index` of a stream."""
    return f"lost {frames} frames ({frames / sample_rate:.3f} s) after frame {index} ({index / sample_rate:.2f} s)"


class SoundSource(Protocol):
    """An open source of sound."""

    name: str
    sample_rate: int  # Hz
    overruns: int  # number of losses so far
    lost_frames: int  # number of frames lost so far; they are included in the stream's frame index

    def read(self) -> Chunk | None:
        """Wait for the next chunk; None at the end of the source or after a stop.

        The chunk is empty if no sound arrives for the moment, and there is a remark about it. Raises
        ComponentError if the source fails permanently.
        """

    def close(self) -> None:
        """Release the device; `read` must not be called afterwards."""


def take_remarks(source: SoundSource) -> list[str]:
    """Return lines for the log about the sound of a source, each once."""
    remarks: list[str] = getattr(source, "remarks", [])
    taken = remarks[:]
    del remarks[: len(taken)]  # another thread may append one meanwhile
    return taken


def device_error(why: str) -> ComponentError:
    """Return ``::bass::e_device``: the device is missing, busy, unreadable or lost."""
    return interface.BASS.error("e_device", why)


def hwparams_error(why: str) -> ComponentError:
    """Return ``::bass::e_hwparams``: the device exists, but does not support the request."""
    return interface.BASS.error("e_hwparams", why)


def check_sample_rate(name: str | Path, requested: int, actual: int) -> None:
    """Raise ``::bass::e_hwparams`` if the `requested` sample rate (Hz; 0 for any) is not the `actual` one."""
    if requested not in (0, actual):
        raise hwparams_error(f"{name}: expected {requested} Hz, got {actual} Hz; a sample rate of 0 accepts it")


def parse_options(device: str, text: str, known: Mapping[str, Callable[[str], Any]]) -> dict[str, Any]:
    """Parse the options `text` (``loop=1&start=2.5``) of a device name; each is converted by its function in `known`.

    Raises ``::bass::e_device``, with the name of the option, if it is unknown or cannot be converted.
    """
    values = {}
    for item in filter(None, text.split("&")):
        name, _, value = item.partition("=")
        if name not in known:
            raise device_error(f"{device}: unknown option {name!r}; expected one of {', '.join(known)}")
        try:
            values[name] = known[name](value)
        except (ValueError, argparse.ArgumentTypeError) as problem:
            raise device_error(f"{device}: {name}: {problem}") from None
    return values


def split_path(text: str) -> tuple[str, str]:
    """Split a device name into path and options. If a file of the whole name exists, there are no options."""
    if "?" not in text or os.path.isfile(os.path.expanduser(text)):
        return text, ""
    path, _, options = text.rpartition("?")
    return path, options


class Chunker:
    """Divides a stream of pieces of any length, with losses between them, into chunks.

    A loss at the beginning of a chunk is the gap before that chunk. A loss within a chunk fills the rest of the chunk
    with zeros, and the remainder of the loss is the gap before the next chunk.
    """

    def __init__(self, frames_per_chunk: int) -> None:
        self.pending = 0  # frames that were added or lost, and are not taken yet
        self._length = frames_per_chunk
        self._chunk = np.zeros((2, frames_per_chunk), np.int32)
        self._filled = 0
        self._gap = 0  # before the current chunk
        self._queue: deque[np.ndarray | int] = deque()  # following samples, or numbers of lost frames

    def add(self, samples: np.ndarray) -> None:
        """Append frames, int32 (2, n)."""
        self._push(samples, samples.shape[1])

    def lose(self, frames: int) -> None:
        """Append a loss of `frames` frames."""
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
                self._filled += taken  # the chunk was created with zeros
            else:
                taken, rest = piece, 0
                self._gap += taken
            if isinstance(rest, np.ndarray) or rest:
                self._queue.appendleft(rest)

    def take(self, whole: bool = True) -> tuple[np.ndarray, int] | None:
        """Return the next chunk, int32 (2, frames_per_chunk), and the gap before it; None if it is not complete.

        With `whole` false, return an incomplete chunk too, padded with zeros; None if it is empty.
        """
        if self._filled < (self._length if whole else 1):
            return None
        taken = self._chunk, self._gap
        self.pending -= self._gap + self._filled
        self._chunk, self._filled, self._gap = np.zeros_like(self._chunk), 0, 0
        self._fill()
        return taken


class Pacer:
    """Paces frames in real time. After a delay it catches up, so that the pace does not drift."""

    def __init__(self, sample_rate: int, stopping: threading.Event) -> None:
        self.sample_rate = sample_rate
        self.frames = 0
        self._stopping = stopping
        self.started: float | None = None  # the clock starts at the first wait

    def wait(self, frames: int) -> float | None:
        """Wait until the end of the next `frames` frames. Return the time of this end, or None after a stop."""
        if self.started is None:
            self.started = time.monotonic()
        self.frames += frames
        due = self.started + self.frames / self.sample_rate
        if self._stopping.wait(max(0.0, due - time.monotonic())):
            return None
        return due


class PacedSource:
    """A source whose pieces, pairs of a gap and the samples after it, are divided into chunks in real time.

    Subclasses call `_start` when they know the sample rate.
    """

    def __init__(self, name: str, stopping: threading.Event) -> None:
        self.name = name
        self.sample_rate = 0
        self.overruns = 0
        self.lost_frames = 0
        self.remarks: list[str] = []  # that `take_remarks` has not returned yet
        self._stopping = stopping

    def _start(self, sample_rate: int, frames_per_chunk: int, pieces: Iterator[tuple[int, np.ndarray]]) -> None:
        self.sample_rate = sample_rate
        self._frames_per_chunk = frames_per_chunk
        self._pieces = pieces
        self._chunks = Chunker(frames_per_chunk)
        self._pacer = Pacer(sample_rate, self._stopping)

    def read(self) -> Chunk | None:
        """Return the next chunk at its time, the last one padded with zeros; None after the end or a stop."""
        while (chunk := self._chunks.take()) is None:
            piece = next(self._pieces, None)
            if piece is None:
                chunk = self._chunks.take(whole=False)
                break
            gap, samples = piece
            self.overruns += gap > 0
            self.lost_frames += gap
            self._chunks.lose(gap)
            self._chunks.add(samples)
        if chunk is None:
            return None
        due = self._pacer.wait(chunk[1] + self._frames_per_chunk)
        return None if due is None else Chunk(*chunk, due)

    @property
    def started(self) -> float | None:
        """When the first frame was due, on the clock of time.monotonic; None before the first `read`."""
        return self._pacer.started

    def close(self) -> None:
        """Release the device; by default there is none."""
