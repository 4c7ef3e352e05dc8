"""The chain of processors that a set of outputs needs: the engine of `rosafe.process` and of `process_file`."""

from __future__ import annotations

import bisect
import itertools
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from rosafe.declarations.block_length import DEFAULT_FRAMES_PER_BLOCK
from rosafe.dsp import kernels
from rosafe.interface import KINDS, ComponentError
from rosafe.interface.arguments import needed
from rosafe.processing.signals import frame_times
from rosafe.representations import BUILTIN, STAGES
from rosafe.tree import sizes
from rosafe.tree.block import Block
from rosafe.tree.processor import Observer, Processor
from rosafe.tree.tree import Tree

# Limits of a block that is merged from smaller ones: its frames, and the output of any processor for it
MAX_FRAMES = DEFAULT_FRAMES_PER_BLOCK
MAX_BYTES = 2**22


class _GatedSource:
    """Feeds blocks to the tree after `start` has been called, which follows the creation of the whole tree.

    Successive blocks with at most `max_frames` frames in total are merged.
    """

    waiting = False

    def __init__(self, blocks: Iterable[np.ndarray], sample_rate: float) -> None:
        self.sample_rate = sample_rate
        self.ended = False
        self._blocks = iter(blocks)
        self._next: np.ndarray | None = None  # a block that was fetched but did not fit
        self._frames = 0
        self._max_frames: int | None = None  # of a merged block; None before `start`
        self._wake: Callable[[], None] = lambda: None

    def open(self, wake: Callable[[], None], required_frames: Callable[[], float]) -> None:
        self._wake = wake

    def start(self, max_frames: int) -> None:
        """Open the gate; merge blocks up to `max_frames` frames."""
        self._max_frames = max_frames
        self._wake()

    def read(self) -> tuple[np.ndarray, int] | None:
        if self._max_frames is None or self.ended:
            return None
        blocks: list[np.ndarray] = []
        frames = 0
        while (block := next(self._blocks, None) if self._next is None else self._next) is not None:
            self._next = block
            if blocks and frames + block.shape[-1] > self._max_frames:
                break
            self._next = None
            blocks.append(block)
            frames += block.shape[-1]
            if frames >= self._max_frames or self.ended:  # another thread may end it
                break
        if not blocks:
            self.stop()
            return None
        self._frames += frames
        return blocks[0] if len(blocks) == 1 else np.concatenate(blocks, axis=-1), self._frames

    def stop(self) -> None:
        self.ended = True
        self._wake()


class _Listener:
    """Forwards released blocks, and stores the first error, which ends the run."""

    def __init__(self, source: _GatedSource, on_block: Callable[[str, int, Block], None]) -> None:
        self.branches: dict[Processor, int] = {}
        self._source = source
        self._on_block = on_block
        self._lock = threading.Lock()
        self.error: BaseException | None = None

    def on_added(self, processor: Processor) -> None:
        pass

    def on_executed(self, processor: Processor, seconds: float) -> None:
        pass

    def on_released(self, processor: Processor, block: Block) -> None:
        self._on_block(processor.kind, self.branches[processor], block)

    def on_removed(self, processor: Processor) -> None:
        if processor.error is not None:
            with self._lock:
                self.error = self.error or processor.error
            self._source.stop()


class FrameLimiter:
    """Limits outputs to the frames that begin within the signal; others result from padding."""

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._starts: dict[tuple[str, int], int] = {}  # audio frame at which the next frame of an output begins

    def kept(self, kind: str, branch: int, block: Block) -> int:
        """Return how many frames of the next block of an output to keep."""
        hop, start, count = block.signal.hop, self._starts.get((kind, branch), 0), block.data.shape[-1]
        self._starts[kind, branch] = start + count * hop
        return min(count, max(0, -((start - self._frames) // hop)))


class Chain:
    """A tree with the processors that some outputs need. It computes nothing before `run`. A context manager.

    Parameters
    ----------
    blocks : iterable of ndarray, (ears, n), int32 or float
        The signal. The next block is fetched when the chain can take it.
    sample_rate : float
        In Hz.
    values : mapping
        From `rosafe.interface.arguments.check_parameters`.
    outputs : sequence of str
        Kinds, from `rosafe.interface.arguments.check_outputs`.
    on_block : callable
        Called with the kind, the number of the branch and each block of it, in their order. The chain computes at most
        the next block meanwhile, so memory is bounded. An exception from it ends the run.
    ears : int
        The number of rows of `blocks`, from `computed_ears`.
    branches : int
        Maximum number of branches of the tree from the filterbank on. Each computes a part of the channels. There is
        one branch only if a stage is not `Stage.CHANNEL_INDEPENDENT`. With several, no parameter can be changed.

    Raises
    ------
    ValueError
        The parameters are not compatible with each other or with the sample rate.
    """

    def __init__(
        self,
        blocks: Iterable[np.ndarray],
        sample_rate: float,
        values: Mapping[str, Any],
        outputs: Iterable[str],
        on_block: Callable[[str, int, Block], None],
        branches: int = 1,
        ears: int = 2,
    ) -> None:
        self.sample_rate = sample_rate
        self._ears = ears
        self._source = _GatedSource(blocks, sample_rate)
        self._listener = _Listener(self._source, on_block)
        self._tree = Tree(self._listener)
        self._processors: dict[str, list[Processor]] = {}  # for each kind: one, or one for each branch
        self._outputs = frozenset(outputs)
        self._derived: dict[int, dict[str, Any]] = {}  # derived values by the first block that they apply to
        try:
            with _as_value_error():
                self._build(needed(outputs), values, branches)
        except BaseException:
            self.close()
            raise
        self._record_derived(0)

    def _build(self, kinds: list[str], values: Mapping[str, Any], branches: int) -> None:
        divided = (
            branches > 1
            and kernels.compiled()
            and all(STAGES[kind].CHANNEL_INDEPENDENT for kind in kinds if kind not in _above_channels(kinds))
        )
        in_place = in_place_kinds(kinds, self._outputs)
        for kind in kinds:  # parents come first
            parent = KINDS[kind].parent
            own = {p.name: values[p.name] for p in KINDS[kind].parameters if p.name in values}
            added = self._processors[kind] = []
            if not parent:
                added.append(self._tree.add_input(kind, self._source, 0, 0.0, 0.0, own, self._ears))
            elif KINDS[kind].channel_parameter and divided:
                (above,) = self._processors[parent]
                name = KINDS[kind].channel_parameter
                frequencies = STAGES[kind](above.signal, **own).output_format.center_frequencies
                for share in _shares(frequencies, branches):
                    added.append(self._tree.add(kind, f"{kind} {len(added)}", parent, {**own, name: share}))
            else:
                for above in self._processors[parent]:
                    added.append(self._tree.add(kind, above.name.replace(parent, kind), above.name, own))
            for branch, processor in enumerate(added):
                self._listener.branches[processor] = branch
                processor.has_consumers = kind in self._outputs
                if kind in in_place:
                    processor.output_buffer_for = lambda block: block.data

    def schedule(self, block: int, name: str, value: Any) -> None:
        """Change a (checked) parameter before block `block`. Blocks must ascend from call to call. Or ValueError."""
        with _as_value_error():
            self._tree.schedule(block, name, value)
        self._record_derived(block)

    def _record_derived(self, block: int) -> None:
        self._derived[block] = {k: v for p, *_ in self._processors.values() for k, v in p.stage.derived.items()}

    def set_output_allocator(self, kind: str, branch: int, allocate: Callable[[int], np.ndarray | None]) -> None:
        """Let a stage without children write into the array that `allocate` returns for a number of frames.

        It has no effect on stages that return frames or do not take `out`.
        """
        processor = self._processors[kind][branch]
        childless = not processor.children  # children need contiguous blocks
        if processor.stage.TAKES_OUT and not processor.signal.framed and childless:
            processor.output_buffer_for = lambda block: allocate(block.data.shape[-1])

    def observe(self, observer: Observer) -> None:
        """Call `observer` with every state that a processor enters."""
        self._tree.observe(observer)

    def run(self, merge: bool = False) -> None:
        """Compute the whole signal. Raises the error of the first processor that fails.

        With `merge`, small blocks are merged if this does not change the numbers.
        """
        self._source.start(self._max_merged_frames() if merge else 0)
        for processor in self._all():
            processor.join()
        if self._listener.error is not None:
            raise self._listener.error

    def close(self) -> None:
        """End the run if it is in progress, and all threads."""
        self._tree.stop()
        self._tree.join()

    def __enter__(self) -> Chain:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # --- properties ---

    def _all(self) -> list[Processor]:
        return list(itertools.chain(*self._processors.values()))

    def shapes(self, kind: str, frames: int, pad: bool) -> dict[str, list[tuple[int, ...]]]:
        """Return the shape of each part of an output in each branch, for `frames` audio frames without a change.

        With `pad`, the frames that begin within the signal are complete.
        """
        processors = self._processors[kind]
        count = self._frame_count(kind, frames, pad)
        branches = zip(*(processor.output_shapes for processor in processors), strict=True)
        return {
            name: [(*rows, count) for rows in of_part]
            for name, of_part in zip(KINDS[kind].outputs, branches, strict=True)
        }

    def _count(self, processor: Processor, frames: int) -> int:
        """Return the number of output frames for `frames` audio frames."""
        return processor.stage.output_count(
            frames if processor.parent is None else self._count(processor.parent, frames)
        )

    def _frame_count(self, kind: str, frames: int, pad: bool) -> int:
        """Return the number of output frames for `frames` audio frames; with `pad`, of those that begin within them."""
        processor = self._processors[kind][0]
        return -(-frames // processor.signal.hop) if pad else self._count(processor, frames)

    def times(self, kind: str, frames: int, pad: bool) -> np.ndarray:
        """Return the middle of each frame of an output (s); the arguments are those of `shapes`."""
        return frame_times(self._processors[kind][0].signal, 0, self._frame_count(kind, frames, pad))

    def padding(self, frames: int) -> int:
        """Return the number of audio frames after the signal that complete the last frame of each output."""
        outputs = [(self._processors[kind][0], self._frame_count(kind, frames, pad=True)) for kind in self._outputs]

        def completes(extra: int) -> bool:
            return all(self._count(processor, frames + extra) >= count for processor, count in outputs)

        limit = 1
        while not completes(limit):
            limit *= 2
        return bisect.bisect_left(range(limit), True, key=completes)

    def largest_block(self, frames: int) -> tuple[str, int]:
        """Return the kind with the largest output for a block of `frames` audio frames, and its bytes."""
        seconds = frames / self.sample_rate
        size, kind = max((sizes.output_size(p.stage, p.input_shape, seconds), p.kind) for p in self._all())
        return kind, int(size)

    def _max_merged_frames(self) -> int:
        """Return the maximum number of frames of a merged block; 0 if merging could change the numbers.

        With kernels the numbers do not depend on block boundaries, to the last bit. With numpy, scipy and plugins they
        may. Parameter changes apply to blocks as they were given.
        """
        processors = self._all()
        dependent = any(p.kind not in BUILTIN or p.stage.block_size_dependent for p in processors)
        if dependent or not kernels.compiled() or len(self._derived) > 1:
            return 0
        frame = max(sizes.output_size(p.stage, p.input_shape, 1 / self.sample_rate) for p in processors)
        return min(MAX_FRAMES, int(MAX_BYTES / frame))

    def describe(self) -> dict[str, Any]:
        """Return axes such as `fb_cfHz` (Hz) and `cc_lags` (s), and the frame rates of the outputs (Hz).

        Rates, and axes that are parameters, are the last ones. Of derived axes it is the longest one.
        """
        described: dict[str, Any] = {}
        for kind, (processor, *others) in self._processors.items():
            parameters = processor.stage.parameters
            for name in processor.representation.coordinates:
                values = (
                    parameters[name] if name in parameters else max((d[name] for d in self._derived.values()), key=len)
                )
                if name == processor.representation.channel_parameter:  # its channels are spread over the branches
                    values = list(itertools.chain(values, *(other.stage.parameters[name] for other in others)))
                described[name] = axis_values(values)
            if processor.signal.framed and kind in self._outputs:
                described[f"{kind}_frameRate"] = processor.rate
        return described


def _above_channels(kinds: Iterable[str]) -> list[str]:
    """Return the kinds that are computed once, even if the channels are computed in several branches."""
    return needed(KINDS[kind].parent for kind in kinds if KINDS[kind].channel_parameter)


def axis_values(values: Sequence[Any]) -> list[str] | np.ndarray:
    """Return the values of an axis: names as a list, numbers as an array."""
    return list(values) if any(isinstance(value, str) for value in values) else np.array(values, np.float64)


def computed_ears(ears: int, outputs: Iterable[str]) -> int:
    """Return the number of ears to compute for a signal: one ear is computed as two equal ones for plugins."""
    return 2 if any(kind not in BUILTIN or KINDS[kind].binaural for kind in needed(outputs)) else ears


def effective_parameters(values: Mapping[str, Any], kinds: Iterable[str], sample_rate: float) -> dict[str, Any]:
    """Return all parameters; those whose default follows the sample rate only for processors that are computed.

    Sequences are lists, as in files.
    """
    result = {p.name: p.default for kind in KINDS.values() for p in kind.parameters if not p.follows_rate}
    result |= values
    for kind in needed(kinds):
        own = {p.name: values.get(p.name, p.default) for p in KINDS[kind].parameters}
        result |= STAGES[kind].resolve_rate_defaults(own, own.keys() & values.keys(), sample_rate)
    return {name: list(value) if isinstance(value, tuple) else value for name, value in result.items()}


def in_place_kinds(kinds: Collection[str], outputs: Collection[str]) -> list[str]:
    """Return the kinds that may overwrite their input blocks because no other consumer needs them.

    Kernels can overwrite; numpy cannot, and plugins must not.
    """
    if not kernels.compiled():
        return []
    parents = [KINDS[kind].parent for kind in kinds]
    return [
        kind
        for kind, parent in zip(kinds, parents, strict=True)
        if kind in BUILTIN and STAGES[kind].SUPPORTS_IN_PLACE and parent not in outputs and parents.count(parent) == 1
    ]


def _shares(frequencies: Sequence[float], count: int) -> list[list[float]]:
    """Split `frequencies` into at most `count` parts. All except the last one fill the lanes of a kernel."""
    groups = -(-len(frequencies) // kernels.MAX_LANES)
    count = min(count, groups)
    ends = [kernels.MAX_LANES * (groups * number // count) for number in range(count + 1)]
    return [list(frequencies[first:end]) for first, end in itertools.pairwise(ends)]


@contextmanager
def _as_value_error() -> Iterator[None]:
    """Convert the interface's named exceptions to ValueError."""
    try:
        yield
    except ComponentError as problem:
        raise ValueError(str(problem)) from None
