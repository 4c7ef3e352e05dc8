"""Frames: windows that move along the samples by a hop, over the borders of blocks."""

from __future__ import annotations

from collections.abc import Mapping
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

MAX_FRAME_SECONDS = 60.0  # longest analysis window, and longest step from one to the next


def frame_parameters(
    prefix: str, windows: tuple[str, ...] = NAMES, fallback: str = "hann"
) -> tuple[Parameter, Parameter, Parameter]:
    """The three parameters of every framed stage: window, its duration, and the step to the next."""
    return (
        Parameter(f"{prefix}_wname", "string", "hann", "Window name", choices=windows, fallback=fallback),
        Parameter(f"{prefix}_wSizeSec", "double", 0.02, "Window duration (s)", 0.0, MAX_FRAME_SECONDS, True, unit="s"),
        Parameter(f"{prefix}_hSizeSec", "double", 0.01, "Window step size (s)", 0.0, MAX_FRAME_SECONDS, True, unit="s"),
    )


@dataclass(frozen=True)
class FrameGrid:
    """A window (w,) and a hop in samples: frame k covers the samples from k * hop to k * hop + w."""

    window: FloatArray
    hop: int

    @classmethod
    def design(cls, sample_rate: float, prefix: str, values: Mapping[str, Any]) -> FrameGrid:
        """From the parameters of `frame_parameters`; the window's length is even. ValueError if one is too short."""
        half = sample_count(f"{prefix}_wSizeSec", values[f"{prefix}_wSizeSec"] * sample_rate / 2)
        hop = sample_count(f"{prefix}_hSizeSec", values[f"{prefix}_hSizeSec"] * sample_rate)
        return cls(window(values[f"{prefix}_wname"], 2 * half), hop)

    def complete_frames(self, samples: int) -> int:
        """How many whole frames there are in so many samples."""
        return max(0, (samples - len(self.window)) // self.hop + 1)

    def frames(self, samples: FloatArray) -> FloatArray:
        """A view (..., F, w) of the whole frames in `samples` (..., n)."""
        count = self.complete_frames(samples.shape[-1])
        if count == 0:
            return np.empty((*samples.shape[:-1], 0, len(self.window)))
        return sliding_window_view(samples, len(self.window), axis=-1)[..., :: self.hop, :]

    def weights(self, squared: bool) -> kernels.PinnedArray:
        """What to multiply samples, or their squares, with for the mean of a windowed frame."""
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
        """mean(window x), or mean((window x)**2), of each whole frame: (..., n) to (..., F)."""
        if squared and self.complete_frames(samples.shape[-1]) > 0:  # else a long window that is not full yet
            samples = np.square(clamp(samples, SQUARE_TINY))
        # Not a matrix product: OpenBLAS starts threads of its own for it, and two stages at work at the same time
        # then get in each other's way: several times slower than one alone.
        means: FloatArray = np.einsum("...fi,i->...f", self.frames(samples), self.weights(squared).array)
        return means


class FrameBuffer:
    """The samples that later frames need, in an array that grows at its end and is moved now and then.

    Samples are counted from the first one that is held on, through the next block: the next frame starts at `skip`,
    which is 0 but where the hop is longer than the window and samples still to come lie between two frames.

    Attributes
    ----------
    position : int
        How many samples came before the first one that is held, or is to come.
    """

    def __init__(self) -> None:
        self._store = kernels.PinnedArray.of(np.empty((0, 0)))
        self._rows: tuple[int, ...] = (0,)
        self._start = self._stop = 0
        self.skip = self.position = 0

    @property
    def held(self) -> int:
        """How many samples there are."""
        return self._stop - self._start

    def begin(self, rows: tuple[int, ...]) -> None:
        """A block of `rows` is about to come. Other rows than before mean a new beginning."""
        if rows != self._rows:
            self._rows = rows
            self._make_store(0)
            self._start = self._stop = self.skip = self.position = 0

    def advance(self, arriving: int, count: int) -> tuple[kernels.SampleRange, kernels.SampleRange]:
        """After a block of so many samples, the next frame is to start `count` samples later than it would have.

        Returns the samples held till now, and room for those at the end of the block that will be held; the caller must
        fill it. The room may lie where the samples were, then each row behind the place of its own old samples.
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
            return kernels.SampleRange(self._store, start, stop), kernels.SampleRange(
                self._store, stop, stop + arriving
            )
        history = kernels.SampleRange(self._store, self._start, self._stop)
        kept = max(0, kept)
        if kept > self._store.array.shape[-1]:
            self._make_store(kept)
        self._start, self._stop = 0, kept
        return history, kernels.SampleRange(self._store, 0, kept)

    def _make_store(self, samples: int) -> None:
        self._store = kernels.PinnedArray.of(np.empty((*self._rows, samples)))

    def append(self, block: FloatArray) -> FloatArray:
        """Take in (*rows, N); a view of all samples from the next frame's start on, valid until the next call."""
        self.begin(block.shape[:-1])
        _, room = self.advance(block.shape[-1], 0)
        room.samples[...] = _last(block, room.length)
        return self._store.array[..., self._start : self._stop]

    def drop(self, count: int) -> None:
        """The next frame starts `count` samples later, be they here or still to come."""
        self.advance(0, count)

    def _make_room(self, needed: int) -> None:
        store = self._store.array
        if self._start + needed <= store.shape[-1]:
            return
        kept = store[..., self._start : self._stop]
        if 2 * needed > store.shape[-1]:
            self._make_store(2 * needed)
        self._store.array[..., : kept.shape[-1]] = kept
        self._start, self._stop = 0, kept.shape[-1]


def _last(block: FloatArray, count: int) -> FloatArray:
    """The last `count` samples of (..., N)."""
    return block[..., block.shape[-1] - count :]


class FramedStage(Stage):
    """A stage that works frame by frame.

    A subclass says in `frame` what it makes of frames, and needs nothing else; where a kernel does that, it has a
    `process` of its own. A change of window or hop keeps the buffered samples: the next frame starts where it would
    have started anyway.
    """

    prefix: ClassVar[str]  # of the three parameters of `frame_parameters`

    def __init__(self, input_format: SignalFormat | float, **parameters: Any) -> None:
        self._buffer = FrameBuffer()
        super().__init__(input_format, **parameters)

    def frame(self, frames: FloatArray) -> FloatArray:
        """What comes out for `frames` (..., F, w), which are not windowed yet (see `window`): (..., F)."""
        raise NotImplementedError

    @property
    def window(self) -> FloatArray:
        """The window (w,) in force."""
        return self._framing.window

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> Output:
        frames = self._framing.frames(self._buffer.append(clamp(self._as_valid_block(block))))
        output = np.ascontiguousarray(self.frame(frames))
        if np.may_share_memory(output, frames):  # those move when the next block comes
            output = output.copy()
        self._buffer.drop(frames.shape[-2] * self._framing.hop)
        return output

    def output_count(self, count: int) -> int:
        return self._framing.complete_frames(count)

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
        self._buffer = FrameBuffer()

    def _means(self, samples: FloatArray, squared: bool) -> FloatArray:
        """`FrameGrid.means` of the frames that `samples` (*rows, N) complete, (*rows, F), by numpy."""
        means = self._framing.means(self._buffer.append(samples), squared)
        self._buffer.drop(means.shape[-1] * self._framing.hop)
        return means

    def _frames(
        self, block: FloatArray, weights: kernels.PinnedArray, rows: tuple[int, ...] | None = None
    ) -> kernels.FrameReader:
        """The frames that `block` completes, for a kernel; the buffer has moved on then.

        `rows` are those of what is held, where that is not what comes.
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
