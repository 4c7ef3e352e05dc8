"""A processor of the tree: a task with the states waitExec, exec, waitRelease and release for each block."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from time import monotonic, thread_time
from typing import Any, Protocol, TypeVar

from rosafe.declarations.representation import Representation
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.plugin_checks import CheckedStage, PluginError
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage
from rosafe.tree.block import Block, Source, new_block
from rosafe.tree.history import History
from rosafe.tree.parameter_updates import ParameterUpdates
from rosafe.tree.states import NO_BLOCK, State, StateMachine
from rosafe.tree.workers import Workers

T = TypeVar("T")
_NO_EXTRAS: frozenset[str] = frozenset()
SLOW_LISTENER_SECONDS = 2.5e-4  # a listener that takes longer is called in a turn of its own
ESTIMATE_GROWTH = 2.0  # the estimate is the recent minimum; it may grow by this factor per block


class TreeListener(Protocol):
    """Callbacks for processor events. They run on worker threads and must not block on the tree."""

    def on_added(self, processor: Processor) -> None:
        """A processor is about to start and has released nothing yet. If this raises, it is removed again."""

    def on_executed(self, processor: Processor, seconds: float) -> None:
        """One block was computed in `seconds`. The call for the last block may follow `on_removed`."""

    def on_released(self, processor: Processor, block: Block) -> None:
        """A processor with consumers released a block. One worker calls at a time, and never after `on_removed`."""

    def on_removed(self, processor: Processor) -> None:
        """The processor was removed; `processor.error` is the reason if it failed."""


# Called with (processor, new state, number of the current block or None), under the tree's lock: must not block.
Observer = Callable[["Processor", State, "int | None"], None]


@dataclass(frozen=True)
class TreeContext:
    """The context that all processors of a tree share.

    The worker calls `on_failure` after it has set the `error` of a processor.
    """

    workers: Workers
    listener: TreeListener
    on_failure: Callable[[Processor], None]
    finished_condition: threading.Condition  # on the tree's lock: notified when a processor is finished
    observers: list[Observer] = field(default_factory=list)


class Processor(StateMachine):
    """A node of the tree, created and connected by `Tree`. The public members may be used from any thread.

    Locks are acquired in this order: tree's requests, `_publish_lock`, then the tree's or those of updates and history.

    Parameters
    ----------
    name : str
        The name given by the user.
    stage : Stage
        The computation.
    parent : Processor or None
        None for the input.
    history_seconds, port_seconds : float
        Length of the history of its output for readers and for its output port.
    context : TreeContext
        Shared by all processors of the tree.
    source : Source or None
        The source of the input's blocks.

    Attributes
    ----------
    trusted : bool
        Whether its stage is not a plugin, which may not return.
    awaited : bool
        Whether each frame of its output is needed as soon as it is complete, for example by a subscriber.
    error : BaseException or None
        The reason for its failure.
    blocks : int
        Number of blocks processed.
    output_buffer_for : callable or None
        Called with the input block; returns the argument `out` of `Stage.process`, for stages that have one.
    """

    parent: Processor | None
    children: list[Processor]  # type: ignore[assignment]  # state machines, all of which are processors
    awaited = True

    def __init__(
        self,
        name: str,
        stage: Stage,
        parent: Processor | None,
        history_seconds: float,
        port_seconds: float,
        context: TreeContext,
        source: Source | None = None,
    ) -> None:
        super().__init__(parent)
        # At most 30 attributes, with those of `StateMachine`: with more, each access takes longer.
        self.observers = context.observers
        self.name = name
        self.trusted = not isinstance(stage, CheckedStage)
        self.error: BaseException | None = None
        self.blocks = 0
        self.changes = ParameterUpdates(stage)
        self.history = History(self.output_shapes, stage.output_format, history_seconds, port_seconds)
        self.blocked_since = 0.0
        self.estimated_seconds = math.inf
        self.output_buffer_for: Callable[[Block], FloatArray | None] | None = None
        self._context = context
        self._source_reader = None if source is None else SourceReader(self, source, context.workers)
        self._publish_seconds = 0.0  # duration of the last call of the listener
        self._publish_lock = threading.Lock()  # `on_released` and `on_removed` exclude each other

    def __repr__(self) -> str:
        return f"<{self.kind} {self.name!r} {self.state.value}>"

    # --- properties ---

    @property
    def stage(self) -> Stage:
        """The stage after all pending parameter updates, for queries only."""
        return self.changes.final_stage

    @property
    def representation(self) -> Representation:
        """The declaration of its representation."""
        return self.stage.REPRESENTATION

    @property
    def kind(self) -> str:
        """The kind of its representation."""
        return self.stage.REPRESENTATION.kind

    @property
    def input_shape(self) -> tuple[int, ...]:
        """Leading shape of its input."""
        return (self.stage.input_format.ears,) if self.parent is None else self.parent.output_shape

    @property
    def output_shapes(self) -> tuple[tuple[int, ...], ...]:
        """Leading shape of each part of its output, such as (2, channels)."""
        return self.stage.part_rows(self.input_shape)

    @property
    def output_shape(self) -> tuple[int, ...]:
        """Leading shape of the first part, which is the input of its children."""
        return self.stage.output_rows(self.input_shape)

    @property
    def signal(self) -> SignalFormat:
        """The format of its output."""
        return self.stage.output_format

    @property
    def rate(self) -> float:
        """Frames of output per second."""
        return self.signal.rate

    @property
    def next_index(self) -> int:
        """Index of the audio frame after the newest one that its output depends on."""
        return self.history.next_index

    def values(self) -> dict[str, Any]:
        """Return parameters, in the order of the parameter structure, and derived values of the same moment."""
        stage = self.stage
        return {**stage.parameters, **stage.derived}

    # --- life ---

    def start(self) -> None:
        """Start to work, with the block that the parent released last."""
        workers = self._context.workers
        with workers.lock:
            workers.add_client(self)  # raises before anything is attached if no thread can be started
            self.attach()
            workers.wake()
        if self._source_reader is not None:
            self._source_reader.start()

    def check_source(self) -> None:
        """Read if its source has a block for which it did not call."""
        reader = self._source_reader
        if reader is not None:
            reader.check()

    def end(self) -> None:
        """Remove the processor immediately. The result of a computation still in progress is discarded."""
        workers = self._context.workers
        with workers.lock:
            self.remove()
            workers.remove_client(self)
            workers.wake()
        reader, self._source_reader = self._source_reader, None  # which refers to this processor
        if reader is not None:
            reader.stop()
        with self._publish_lock:
            self._context.listener.on_removed(self)

    def join(self, timeout: float | None = None) -> bool:
        """Wait until it is finished. Return False after `timeout` seconds."""
        with self._context.workers.lock:
            return bool(self._context.finished_condition.wait_for(lambda: self.finished, timeout))

    def ask(self, question: Callable[[Processor], T]) -> T | None:
        """Return `question(self)`, or None if its plugin raises; the processor has failed in this case."""
        try:
            return question(self)
        except PluginError as problem:
            self.error = problem
            self._context.on_failure(self)
            return None

    def required_input(self) -> float:
        """Return a number of input frames before which no awaited frame can be complete, of this processor or below.

        It is infinite if no output is awaited, and 0 while a block is on its way to such an output. To be called with
        the tree's lock held.
        """
        frames = min([child.required_input() for child in self.children] + [1 if self.awaited else math.inf])
        if not 0 < frames < math.inf:
            return frames
        return self.changes.required_input(int(frames)) if self.waits else 0

    def on_ready(self) -> None:
        self._context.workers.push(self)

    def on_finished(self) -> None:
        self._context.finished_condition.notify_all()

    # --- called by workers ---

    def work(self) -> None:
        """Publish the last block, or compute the next one."""
        try:
            if self.unpublished_block is not None:
                self._publish(self.unpublished_block, monotonic())
                return
            reader = self._source_reader
            if reader is not None:
                reader.read()
            if self.current_block is not None:
                self._compute(self.current_block)
        except BaseException as problem:  # any failure must reach the tree, and no other processor may keep waiting
            self.error = problem
            with self._context.workers.lock:
                self.end_of_stream()
            self.blocked_since = monotonic()  # requests may block the callback
            self._context.on_failure(self)
            self.blocked_since = 0.0

    def _compute(self, block: Block) -> None:
        begun, used = monotonic(), thread_time()
        output_block = self._process(block)
        ended, used = monotonic(), thread_time() - used
        seconds = ended - begun
        self.blocks += 1
        # A task that waits for the interpreter's lock is not long. A plugin may wait for anything.
        needed = used if self.trusted else seconds
        limit = ESTIMATE_GROWTH * self.estimated_seconds
        self.estimated_seconds = needed if needed < limit else limit
        with self._context.workers.lock:
            self.finish_block(output_block)
        self._context.listener.on_executed(self, seconds)
        # A slow listener is called later, when no deeper processor is ready.
        if self.unpublished_block is not None and self._publish_seconds < SLOW_LISTENER_SECONDS:
            self._publish(self.unpublished_block, ended)

    def _process(self, block: Block) -> Block | None:
        """Compute the output for a block. Return None if no stage accepts it."""
        stage = self.changes.stage_for_block(block)
        if stage is None:
            return None
        if stage.EXTRAS:
            stage.provide = _requested_extras(stage, self.children, block.number)
        data, extras = block.parts[0], block.extras
        required = stage.required_extra if extras else ""
        if self.output_buffer_for is not None:
            output = stage.process(data, extras[required] if required else None, self.output_buffer_for(block))
        else:
            output = stage.process(data, extras[required]) if required else stage.process(data)
        parts = output if isinstance(output, tuple) else (output,)
        next_index = block.next_index
        if look_ahead := self.changes.look_ahead:
            next_index = max(0, next_index - look_ahead * stage.input_format.hop)
        return new_block((block.number, parts, next_index, stage.output_format, stage.provided))

    def _publish(self, block: Block, begun: float) -> None:
        """Add the last released block to the history and notify the listener."""
        self.unpublished_block = None
        if block is NO_BLOCK:  # `has_consumers` may have been set since the release
            return
        self.blocked_since = begun
        with self._publish_lock:
            if self.state is not State.REMOVED:
                self.history.append(block)
                self._context.listener.on_released(self, block)
        self.blocked_since = 0.0
        self._publish_seconds = monotonic() - begun


class SourceReader:
    """Reads the blocks of `source` for the input `processor`, whose tasks `workers` run."""

    def __init__(self, processor: Processor, source: Source, workers: Workers) -> None:
        self._processor = processor
        self._source = source
        self._workers = workers
        self._frames = 0  # that the processor has accepted in total
        self.stop = source.stop

    def start(self) -> None:
        """Begin to read."""
        self._source.open(self._wake, self._required_frames)
        self._notify_workers()

    def check(self) -> None:
        """Read if the source has a block for which it did not call `wake`."""
        if not self._source.waiting:
            self._notify_workers()

    def read(self) -> None:
        """Read the next block of the source if there is one, or end with the source."""
        processor, source = self._processor, self._source
        processor.blocked_since = monotonic()
        while True:
            ended = source.ended  # read first: blocks that arrived before the end are still processed
            got = source.read()
            if got is not None or ended == source.ended:
                break
        more = not source.waiting
        processor.blocked_since = 0.0
        with self._workers.lock:
            if got is not None:
                block = Block(processor.blocks, (got[0],), got[1], processor.stage.input_format)
                processor.accept_input_block(block, more)
                self._frames += got[0].shape[-1]
            elif ended:
                processor.end_of_stream()

    def _required_frames(self) -> float:
        """Return the argument of `Source.open`. Observers are to see each block."""
        with self._workers.lock:
            return 0 if self._processor.observers else self._frames + self._processor.required_input()

    def _wake(self) -> None:
        """Run short tasks on the thread of the source. Observers show the worker of each task, and need workers."""
        if self._processor.observers:
            self._notify_workers()
            return
        with self._workers.lock:
            self._processor.notify_input()
            self._workers.run_short_tasks()

    def _notify_workers(self) -> None:
        with self._workers.lock:
            self._processor.notify_input()
            self._workers.wake()


def _requested_extras(stage: Stage, children: Sequence[Processor], number: int) -> frozenset[str]:
    """Return the extras of `stage` that children need of block `number`."""
    requested = [needs for child in tuple(children) if (needs := child.changes.needs(number))]
    return frozenset(stage.EXTRAS).intersection(requested) if requested else _NO_EXTRAS


def subtree(processor: Processor) -> Iterator[Processor]:
    """Yield `processor` and its descendants, leaves first."""
    for child in list(processor.children):
        yield from subtree(child)
    yield processor
