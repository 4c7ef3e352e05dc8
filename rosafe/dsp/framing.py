"""Framing: windows that advance by a hop, across block boundaries, and the base class of stages that use them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from rosafe.declarations.parameter import Parameter

from . import kernels
from .numeric_limits import SQUARE_TINY, FloatArray, clamp
from .rounding import sample_count
from .signal_format import SignalFormat
from .stage import Output, Stage
from .windows import NAMES, window

MAX_FRAME_SECONDS = 60.0  # of an analysis window, and of the step between two

SMALL_BUFFER = 2**18  # numbers; a `FrameBuffer` of a framed stage up to this size has room for four times as many
BATCH = 2**18  # samples that are transformed at a time, to limit memory and stay in the cache


def frame_parameters(
    prefix: str, windows: tuple[str, ...] = NAMES, fallback: str = "hann"
) -> tuple[Parameter, Parameter, Parameter]:
    """Return the three parameters of every framed stage: window, its duration, and the step between frames."""
    return (
        Parameter.text(f"{prefix}_wname", "hann", "Window name", windows, fallback=fallback),
        Parameter.positive(f"{prefix}_wSizeSec", 0.02, "Window duration (s)", MAX_FRAME_SECONDS, unit="s"),
        Parameter.positive(f"{prefix}_hSizeSec", 0.01, "Window step size (s)", MAX_FRAME_SECONDS, unit="s"),
    )


@dataclass(frozen=True)
class FrameGrid:
    """A window (w,) and a hop in samples: frame k covers the samples from k * hop to k * hop + w."""

    window: FloatArray
    hop: int

    @classmethod
    def design(cls, sample_rate: float, prefix: str, values: Mapping[str, Any]) -> FrameGrid:
        """Create a grid from the parameters of `frame_parameters`, with an even window length."""
        half = sample_count(f"{prefix}_wSizeSec", values[f"{prefix}_wSizeSec"] * sample_rate / 2)
        hop = sample_count(f"{prefix}_hSizeSec", values[f"{prefix}_hSizeSec"] * sample_rate)
        return cls(window(values[f"{prefix}_wname"], 2 * half), hop)

    def complete_frames(self, samples: int) -> int:
        """Return the number of complete frames in this number of `samples`."""
        return max(0, (samples - len(self.window)) // self.hop + 1)

    def frames(self, samples: FloatArray) -> FloatArray:
        """Return a view (..., F, w) of the complete frames in `samples` (..., n)."""
        count = self.complete_frames(samples.shape[-1])
        if count == 0:
            return np.empty((*samples.shape[:-1], 0, len(self.window)))
        return sliding_window_view(samples, len(self.window), axis=-1)[..., :: self.hop, :]

    def weights(self, squared: bool) -> kernels.PinnedArray:
        """Return the weights of samples, or of their squares, whose sum is the mean of a windowed frame."""
        return self._square_weights if squared else self._plain_weights

    @cached_property
    def _plain_weights(self) -> kernels.PinnedArray:
        return kernels.PinnedArray.of(self.window / len(self.window))

    @cached_property
    def _square_weights(self) -> kernels.PinnedArray:
        return kernels.PinnedArray.of(np.square(self.window) / len(self.window))

    @cached_property
    def pinned(self) -> kernels.PinnedArray:
        """The window, for a kernel."""
        return kernels.PinnedArray.of(np.ascontiguousarray(self.window, np.float64))

    def means(self, samples: FloatArray, squared: bool) -> FloatArray:
        """Return mean(window x), or mean((window x)**2), of each complete frame: (..., n) to (..., F)."""
        if squared and self.complete_frames(samples.shape[-1]) > 0:  # a long window may not be full yet
            samples = np.square(clamp(samples, SQUARE_TINY))
        # Not a matrix product: OpenBLAS would start threads for it, and two stages that run concurrently would be
        # several times slower than one alone.
        means: FloatArray = np.einsum("...fi,i->...f", self.frames(samples), self.weights(squared).array)
        return means


class FrameBuffer:
    """The samples that later frames need, in an array that grows at its end and is moved when it is full.

    Samples are counted from the first buffered one, through the next block. The next frame starts at `skip`, which is 0
    unless the hop is longer than the window and samples between two frames have not arrived yet.

    Parameters
    ----------
    small : int
        The array is four times as large as necessary up to this size (numbers), so that samples are rarely moved. Above
        it, the array is twice as large, to limit memory: `state_size` of stages and the limits of windows assume this.

    Attributes
    ----------
    position : int
        The number of samples before the first one that is buffered, or that arrives next.
    """

    def __init__(self, small: int = 0) -> None:
        self._small = small
        self._store = kernels.PinnedArray.of(np.empty((0, 0)))
        self._rows: tuple[int, ...] = (0,)
        self._start = self._stop = 0
        self.skip = self.position = 0

    @property
    def held(self) -> int:
        """The number of buffered samples."""
        return self._stop - self._start

    def begin(self, rows: tuple[int, ...]) -> None:
        """Prepare for a block of leading shape `rows`. A change of that shape drops all samples."""
        if rows != self._rows:
            self._rows = rows
            self._make_store(0)
            self._start = self._stop = self.skip = self.position = 0

    def advance(self, arriving: int, count: int) -> tuple[kernels.SampleRange, kernels.SampleRange]:
        """Account for a block of `arriving` samples, and move the start of the next frame by `count` samples.

        Returns the range of the samples buffered before, and the range for the end of the block, which the caller must
        fill. Both may overlap; then each row of the second begins after the same row of the first.
        """
        held = self._stop - self._start
        first, total = self.skip + count, held + arriving
        kept = total - first
        self.skip = 0 if kept > 0 else -kept
        self.position += min(first, total)
        if first < held:
            self._make_room(total)
            start, stop = self._start, self._stop
            self._start, self._stop = start + first, stop + arriving
            held_range = kernels.SampleRange(self._store, start, stop)
            return held_range, kernels.SampleRange(self._store, stop, stop + arriving)
        history = kernels.SampleRange(self._store, self._start, self._stop)
        kept = max(0, kept)
        if kept > self._store.array.shape[-1]:
            self._make_store(kept)
        self._start, self._stop = 0, kept
        return history, kernels.SampleRange(self._store, 0, kept)

    def _make_store(self, samples: int) -> None:
        self._store = kernels.PinnedArray.of(np.empty((*self._rows, samples)))

    def append(self, block: FloatArray) -> FloatArray:
        """Append (*rows, N). Return a view, valid until the next call, of all samples from the next frame on."""
        self.begin(block.shape[:-1])
        _, room = self.advance(block.shape[-1], 0)
        room.samples[...] = block[..., block.shape[-1] - room.length :]
        return self._store.array[..., self._start : self._stop]

    def drop(self, count: int) -> None:
        """Move the start of the next frame by `count` samples, which may not have arrived yet."""
        self.advance(0, count)

    def _make_room(self, needed: int) -> None:
        store = self._store.array
        if self._start + needed <= store.shape[-1]:
            return
        kept = store[..., self._start : self._stop]
        if 2 * needed > store.shape[-1]:
            self._make_store((4 if math.prod(self._rows) * needed <= self._small else 2) * needed)
        self._store.array[..., : kept.shape[-1]] = kept
        self._start, self._stop = 0, kept.shape[-1]


class FramedStage(Stage):
    """A stage that computes its output frame by frame.

    A subclass implements `frame`, or `process` if it uses a kernel. A change of window or hop keeps the buffered
    samples: the start of the next frame does not change.
    """

    prefix: ClassVar[str]  # of the three parameters of `frame_parameters`

    def __init__(self, input_format: SignalFormat | float, **parameters: Any) -> None:
        self._buffer = FrameBuffer(SMALL_BUFFER)
        super().__init__(input_format, **parameters)

    def frame(self, frames: FloatArray) -> FloatArray:
        """Compute the output (..., F) of `frames` (..., F, w), to which `window` has not been applied."""
        raise NotImplementedError

    @property
    def window(self) -> FloatArray:
        """The current window (w,)."""
        return self._framing.window

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> Output:
        frames = self._new_frames(clamp(self._as_valid_block(block)))
        output = np.ascontiguousarray(self.frame(frames))
        return output.copy() if np.may_share_memory(output, frames) else output  # frames move with the next block

    def output_count(self, count: int) -> int:
        return self._framing.complete_frames(count)

    def required_input(self, frames: int) -> int:
        """Return the least number of further input frames after which `frames` more can be output.

        The tree may collect short blocks until then. A smaller number than necessary is correct.
        """
        buffer = self._buffer
        return max(1, buffer.skip + len(self._framing.window) + (frames - 1) * self._framing.hop - buffer.held)

    @cached_property
    def output_format(self) -> SignalFormat:
        return replace(
            self.input_format,
            rate=self.input_format.rate / self._framing.hop,
            framed=True,
            hop=self._framing.hop * self.input_format.hop,
            window=(len(self._framing.window) - 1) * self.input_format.hop + self.input_format.window,
        )

    def reset(self) -> None:
        self._buffer = FrameBuffer(SMALL_BUFFER)

    def _new_frames(self, samples: FloatArray) -> FloatArray:
        """Return a view (*rows, F, w) of the frames that `samples` (*rows, N) complete; valid until the next call."""
        frames = self._framing.frames(self._buffer.append(samples))
        self._buffer.drop(frames.shape[-2] * self._framing.hop)
        return frames

    def _means(self, samples: FloatArray, squared: bool) -> FloatArray:
        """Return `FrameGrid.means` of the frames that `samples` (*rows, N) complete, (*rows, F), by numpy."""
        means = self._framing.means(self._buffer.append(samples), squared)
        self._buffer.drop(means.shape[-1] * self._framing.hop)
        return means

    def _frames(
        self, block: FloatArray, weights: kernels.PinnedArray, rows: tuple[int, ...] | None = None
    ) -> kernels.FrameReader:
        """Return the frames that `block` completes, for a kernel, and advance the buffer.

        `rows` is the leading shape of the buffered samples if it differs from that of `block`.
        """
        shape, framing, buffer = block.shape, self._framing, self._buffer
        arriving, hop = shape[-1], framing.hop
        buffer.begin(shape[:-1] if rows is None else rows)
        skip, position = buffer.skip, buffer.position
        count = framing.complete_frames(buffer.held + arriving - skip)
        history, room = buffer.advance(arriving, count * hop)
        return kernels.FrameReader(history, block, room, skip, weights, hop, count, position)

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        self._framing = FrameGrid.design(self.input_format.rate, self.prefix, values)


def batches(channels: int, frames: int, frame_size: int) -> Iterator[tuple[slice, slice]]:
    """Split C channels and F frames of `frame_size` samples into parts that fit the cache: slices of both axes.

    A part is some frames of one channel, or all frames of several channels.
    """
    frames_at_once = max(1, BATCH // frame_size)
    channels_at_once = max(1, frames_at_once // max(1, frames))
    for first_channel in range(0, channels, channels_at_once):
        for first_frame in range(0, frames, frames_at_once):
            yield (
                slice(first_channel, first_channel + channels_at_once),
                slice(first_frame, first_frame + frames_at_once),
            )
