"""`rosafe.process`: auditory representations of a signal in memory, computed by the same tree as in the node."""

from __future__ import annotations

import inspect
import itertools
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from rosafe.declarations.block_length import DEFAULT_FRAMES_PER_BLOCK
from rosafe.declarations.text import short_repr
from rosafe.dsp import kernels
from rosafe.dsp.stage import SAMPLE_RATE
from rosafe.interface import KINDS
from rosafe.interface.arguments import check_change, check_parameters
from rosafe.interface.remarks import no_frames, rate_advice, unknown_argument, warnings_of
from rosafe.processing import chain
from rosafe.processing.chain import Chain, FrameLimiter, computed_ears, effective_parameters
from rosafe.processing.signals import (
    as_samples,
    check_finite,
    ears_view,
    frame_times,
    of_ears,
    outputs_of,
    range_warning,
)
from rosafe.results.result import Result
from rosafe.system.version import VERSION
from rosafe.tree.block import Block
from rosafe.tree.sizes import refuse_over_available
from rosafe.tree.workers import workers_to_use

_EMPTY = np.empty(0)


def process(
    signal: Any,
    sample_rate: float,
    *,
    parameters: Mapping[str, Any] | None = None,
    block_frames: int | Sequence[int] = DEFAULT_FRAMES_PER_BLOCK,
    modifications: Sequence[tuple[int, str, Any]] = (),
    outputs: Sequence[str] | str | None = None,
    pad: bool = False,
    dtype: npt.DTypeLike = "float64",
    **unknown: Any,
) -> Result:
    """Compute auditory representations of a signal in memory.

    Parameters
    ----------
    signal : array_like, shape (2, N) or (N, 2), or (N,) or (1, N) for one ear
        Left and right ear. Floats, or int32 or int16, whose full scale becomes 1. (2, 2) is read as (2, N).
    sample_rate : float
        In Hz.
    parameters : mapping, optional
        Names and values, such as `fb_nChannels`; docs/parameters.md lists all of them.
        Others have the defaults of the interface table, except that `in_doNormalize` is True for integers and False
        for floats.
    block_frames : int or sequence of int, optional
        Block size, or sizes that are used cyclically; the last block contains the remaining frames. The numbers depend
        on it only through the block in which gain control (`pp_bNormalizeRMS`) starts; otherwise small blocks are
        merged, which is faster. Without kernels, and with plugins, the last bits depend on it too, and blocks are not
        merged.
    modifications : sequence of (block, name, value), optional
        Parameter changes, each made before the block of that number (from 0); several for one block are made in the
        given order. Those for blocks beyond the end are ignored. The original's `set_rm_scailing` is accepted too.
    outputs : sequence of str, or str, optional
        The representations to return. The default is `input`, `preProc`, `gammatone`, `ihc`, `ild`, `ratemap` and
        `crossCorrelation`; for one ear those that do not compare two. Only processors that these outputs depend on are
        computed.
    pad : bool, optional
        Whether the signal is continued with zeros until all frames that begin within it are complete: each framed
        output then has ceil(N / hop) frames. Frames that are complete without padding keep their bits. By default only
        complete frames are returned, as by the node.
    dtype : {"float64", "float32"}, optional
        The type of the outputs. They are computed as float64, and rounded.

    Returns
    -------
    Result
        A dict with attributes such as `parameters`, `sample_rate` and `version`, and with `plot`, `save` and
        `to_xarray`. Each output has the axes that `rosafe process -h` lists, such as `input`, `preProc` (2, N);
        `gammatone`, `ihc` (2, C, N); `ild` (C, F) in dB; `ratemap` (2, C, F); `crossCorrelation` (C, L, F); an output
        with several parts as `<kind>_<part>`. For one ear the first axis has length 1.
        `<kind>_time` in seconds from the first sample: the middle of frame k, (k h + w / 2) / fs for a hop of h and a
        window of w samples; n / fs for outputs with one value per sample. `<kind>_frameRate` in Hz for framed outputs.
        Coordinates of the other axes, such as `fb_cfHz` (C,) in Hz and `cc_lags` (L,) in seconds.
        If a change alters the number of lags or channels, L and C are the largest, and the remaining elements are 0;
        rates and `fb_cfHz` are the last ones.

    Raises
    ------
    ValueError
        For a signal of the wrong shape or type or with samples that are not finite, an unknown parameter or output,
        and a value of the wrong type or out of its range.

    Warns
    -----
    UserWarning
        If an output has no frames because the signal is shorter than its window, if the window of the pitch is shorter
        than three periods of the lowest pitch, and if floats are in the range of integer samples.

    See Also
    --------
    rosafe.Stream : The same numbers for sound that arrives block by block.

    Notes
    -----
    One ear takes about half of the time of two, except with plugins, for which it is computed as two equal ears.

    Examples
    --------
    >>> import numpy as np, rosafe
    >>> noise = np.random.default_rng(1).standard_normal((2, 16000))
    >>> result = rosafe.process(noise, 16000, parameters={"fb_nChannels": 32}, outputs=["ild", "ratemap"])
    >>> result["ratemap"].shape
    (2, 32, 99)
    """
    if unknown:
        raise unknown_argument(next(iter(unknown)))
    try:
        call = ProcessCall(signal, sample_rate, parameters, block_frames, modifications, outputs, pad, dtype)
    except ValueError as problem:
        raise problem.with_traceback(None) from None  # internal frames do not help the caller
    result = call.run()
    for text in call.warnings:
        warnings.warn(text, UserWarning, 2)
    return result


process.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
    [p for p in inspect.signature(process).parameters.values() if p.kind is not p.VAR_KEYWORD],
    return_annotation="Result",
)


class ProcessCall:
    """One call of `process` with checked arguments. Nothing is computed before `run`, which completes `warnings`."""

    warnings: list[str]

    def __init__(
        self,
        signal: Any,
        sample_rate: Any,
        parameters: Any = None,
        block_frames: Any = DEFAULT_FRAMES_PER_BLOCK,
        modifications: Any = (),
        outputs: Any = None,
        pad: Any = False,
        dtype: Any = "float64",
    ) -> None:
        view = ears_view(signal)
        self.ears, frames = view.shape
        self.rate = SAMPLE_RATE.check(sample_rate)
        lengths = _block_lengths(block_frames)
        padded = _checked_pad(pad)
        self.dtype = _checked_dtype(dtype)
        self.values = {"in_doNormalize": view.dtype.kind == "i", **check_parameters(parameters)}
        changes = _checked_modifications(modifications)
        self.outputs = outputs_of(self.ears, outputs)
        self.collectors: dict[str, dict[str, list[OutputCollector]]] = {}  # of each branch, by kind and name
        # for each kind: successive formats, each with its number of frames
        self.counts: dict[str, list[list[Any]]] = {kind: [[None, 0]] for kind in self.outputs}
        self.frames, self.padding = frames, 0
        self.limiter = FrameLimiter(frames)
        computed = computed_ears(self.ears, self.outputs)
        blocks = self._blocks(np.broadcast_to(view, (computed, frames)), lengths)
        branches = 1 if changes or frames <= chain.MAX_FRAMES else workers_to_use()
        try:
            self.chain = Chain(blocks, self.rate, self.values, self.outputs, self.collect, branches, computed)
        except ValueError as problem:
            raise rate_advice(problem, self.rate) from None
        try:
            self._prepare(frames, lengths, changes, padded)
            check_finite(view)  # last, because it reads the whole signal
            self.warnings = list(filter(None, [range_warning(view)]))
        except BaseException:
            self.chain.close()
            raise

    def _blocks(self, ears: np.ndarray, lengths: list[int]) -> Iterator[np.ndarray]:
        """Yield the blocks of the signal, then those of the padding."""
        for first, end in _edges(lengths, self.frames):
            yield as_samples(ears[:, first:end])
        for first in range(0, self.padding, DEFAULT_FRAMES_PER_BLOCK):
            silence = min(DEFAULT_FRAMES_PER_BLOCK, self.padding - first)
            yield np.zeros((len(ears), silence), as_samples(ears[:, :0]).dtype)

    def _prepare(self, frames: int, lengths: list[int], changes: list[tuple[int, str, Any]], pad: bool) -> None:
        """Schedule the changes, check the memory and allocate the outputs."""
        shapes = {kind: self.chain.shapes(kind, frames, pad) for kind in self.outputs}  # before any change
        self.padding = self.chain.padding(frames) if pad else 0
        one_round = itertools.islice(_edges(lengths, frames), len(lengths))
        largest_block = max((end - first for first, end in one_round), default=0)
        size = self._size(pad, largest_block)
        count = _block_count(lengths, frames)
        for block, name, value in changes:
            if block < count:
                self.chain.schedule(block, name, value)
                self.values = check_parameters({**self.values, name: value})
                size = max(size, self._size(pad, largest_block))
                if pad:  # twice, as the frames before and after the change may be offset
                    self.padding = max(self.padding, 2 * self.chain.padding(frames))
        refuse_over_available(size, "outputs", "name fewer outputs, or take fewer channels or lags")
        for kind in self.outputs:
            centred, parts = KINDS[kind].centred, KINDS[kind].outputs
            self.collectors[kind] = {}
            for name, of_branches in shapes[kind].items():
                axes = parts[name].axes
                kept = [(self.ears, *shape[1:]) if axes[0] == "ear" else shape for shape in of_branches]
                middle = axes.index(centred) if centred in axes else -1
                self.collectors[kind][name] = [
                    OutputCollector(one, middle) for one in allocate_branches(kept, axes, self.dtype)
                ]
            for branch, first_part in enumerate(next(iter(self.collectors[kind].values()))):
                self.chain.set_output_allocator(kind, branch, first_part.allocate)

    def _size(self, pad: bool, largest_block: int) -> int:
        """Return the bytes of all results, or of the largest block if that is more."""
        parts = (part for kind in self.outputs for part in self.chain.shapes(kind, self.frames, pad).values())
        results = sum(self.dtype.itemsize * math.prod(shape) for part in parts for shape in part)
        return max(results, self.chain.largest_block(largest_block)[1])

    def collect(self, kind: str, branch: int, block: Block) -> None:
        """Add a released block to its output, without frames that begin after the signal."""
        count, kept = block.data.shape[-1], self.limiter.kept(kind, branch, block)
        for part, collectors, data in zip(
            KINDS[kind].outputs.values(), self.collectors[kind].values(), block.parts, strict=True
        ):
            whole = of_ears(self.ears, part.axes, data)
            collectors[branch].add(whole if kept == count else whole[..., :kept])
        if branch:
            return  # the first branch counts the frames
        last = self.counts[kind][-1]
        if last[0] is block.signal:
            last[1] += kept
        else:
            self.counts[kind].append([block.signal, kept])

    def _times(self, kind: str) -> np.ndarray:
        """Return the middle of each collected frame (s)."""
        times, first = [np.empty(0)], 0
        for signal, count in self.counts[kind][1:]:
            times.append(frame_times(signal, first, count))
            first += count * signal.hop
        return np.concatenate(times)

    def run(self) -> Result:
        """Compute and return the results, whose collectors are dropped."""
        parameters = effective_parameters(self.values, self.outputs, self.rate)
        with self.chain:
            self.chain.run(merge=True)
            results: dict[str, Any] = {}
            for kind in self.outputs:
                collectors = self.collectors.pop(kind)
                for name in list(collectors):
                    results[name] = join_branches(collectors.pop(name))
                results[f"{kind}_time"] = self._times(kind)
            results |= self.chain.describe()
        result = Result(results, parameters=parameters, sample_rate=self.rate, version=VERSION)
        framed = [kind for kind in self.outputs if f"{kind}_frameRate" in result]
        self.warnings += warnings_of(parameters, self.outputs)
        if empty := [kind for kind in framed if not len(result[f"{kind}_time"])]:
            self.warnings.append(no_frames(empty, not self.frames, "pad=True"))
        return result


# --- arguments ---


def _block_lengths(block_frames: Any) -> list[int]:
    """Return the lengths of the blocks, which are used cyclically."""
    several = isinstance(block_frames, (Sequence, np.ndarray)) and not isinstance(block_frames, (str, bytes))
    lengths = list(block_frames) if several and getattr(block_frames, "ndim", 1) != 0 else [block_frames]
    whole = all(isinstance(n, (int, np.integer)) and not isinstance(n, bool) and n > 0 for n in lengths)
    if not lengths or not whole:
        raise ValueError(
            f"block_frames: expected a positive integer or a sequence of these, got {short_repr(block_frames)}"
        )
    return list(map(int, lengths))


def _checked_pad(pad: Any) -> bool:
    if not isinstance(pad, (bool, int, np.bool_, np.integer)) or pad not in (0, 1):
        raise ValueError(f"pad: expected a boolean, got {short_repr(pad)}")
    return bool(pad)


def _checked_dtype(dtype: Any) -> np.dtype[Any]:
    try:
        checked = np.dtype(dtype)
    except TypeError:
        checked = np.dtype(object)
    if checked not in (np.float64, np.float32):
        raise ValueError(f"dtype: expected float64 or float32, got {short_repr(dtype)}")
    return checked


def _edges(lengths: list[int], frames: int) -> Iterator[tuple[int, int]]:
    """Yield the first frame and the end of each block of a signal."""
    ends = itertools.takewhile(lambda end: end < frames, itertools.accumulate(itertools.cycle(lengths)))
    return itertools.pairwise(itertools.chain([0], ends, [frames] if frames else []))


def _block_count(lengths: list[int], frames: int) -> int:
    rounds, rest = divmod(frames, sum(lengths))
    return rounds * len(lengths) + sum(1 for _ in _edges(lengths, rest))


def _checked_modifications(modifications: Any) -> list[tuple[int, str, Any]]:
    """Return the changes in the order of their blocks."""
    changes = []
    try:
        triples = [tuple(change) for change in modifications]
    except TypeError:
        triples = [()]
    for change in triples:
        if len(change) != 3:
            raise ValueError(
                f"modifications: expected a sequence of (block, name, value), got {short_repr(modifications)}"
            )
        block, name, value = change
        if isinstance(block, bool) or not isinstance(block, (int, np.integer)) or block < 0:
            raise ValueError(f"modifications: expected a block number, got {block!r}")
        changes.append((int(block), *check_change(name, value)))
    return sorted(changes, key=lambda change: change[0])


# --- outputs: the blocks of each are collected in one array ---


class OutputCollector:
    """Collects the blocks of one output in one array, to which each block is written immediately.

    Parameters
    ----------
    whole : ndarray, (..., frames)
        The array for all frames, if no parameter change alters the shape. After such a change, blocks are kept until
        the end.
    middle : int
        The axis that is aligned at its middle if a change alters its length; -1 for none.
    """

    MIN_WRITE_FRAMES = 32  # small blocks are written together: writing single columns takes many times as long

    def __init__(self, whole: np.ndarray, middle: int) -> None:
        self._middle = middle
        self._whole = whole
        self._rows = self._whole.shape[:-1]
        self._filled = 0  # frames
        self._started = False  # whether `_filled` frames have the rows of `_whole`; a block without frames has rows too
        self._pending: list[np.ndarray] = []
        self._pending_frames = 0
        self._fits = True
        self._output_slice: np.ndarray | None = None

    def allocate(self, frames: int) -> np.ndarray | None:
        """Return the part of the array for the next block, if a stage can write a block of `frames` frames there."""
        end = self._filled + frames
        free = self._fits and not self._pending and end <= self._whole.shape[-1] and self._whole.dtype == np.float64
        self._output_slice = self._whole[..., self._filled : end] if free else None
        return self._output_slice

    def add(self, block: np.ndarray) -> None:
        """Add the next block, (..., frames)."""
        if block is self._output_slice:
            self._filled, self._started, self._output_slice = self._filled + block.shape[-1], True, None
            return
        if block.shape[:-1] != self._rows:
            self._fits = False
        self._pending.append(block)
        self._pending_frames += block.shape[-1]
        if self._pending_frames >= self.MIN_WRITE_FRAMES and self._fits:
            self._write()

    def _write(self) -> None:
        end = self._filled + self._pending_frames
        if end <= self._whole.shape[-1]:
            kernels.concatenate(self._pending, self._whole[..., self._filled : end])
            self._pending, self._filled, self._pending_frames, self._started = [], end, 0, True

    def joined(self) -> np.ndarray:
        """Return the array of all blocks, and drop it here, so that other references to this object do not hold it."""
        if self._pending and self._fits:
            self._write()
        whole, pending, self._whole, self._pending, self._output_slice = self._whole, self._pending, _EMPTY, [], None
        if not pending and self._filled == whole.shape[-1]:
            return whole
        first = [whole[..., : self._filled]] if self._started else []
        return _join(self._middle, [*first, *pending]).astype(whole.dtype, copy=False)


def _join(middle: int, blocks: list[np.ndarray]) -> np.ndarray:
    """Join blocks along the last axis. If their leading shapes differ, the result has the largest, padded with 0.

    Blocks are aligned at the middle of the axis `middle`, and at the first element of other axes.
    """
    if all(block.shape[:-1] == blocks[0].shape[:-1] for block in blocks):
        return np.concatenate(blocks, axis=-1)
    shape = tuple(max(lengths) for lengths in zip(*(block.shape[:-1] for block in blocks), strict=True))
    joined = np.zeros((*shape, sum(block.shape[-1] for block in blocks)))
    end = 0
    for block in blocks:
        region = [slice(0, length) for length in block.shape]
        region[-1] = slice(end, end := end + block.shape[-1])
        if middle >= 0:
            first = (shape[middle] - block.shape[middle]) // 2
            region[middle] = slice(first, first + block.shape[middle])
        joined[tuple(region)] = block
    return joined


def allocate_branches(shapes: list[tuple[int, ...]], axes: tuple[str, ...], dtype: np.dtype[Any]) -> list[np.ndarray]:
    """Return an array for each branch, all of them parts of one array along the channels."""
    if len(shapes) == 1:
        return [np.empty(shapes[0], dtype)]
    channel = axes.index("channel")
    ends = list(itertools.accumulate(shape[channel] for shape in shapes))
    whole = np.empty((*shapes[0][:channel], ends[-1], *shapes[0][channel + 1 :]), dtype)
    return np.split(whole, ends[:-1], axis=channel)


def join_branches(branches: list[OutputCollector]) -> np.ndarray:
    """Return the one array that the branches from `allocate_branches` have filled."""
    joined = [branch.joined() for branch in branches]
    if len(joined) == 1:
        return joined[0]
    whole = joined[0].base
    assert whole is not None and all(one.base is whole for one in joined)
    return whole
