"""`rosafe.process`: the whole chain on a signal in memory, on the same tree as the node, as fast as it goes."""

from __future__ import annotations

import inspect
import itertools
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from rosafe.declarations.checks import short
from rosafe.dsp import kernels
from rosafe.dsp.stage import SAMPLE_RATE
from rosafe.interface import KINDS
from rosafe.interface.arguments import check_change, check_parameters
from rosafe.offline import chain
from rosafe.offline.chain import Chain
from rosafe.offline.memory import refuse_over_available
from rosafe.offline.signals import as_samples, check_finite, ears_view, frame_times, of_ears, outputs_of
from rosafe.tree.block import Block
from rosafe.tree.workers import workers_to_use

_NOTHING = np.empty(0)
DEFAULT_BLOCK = 12000  # frames, as InputProc's


def process(
    signal: Any,
    sample_rate: float,
    *by_place: Any,
    parameters: Mapping[str, Any] | None = None,
    block_frames: int | Sequence[int] = DEFAULT_BLOCK,
    modifications: Sequence[tuple[int, str, Any]] = (),
    outputs: Sequence[str] | str | None = None,
) -> dict[str, Any]:
    """Compute auditory representations of a signal in memory.

    Parameters
    ----------
    signal : array_like, shape (2, N) or (N, 2), or (N,) or (1, N) for one ear
        Left and right ear; float, or int32 or int16, whose full scale becomes 1. Where N is 2, (2, 2) is (2, N).
    sample_rate : float
        In Hz.
    parameters : mapping, optional
        Names and values, such as `fb_nChannels`; docs/parameters.md has them all.
        The rest takes the interface table's defaults, but for `in_doNormalize`: True for whole numbers, False for
        floats.
    block_frames : int or sequence of int, optional
        Block size, or sizes that are used in turn; the last block is what is left. Only where gain control
        (`pp_bNormalizeRMS`) starts do the numbers depend on it; elsewhere small blocks go through together, which is
        faster. Without kernels, and in plugins, the last bits depend on it too, and blocks stay as they are.
    modifications : sequence of (block, name, value), optional
        Parameter changes, each made before the block of that number (from 0); several for one block are made in the
        order given. Those for blocks that never come are ignored. The original's `set_rm_scailing` is known here too.
    outputs : sequence of str, or str, optional
        The representations to return: `input`, `preProc`, `gammatone`, `ihc`, `ild`, `ratemap` and `crossCorrelation`
        by default, of one ear those that do not compare two. What none of them depends on is not computed.

    Returns
    -------
    dict
        Each output as float64 with the axes that `rosafe process -h` lists, such as `input`, `preProc` (2, N);
        `gammatone`, `ihc` (2, C, N); `ild` (C, F) in dB; `ratemap` (2, C, F); `crossCorrelation` (C, L, F); one that
        has several parts as `<kind>_<part>`. Of one ear the first axis has length 1.
        `<kind>_time` in seconds from the first sample: the middle of frame k, (k h + w / 2) / fs for a hop of h and a
        window of w samples; n / fs for what has no frames. `<kind>_frameRate` in Hz of those in frames.
        What lies along the other axes, such as `fb_cfHz` (C,) in Hz and `cc_lags` (L,) in seconds.
        Where a change alters the number of lags or channels, L and C are the largest and what lies outside is 0; rates
        and `fb_cfHz` are the last ones.

    Raises
    ------
    ValueError
        For anything that cannot be: a signal of the wrong shape or type or with samples that are not finite, a
        parameter or output that does not exist, a value of the wrong type or out of its range.

    See Also
    --------
    rosafe.Stream : The same numbers of sound that comes block by block.

    Notes
    -----
    One ear is computed as two ears that hear the same, and costs as much.

    Examples
    --------
    >>> import numpy as np, rosafe
    >>> noise = np.random.default_rng(1).standard_normal((2, 16000))
    >>> result = rosafe.process(noise, 16000, parameters={"fb_nChannels": 32}, outputs=["ild", "ratemap"])
    >>> result["ratemap"].shape
    (2, 32, 99)
    """
    options = (parameters, block_frames, modifications, outputs)
    if by_place:
        options = _named(by_place, options)
    try:
        work = _ProcessCall(signal, sample_rate, *options)
    except ValueError as problem:
        raise problem.with_traceback(None) from None  # where inside it was found helps nobody
    return work.run()


process.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
    [p for p in inspect.signature(process).parameters.values() if p.kind is not p.VAR_POSITIONAL],
    return_annotation="dict[str, Any]",
)


def _named(by_place: tuple[Any, ...], options: tuple[Any, Any, Any, Any]) -> tuple[Any, Any, Any, Any]:
    """The options, of which the first ones were given by their place, as it was done once and still is in programs."""
    if len(by_place) > len(options):
        raise TypeError(f"process() takes 2 positional arguments, and {2 + len(by_place)} were given")
    warnings.warn("give what follows the sample rate by name, as in parameters={...}", DeprecationWarning, 3)
    return (*by_place, *options[len(by_place) :])


class _ProcessCall:
    """One call of `process`, all of it checked; nothing has been computed."""

    def __init__(self, signal: Any, sample_rate: Any, parameters: Any, sizes_: Any, changes: Any, outputs: Any) -> None:
        view = ears_view(signal)
        self.ears, frames = view.shape
        self.rate = SAMPLE_RATE.check(sample_rate)
        lengths = _block_lengths(sizes_)
        values = {"in_doNormalize": view.dtype.kind == "i", **check_parameters(parameters)}
        changes = _checked_modifications(changes)
        self.wanted = outputs_of(self.ears, outputs)
        self.gathered: dict[str, dict[str, list[_OutputCollector]]] = {}  # by kind and name, of each branch
        # of each output, how many frames of each format have come, one after the other
        self.counts: dict[str, list[list[Any]]] = {kind: [[None, 0]] for kind in self.wanted}
        both = np.broadcast_to(view, (2, frames))
        blocks = (as_samples(both[:, first:end]) for first, end in _edges(lengths, frames))
        branches = 1 if changes or frames <= chain.MAX_FRAMES else workers_to_use()
        self.chain = Chain(blocks, self.rate, values, self.wanted, self.keep, branches)
        try:
            self._prepare(frames, lengths, changes)
            check_finite(view)  # last, as it reads the whole signal
        except BaseException:
            self.chain.close()
            raise

    def _prepare(self, frames: int, lengths: list[int], changes: list[tuple[int, str, Any]]) -> None:
        chain, wanted = self.chain, self.wanted
        count = _block_count(lengths, frames)
        one_round = itertools.islice(_edges(lengths, frames), len(lengths))
        largest = max((end - first for first, end in one_round), default=0)
        taken = [_size(chain, wanted, frames, largest)]
        shapes = {kind: chain.shapes(kind, frames) for kind in wanted}  # before any change
        for block, name, value in changes:
            if block < count:
                chain.schedule(block, name, value)
                taken.append(_size(chain, wanted, frames, largest))
        refuse_over_available(max(taken), "outputs: they", "; name fewer outputs, or take fewer channels or lags")
        for kind in wanted:
            centred, parts = KINDS[kind].centred, KINDS[kind].outputs
            self.gathered[kind] = {}
            for name, of_branches in shapes[kind].items():
                axes = parts[name].axes
                kept = [(self.ears, *shape[1:]) if axes[0] == "ear" else shape for shape in of_branches]
                middle = axes.index(centred) if centred in axes else -1
                self.gathered[kind][name] = [_OutputCollector(place, middle) for place in _places(kept, axes)]
            for branch, one in enumerate(next(iter(self.gathered[kind].values()))):
                self.chain.set_output_allocator(kind, branch, one.place)

    def keep(self, kind: str, branch: int, block: Block) -> None:
        """Take what has been released."""
        parts = block.parts
        if self.ears == 1:
            axes = [part.axes for part in KINDS[kind].outputs.values()]
            parts = tuple(of_ears(self.ears, *one) for one in zip(axes, parts, strict=True))
        for gathered, data in zip(self.gathered[kind].values(), parts, strict=True):
            gathered[branch].add(data)
        if branch:
            return  # it tells of the same frames as the first one
        signal, frames = block.signal, parts[0].shape[-1]
        last = self.counts[kind][-1]
        if last[0] is signal:
            last[1] += frames
        else:
            self.counts[kind].append([signal, frames])

    def _times(self, kind: str) -> np.ndarray:
        """Seconds at the middle of each frame that was kept."""
        times, first = [np.empty(0)], 0
        for signal, count in self.counts[kind][1:]:
            times.append(frame_times(signal, first, count))
            first += count * signal.hop
        return np.concatenate(times)

    def run(self) -> dict[str, Any]:
        """Compute; what was gathered is given up."""
        with self.chain as chain:
            chain.run(together=True)
            results: dict[str, Any] = {}
            while self.gathered:
                kind = next(iter(self.gathered))
                wholes = self.gathered.pop(kind)
                while wholes:
                    name = next(iter(wholes))
                    results[name] = _joined(wholes.pop(name))
                results[f"{kind}_time"] = self._times(kind)
            results.update(chain.describe())
            return results


# --- arguments ---


def _block_lengths(block_frames: Any) -> list[int]:
    """The lengths of the blocks, which are used in turn."""
    several = isinstance(block_frames, (Sequence, np.ndarray)) and not isinstance(block_frames, (str, bytes))
    sizes = list(block_frames) if several and getattr(block_frames, "ndim", 1) != 0 else [block_frames]
    whole = all(isinstance(n, (int, np.integer)) and not isinstance(n, bool) and n > 0 for n in sizes)
    if not sizes or not whole:
        raise ValueError(f"block_frames: {short(block_frames)} is not a positive whole number, or a sequence of such")
    return list(map(int, sizes))


def _edges(lengths: list[int], frames: int) -> Iterator[tuple[int, int]]:
    """The beginning and the end of each block of a signal of so many frames; not a list, which could be very long."""
    ends = itertools.takewhile(lambda end: end < frames, itertools.accumulate(itertools.cycle(lengths)))
    return itertools.pairwise(itertools.chain([0], ends, [frames] if frames else []))


def _block_count(lengths: list[int], frames: int) -> int:
    rounds, rest = divmod(frames, sum(lengths))
    return rounds * len(lengths) + sum(1 for _ in _edges(lengths, rest))


def _checked_modifications(modifications: Any) -> list[tuple[int, str, Any]]:
    """The changes in the order of their blocks."""
    changes = []
    try:
        triples = [tuple(change) for change in modifications]
    except TypeError:
        triples = [()]
    for change in triples:
        if len(change) != 3:
            raise ValueError("modifications: wanted is a sequence of (block, name, value)")
        block, name, value = change
        if isinstance(block, bool) or not isinstance(block, (int, np.integer)) or block < 0:
            raise ValueError(f"modifications: {block!r} is not a block number")
        changes.append((int(block), *check_change(name, value)))
    return sorted(changes, key=lambda change: change[0])


# --- what comes out ---


def _size(chain: Chain, wanted: list[str], frames: int, largest_block: int) -> int:
    """Bytes of the largest thing there will be at a time: all results, or one block of what is not kept."""
    shapes = (shape for kind in wanted for of_part in chain.shapes(kind, frames).values() for shape in of_part)
    results = sum(8 * math.prod(shape) for shape in shapes)
    return max(results, chain.largest_block(largest_block)[1])


def _places(shapes: list[tuple[int, ...]], axes: tuple[str, ...]) -> list[np.ndarray]:
    """Parts of one array for outputs of these shapes, which lie behind each other along the channels."""
    if len(shapes) == 1:
        return [np.empty(shapes[0])]
    along = axes.index("channel")
    ends = list(itertools.accumulate(shape[along] for shape in shapes))
    whole = np.empty((*shapes[0][:along], ends[-1], *shapes[0][along + 1 :]))
    return np.split(whole, ends[:-1], axis=along)


def _joined(branches: list[_OutputCollector]) -> np.ndarray:
    joined = [branch.joined() for branch in branches]
    if len(joined) == 1:
        return joined[0]
    whole = joined[0].base
    assert whole is not None and all(one.base is whole for one in joined)
    return whole


class _OutputCollector:
    """All that is released of one output. Each block goes to its place in the result at once, small ones together.

    Parameters
    ----------
    whole : ndarray
        Where it goes, if no parameter changes on the way. From where one does, blocks wait for the end.
    middle : int
        The axis whose middle stays where it is where a change alters its length; -1 for none.
    """

    TOGETHER = 32  # frames: a row of one frame after the other is written many times as slowly

    def __init__(self, whole: np.ndarray, middle: int) -> None:
        self._middle = middle
        self._whole = whole
        self._rows = self._whole.shape[:-1]
        self._filled = 0  # frames
        self._begun = False  # a block without frames has rows, too
        self._waiting: list[np.ndarray] = []
        self._frames = 0  # that wait
        self._fits = True
        self._output_slice: np.ndarray | None = None

    def place(self, frames: int) -> np.ndarray | None:
        """Where the next block may be written, of so many frames if it has any."""
        end = self._filled + frames
        free = self._fits and not self._waiting and end <= self._whole.shape[-1]
        self._output_slice = self._whole[..., self._filled : end] if free else None
        return self._output_slice

    def add(self, block: np.ndarray) -> None:
        """The next block, (..., frames)."""
        if block is self._output_slice:
            self._filled, self._begun, self._output_slice = self._filled + block.shape[-1], True, None
            return
        shape = block.shape
        if shape[:-1] != self._rows:
            self._fits = False
        self._waiting.append(block)
        self._frames += shape[-1]
        if self._frames >= self.TOGETHER and self._fits:
            self._write()

    def _write(self) -> None:
        end = self._filled + self._frames
        if end <= self._whole.shape[-1]:
            kernels.concatenate(self._waiting, self._whole[..., self._filled : end])
            self._waiting, self._filled, self._frames, self._begun = [], end, 0, True

    def joined(self) -> np.ndarray:
        """The whole. It is not held any longer: whoever still knows of this one must not keep that from being freed."""
        if self._waiting and self._fits:
            self._write()
        whole, waiting, self._whole, self._waiting, self._output_slice = self._whole, self._waiting, _NOTHING, [], None
        if not waiting and self._filled == whole.shape[-1]:
            return whole
        first = [whole[..., : self._filled]] if self._begun else []
        return _join(self._middle, [*first, *waiting])


def _join(middle: int, blocks: list[np.ndarray]) -> np.ndarray:
    """All blocks along the last axis. Where the leading shape changed on the way, the largest rules.

    The axis `middle` is aligned at its middle, others at their first; what lies outside is 0.
    """
    if all(block.shape[:-1] == blocks[0].shape[:-1] for block in blocks):
        return np.concatenate(blocks, axis=-1)
    shape = tuple(max(sizes) for sizes in zip(*(block.shape[:-1] for block in blocks), strict=True))
    joined = np.zeros((*shape, sum(block.shape[-1] for block in blocks)))
    at = 0
    for block in blocks:
        place = [slice(0, size) for size in block.shape]
        place[-1] = slice(at, at + block.shape[-1])
        if middle >= 0:
            first = (shape[middle] - block.shape[middle]) // 2
            place[middle] = slice(first, first + block.shape[middle])
        joined[tuple(place)] = block
        at += block.shape[-1]
    return joined
