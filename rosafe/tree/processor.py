"""A processor of the tree: a task with the states waitExec, exec, waitRelease and release for each block."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from time import monotonic
from typing import TypeVar

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.plugin_checks import PluginError
from rosafe.dsp.stage import Stage
from rosafe.tree.block import Block, Source
from rosafe.tree.context import TreeContext
from rosafe.tree.member import Member
from rosafe.tree.states import State
from rosafe.tree.workers import WAKE_THRESHOLD_SECONDS

T = TypeVar("T")
NOTHING: frozenset[str] = frozenset()
ESTIMATE_GROWTH = 2.0  # the estimate is the recent minimum; it may grow by this factor per block


class Processor(Member):
    """A node of the tree, created and connected by `Tree`. The public members may be used from any thread.

    Locks are acquired in this order: tree's requests, `_publish_lock`, then the tree's or those of updates and history.

    Parameters
    ----------
    name, stage, parent, history_seconds
        As in `Member`.
    context : TreeContext
        Shared by all processors of the tree.
    source : Source or None
        The source of the input's blocks.

    Attributes
    ----------
    output_buffer_for : callable or None
        Called with the input block; returns the argument `out` of `Stage.process`, for stages that have one.
    """

    parent: Processor | None
    children: list[Processor]  # type: ignore[assignment]  # state machines, all of which are processors

    def __init__(
        self,
        name: str,
        stage: Stage,
        parent: Processor | None,
        history_seconds: float,
        context: TreeContext,
        source: Source | None = None,
    ) -> None:
        super().__init__(name, stage, parent, history_seconds)
        # At most 30 attributes, with those of `Member` and `StateMachine`: with more, each access takes longer.
        self.observers = context.observers
        self.blocked_since = 0.0
        self.estimated_seconds = math.inf
        self.output_buffer_for: Callable[[Block], FloatArray | None] | None = None
        self._context = context
        self._lock = context.workers.lock
        self._source = source
        self._started = False
        self._publish_seconds = 0.0  # duration of the last call of the listener
        self._publish_lock = threading.Lock()  # `on_released` and `on_removed` exclude each other

    # --- life ---

    def start(self) -> None:
        """Start to work, with the block that the parent released last."""
        with self._lock:
            self._context.workers.add_client()  # raises before anything is attached if no thread can be started
            self._started = True
            self.attach()
            self._context.workers.wake()
        if self._source is not None:
            self._source.open(self._wake)
            self._wake()

    def _wake(self) -> None:
        """Check whether the source has a block."""
        with self._lock:
            self.notify_input()
            self._context.workers.wake()

    def end(self) -> None:
        """Remove the processor immediately. The result of a computation still in progress is discarded."""
        with self._lock:
            self.remove()
            if self._started:
                self._context.workers.remove_client()
            self._context.workers.wake()
        if self._source is not None:
            self._source.stop()
        with self._publish_lock:
            self._context.listener.on_removed(self)

    def join(self, timeout: float | None = None) -> bool:
        """Wait until it is finished. Return False after `timeout` seconds."""
        with self._lock:
            return bool(self._context.finished_condition.wait_for(lambda: self.finished, timeout))

    def ask(self, question: Callable[[Processor], T]) -> T | None:
        """Return `question(self)`, or None if its plugin raises; the processor has failed in this case."""
        try:
            return question(self)
        except PluginError as problem:
            self.error = problem
            self._context.on_failure(self)
            return None

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
            if self._source is not None:
                self._read(self._source)
            if self.current_block is not None:
                self._compute(self.current_block)
        except BaseException as problem:  # any failure must reach the tree, and no other processor may keep waiting
            self.error = problem
            with self._lock:
                self.end_of_stream()
            self.blocked_since = monotonic()  # requests may block the callback
            self._context.on_failure(self)
            self.blocked_since = 0.0

    def _read(self, source: Source) -> None:
        """Read the next block of the source if there is one, or end with the source."""
        self.blocked_since = monotonic()
        while True:
            ended = source.ended  # read first: blocks that arrived before the end are still processed
            got = source.read()
            if got is not None or ended == source.ended:
                break
        self.blocked_since = 0.0
        with self._lock:
            if got is not None:
                self.accept_input_block(Block(self.blocks, (got[0],), got[1], self.stage.input_format))
            elif ended:
                self.end_of_stream()

    def _compute(self, taken: Block) -> None:
        begun = monotonic()
        private = self._process(taken)
        ended = monotonic()
        seconds = ended - begun
        self.blocks += 1
        limit = ESTIMATE_GROWTH * self.estimated_seconds
        self.estimated_seconds = seconds if seconds < limit else limit
        with self._lock:
            self.finish_block(private)
        self._context.listener.on_executed(self, seconds)
        # A slow listener is called later, when no deeper processor is ready.
        if self.unpublished_block is not None and self._publish_seconds < WAKE_THRESHOLD_SECONDS:
            self._publish(self.unpublished_block, ended)

    def _process(self, taken: Block) -> Block | None:
        """Compute the output for a block. Return None if no stage accepts it."""
        stage = self.changes.stage_for_block(taken)
        if stage is None:
            return None
        if stage.EXTRAS:
            stage.provide = self._requested_extras(stage, taken.number)
        data, extras = taken.parts[0], taken.extras
        required = extras and stage.required_extra
        if self.output_buffer_for is not None:
            output = stage.process(data, extras[required] if required else None, self.output_buffer_for(taken))
        else:
            output = stage.process(data, extras[required]) if required else stage.process(data)
        parts = output if isinstance(output, tuple) else (output,)
        next_index = taken.next_index
        if look_ahead := stage.look_ahead:
            next_index = max(0, next_index - look_ahead * stage.input_format.hop)
        return Block(taken.number, parts, next_index, stage.output_format, stage.provided)

    def _requested_extras(self, stage: Stage, number: int) -> frozenset[str]:
        """Return the extras that children need of block `number`."""
        wanted = [needs for child in tuple(self.children) if (needs := child.changes.needs(number))]
        return frozenset(stage.EXTRAS).intersection(wanted) if wanted else NOTHING

    def _publish(self, block: Block, begun: float) -> None:
        """Add the last released block to the history and notify the listener."""
        self.unpublished_block = None
        if not self.has_consumers:
            return
        self.blocked_since = begun
        with self._publish_lock:
            if self.state is not State.REMOVED:
                self.history.append(block)
                self._context.listener.on_released(self, block)
        self.blocked_since = 0.0
        self._publish_seconds = monotonic() - begun


def subtree(processor: Processor) -> Iterator[Processor]:
    """Yield `processor` and its descendants, leaves first."""
    for child in list(processor.children):
        yield from subtree(child)
    yield processor
