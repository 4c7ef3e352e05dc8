"""Frames: windows that move along the samples by a hop, over the borders of blocks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from .checks import positive, sample_count, word
from .guard import FloatArray
from .stage import Parameter, Stage
from .windows import NAMES, window


def frame_parameters(prefix: str) -> dict[str, Parameter]:
    """The three parameters of every framed stage."""
    return {
        f"{prefix}_wname": Parameter("hann", word(*NAMES)),
        f"{prefix}_wSizeSec": Parameter(0.02, positive),
        f"{prefix}_hSizeSec": Parameter(0.01, positive),
    }


@dataclass(frozen=True)
class Framing:
    """A window (w,) and a hop in samples: frame k covers the samples from k * hop to k * hop + w."""

    window: FloatArray
    hop: int

    @classmethod
    def design(cls, sample_rate: float, prefix: str, values: Mapping[str, Any]) -> Framing:
        """From the parameters of `frame_parameters`; the window's length is even. ValueError if one is too short."""
        half = sample_count(f"{prefix}_wSizeSec", values[f"{prefix}_wSizeSec"] * sample_rate / 2)
        hop = sample_count(f"{prefix}_hSizeSec", values[f"{prefix}_hSizeSec"] * sample_rate)
        return cls(window(values[f"{prefix}_wname"], 2 * half), hop)

    def complete(self, samples: int) -> int:
        """How many whole frames there are in so many samples."""
        return max(0, (samples - len(self.window)) // self.hop + 1)

    def frames(self, samples: FloatArray) -> FloatArray:
        """A view (..., F, w) of the whole frames in `samples` (..., n)."""
        count = self.complete(samples.shape[-1])
        if count == 0:
            return np.empty((*samples.shape[:-1], 0, len(self.window)))
        return sliding_window_view(samples, len(self.window), axis=-1)[..., :: self.hop, :]

    def means(self, samples: FloatArray) -> FloatArray:
        """mean(window x) of each whole frame: (..., n) to (..., F)."""
        return self._weighted_sums(samples, self.window / len(self.window))

    def mean_squares(self, samples: FloatArray) -> FloatArray:
        """mean((window x)**2) of each whole frame: (..., n) to (..., F)."""
        if self.complete(samples.shape[-1]) == 0:
            return np.empty((*samples.shape[:-1], 0))  # saves squaring a long window that is not full yet
        return self._weighted_sums(np.square(samples), np.square(self.window) / len(self.window))

    def _weighted_sums(self, samples: FloatArray, weights: FloatArray) -> FloatArray:
        # Not a matrix product: OpenBLAS starts threads of its own for it, and two stages at work at the same time
        # then get in each other's way: several times slower than one alone.
        return np.einsum("...fi,i->...f", self.frames(samples), weights)


class FrameBuffer:
    """The samples from the start of the next frame on, in an array that grows at its end and is moved now and then."""

    def __init__(self) -> None:
        self._store = np.empty((0, 0))
        self._start = self._stop = 0
        self._skip = 0  # samples still to come before the next frame starts (hop longer than the window)

    def append(self, block: FloatArray) -> FloatArray:
        """Take in (*rows, N); returns a view of all samples, valid until the next call.

        Other rows than before mean a new beginning.
        """
        if block.shape[:-1] != self._store.shape[:-1]:
            self._store = np.empty((*block.shape[:-1], 0))
            self._start = self._stop = self._skip = 0
        skipped = min(self._skip, block.shape[-1])
        self._skip -= skipped
        fresh = block[..., skipped:]
        needed = self._stop - self._start + fresh.shape[-1]
        if self._start + needed > self._store.shape[-1]:
            self._make_room(needed)
        stop = self._start + needed
        self._store[..., self._stop : stop] = fresh
        self._stop = stop
        return self._store[..., self._start : stop]

    def drop(self, count: int) -> None:
        """The next frame starts `count` samples later, be they here or still to come."""
        here = min(count, self._stop - self._start)
        self._start += here
        self._skip += count - here

    def _make_room(self, needed: int) -> None:
        kept = self._store[..., self._start : self._stop]
        if 2 * needed > self._store.shape[-1]:
            self._store = np.empty((*kept.shape[:-1], 2 * needed))
        self._store[..., : kept.shape[-1]] = kept
        self._start, self._stop = 0, kept.shape[-1]


class FramedStage(Stage):
    """A stage that works frame by frame.

    A change of window or hop keeps the buffered samples: the next frame starts where it would have started anyway.
    """

    PREFIX: ClassVar[str]

    def __init__(self, sample_rate: float, **parameters: Any) -> None:
        self._buffer = FrameBuffer()
        super().__init__(sample_rate, **parameters)

    @property
    def output_rate(self) -> float:
        return self.sample_rate / self._framing.hop

    def reset(self) -> None:
        self._buffer = FrameBuffer()

    def _build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        self._framing = Framing.design(self.sample_rate, self.PREFIX, values)
