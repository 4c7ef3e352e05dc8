"""The chain of processors that some outputs need: what `rosafe.process` and the file front end run on."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Any

import numpy as np

from rosafe.dsp import kernels
from rosafe.interface import KINDS, ComponentError
from rosafe.offline.signals import frame_times
from rosafe.representations import BUILTIN, STAGES
from rosafe.tree import sizes
from rosafe.tree.block import Block
from rosafe.tree.context import Observer
from rosafe.tree.processor import Processor
from rosafe.tree.tree import Tree

# A block that is put together has no more frames, and no processor puts out more for it
MAX_FRAMES = 12000  # as InputProc's blocks by default
MAX_BYTES = 2**22

FILTERBANK = "gammatone"  # from which on there are channels
SHARED_KINDS = ("input", "preProc")


class _GatedSource:
    """Feeds blocks to the tree, one after the other, once `start` says that the whole tree stands.

    Those that have no more than `most` frames together are put together.
    """

    def __init__(self, blocks: Iterable[np.ndarray], sample_rate: float) -> None:
        self.sample_rate = sample_rate
        self.ended = False
        self._blocks = iter(blocks)
        self._next: np.ndarray | None = None  # which has been fetched already
        self._frames = 0
        self._most: int | None = None  # frames that are put together; nothing flows yet
        self._wake: Callable[[], None] = lambda: None

    def open(self, wake: Callable[[], None]) -> None:
        self._wake = wake

    def start(self, most: int) -> None:
        """Let the signal flow, in blocks of up to `most` frames where they are smaller."""
        self._most = most
        self._wake()

    def read(self) -> tuple[np.ndarray, int] | None:
        if self._most is None or self.ended:
            return None
        blocks: list[np.ndarray] = []
        frames = 0
        while (block := next(self._blocks, None) if self._next is None else self._next) is not None:
            self._next = block
            if blocks and frames + block.shape[-1] > self._most:
                break
            self._next = None
            blocks.append(block)
            frames += block.shape[-1]
            if frames >= self._most or self.ended:  # which somebody else says
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
    """Hands on what is released, and keeps the first error, which ends the run."""

    def __init__(self, source: _GatedSource, keep: Callable[[str, int, Block], None]) -> None:
        self.branches: dict[Processor, int] = {}
        self._source = source
        self._keep = keep
        self._lock = threading.Lock()
        self.error: BaseException | None = None

    def on_added(self, processor: Processor) -> None:
        pass

    def on_executed(self, processor: Processor, seconds: float) -> None:
        pass

    def on_released(self, processor: Processor, block: Block) -> None:
        self._keep(processor.kind, self.branches[processor], block)

    def on_removed(self, processor: Processor) -> None:
        if processor.error is not None:
            with self._lock:
                self.error = self.error or processor.error
            self._source.stop()


class Chain:
    """The processors that some outputs need, standing in a tree; nothing flows before `run`. A context manager.

    Parameters
    ----------
    blocks : iterable of ndarray, (2, n), int32 or float
        The signal; it is asked for the next block when the chain has room for it.
    sample_rate : float
        In Hz.
    parameters : mapping
        From `rosafe.interface.arguments.check_parameters`.
    outputs : sequence of str
        Kinds, from `rosafe.interface.arguments.check_outputs`.
    keep : callable
        Called with the kind, the number of the branch and each block of it, in their order, while the chain goes on
        with the next block; it does not go on beyond that, so memory is bounded. What it raises ends the run.
    branches : int
        From the filterbank on, the tree has so many branches at most, of a part of the channels each, if all that is
        computed is so `Stage.CHANNEL_INDEPENDENT`. Then no parameter can be changed.

    Raises
    ------
    ValueError
        Parameters that do not go together, or not with the sample rate.
    """

    def __init__(
        self,
        blocks: Iterable[np.ndarray],
        sample_rate: float,
        parameters: Mapping[str, Any],
        outputs: Iterable[str],
        keep: Callable[[str, int, Block], None],
        branches: int = 1,
    ) -> None:
        self.sample_rate = sample_rate
        self._source = _GatedSource(blocks, sample_rate)
        self._listener = _Listener(self._source, keep)
        self._tree = Tree(self._listener)
        self._processors: dict[str, list[Processor]] = {}  # of each kind one, or one for each branch
        self._outputs = frozenset(outputs)
        self._derived: dict[int, dict[str, Any]] = {}  # from parameters, from which block on
        try:
            with _as_value_error():
                self._build(needed(outputs), parameters, branches)
        except BaseException:
            self.close()
            raise
        self._remember(0)

    def _build(self, kinds: list[str], values: Mapping[str, Any], branches: int) -> None:
        divided = (
            branches > 1
            and kernels.compiled()
            and all(STAGES[kind].CHANNEL_INDEPENDENT for kind in kinds if kind not in SHARED_KINDS)
        )
        over = in_place_kinds(kinds, self._outputs)
        for kind in kinds:  # parents come first
            parent = KINDS[kind].parent
            mine = {p.name: values[p.name] for p in KINDS[kind].parameters if p.name in values}
            made = self._processors[kind] = []
            if not parent:
                made.append(self._tree.add_input(kind, self._source, 0, 0.0, 0.0, mine))
            elif kind == FILTERBANK and divided:
                (above,) = self._processors[parent]
                frequencies = STAGES[kind](above.signal, **mine).output_format.center_frequencies
                for share in _shares(frequencies, branches):
                    made.append(self._tree.add(kind, f"{kind} {len(made)}", parent, {**mine, "fb_cfHz": share}))
            else:
                for above in self._processors[parent]:
                    made.append(self._tree.add(kind, above.name.replace(parent, kind), above.name, mine))
            for branch, processor in enumerate(made):
                self._listener.branches[processor] = branch
                processor.has_consumers = kind in self._outputs
                if kind in over:
                    processor.output_buffer_for = _taken

    def schedule(self, block: int, name: str, value: Any) -> None:
        """Change a (checked) parameter before block `block`; the blocks of successive calls ascend. Or ValueError."""
        with _as_value_error():
            self._tree.schedule(block, name, value)
        self._remember(block)

    def _remember(self, block: int) -> None:
        self._derived[block] = {k: v for p, *_ in self._processors.values() for k, v in p.derived().items()}

    def set_output_allocator(self, kind: str, branch: int, place: Callable[[int], np.ndarray | None]) -> None:
        """Let the stage of a `kind` that nothing hangs on write where `place` says for so many frames, if it can.

        Stages that return frames, and those that do not take `out`, cannot, and are not asked.
        """
        processor = self._processors[kind][branch]
        if (
            processor.stage.TAKES_OUT and not processor.signal.framed and not processor.children
        ):  # children take blocks in one piece
            processor.output_buffer_for = lambda taken: place(taken.data.shape[-1])

    def observe(self, observer: Observer) -> None:
        """Tell `observer` of every state that a processor enters."""
        self._tree.observe(observer)

    def run(self, together: bool = False) -> None:
        """Let the signal flow and wait for its end; raises what the first processor failed with.

        Small blocks may go through `together`, where that cannot be seen in the numbers.
        """
        self._source.start(self._most_together() if together else 0)
        for processor in self._all():
            processor.join()
        if self._listener.error is not None:
            raise self._listener.error

    def close(self) -> None:
        """End the run, if it is not over, and all threads."""
        self._tree.stop()
        self._tree.join()

    def __enter__(self) -> Chain:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- what it is ---

    def _all(self) -> list[Processor]:
        return list(itertools.chain(*self._processors.values()))

    def shapes(self, kind: str, frames: int) -> dict[str, list[tuple[int, ...]]]:
        """Shape of each part of an output, in each branch, for so many frames if no parameter changes on the way."""
        processors = self._processors[kind]
        count = self._count(processors[0], frames)
        branches = zip(*(processor.output_shapes for processor in processors), strict=True)
        return {
            name: [(*rows, count) for rows in of_part]
            for name, of_part in zip(KINDS[kind].outputs, branches, strict=True)
        }

    def _count(self, processor: Processor, frames: int) -> int:
        """How many frames it puts out for so many of the signal."""
        return processor.stage.output_count(
            frames if processor.parent is None else self._count(processor.parent, frames)
        )

    def times(self, kind: str, frames: int) -> np.ndarray:
        """The middle of each frame of an output (s), for a signal of so many frames."""
        processor = self._processors[kind][0]
        return frame_times(processor.signal, 0, self._count(processor, frames))

    def largest_block(self, frames: int) -> tuple[str, int]:
        """Which processor puts out most for one block of so many frames, and how many bytes that can be."""
        seconds = frames / self.sample_rate
        taken = {p: sizes.output_size(p.stage, p.input_shape, seconds) for p in self._all()}
        largest = max(taken, key=lambda processor: taken[processor])
        return largest.kind, int(taken[largest])

    def _most_together(self) -> int:
        """Frames of the largest block that may come in the place of smaller ones; 0 where that could be seen.

        It cannot where kernels run: with them, blocks leave no trace in the numbers, not in the last bits either. With
        numpy and scipy, and in plugins, they may; and changes are made before blocks as they are.
        """
        processors = self._all()
        changed = len(self._derived) > 1
        seen = not kernels.compiled() or any(p.kind not in BUILTIN or p.stage.block_size_dependent for p in processors)
        if changed or seen:
            return 0
        frame = max(sizes.output_size(p.stage, p.input_shape, 1 / self.sample_rate) for p in processors)
        return min(MAX_FRAMES, int(MAX_BYTES / frame))

    def describe(self) -> dict[str, Any]:
        """Axes of what runs, `fb_cfHz` (Hz), `cc_lags` (s); rates of the outputs, `ild_frameRate` and its like (Hz).

        Rates and what is a parameter are told as they are at last, what follows from parameters as where it is longest.
        """
        described: dict[str, Any] = {}
        for kind, (processor, *others) in self._processors.items():
            parameters = processor.parameters()
            for name in processor.representation.coordinates:
                values = (
                    parameters[name] if name in parameters else max((d[name] for d in self._derived.values()), key=len)
                )
                if kind == FILTERBANK:  # its channels
                    values = list(itertools.chain(values, *(other.parameters()[name] for other in others)))
                words = any(isinstance(value, str) for value in values)
                described[name] = list(values) if words else np.array(values, np.float64)
            if processor.signal.framed and kind in self._outputs:
                described[f"{kind}_frameRate"] = processor.rate
        return described


def needed(outputs: Iterable[str]) -> list[str]:
    """The kinds of processors to run for `outputs`, parents first."""
    wanted = {kind.kind for kind in KINDS.values() if not kind.parent}
    for kind in outputs:
        while kind:
            wanted.add(kind)
            kind = KINDS[kind].parent
    return [kind for kind in KINDS if kind in wanted]


def in_place_kinds(kinds: Collection[str], outputs: Collection[str]) -> list[str]:
    """Of all `kinds` that run, those that may write over the blocks that they take, which nobody else wants.

    Kernels do; numpy does not, and plugins must not.
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
    """`frequencies` in up to `count` parts, of as many as a kernel takes together, but for the last one."""
    groups = -(-len(frequencies) // kernels.MAX_LANES)
    count = min(count, groups)
    ends = [kernels.MAX_LANES * (groups * number // count) for number in range(count + 1)]
    return [list(frequencies[first:end]) for first, end in itertools.pairwise(ends)]


def _taken(block: Block) -> np.ndarray:
    return block.data


@contextmanager
def _as_value_error() -> Iterator[None]:
    """Make ValueError of the interface's named exceptions."""
    try:
        yield
    except ComponentError as problem:
        raise ValueError(str(problem)) from None
