"""What all sources share: the protocol, errors, options in device names, and pacing in real time."""

from __future__ import annotations

import threading
import time
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


class Source(Protocol):
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
