"""The state machine of a processor, and the tokens it exchanges with parent and children. It contains no threads.

    waitExec --begin_work--> exec --finish_block--> waitRelease --no child holds the last block--> release
    release --end_work--> waitExec

A parent releases a block only if no child holds a token of the previous one. Each child then gets a token, reads the
block from the parent's memory, and returns the token when it is finished.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from typing import Any

from rosafe.dsp.signal_format import SignalFormat
from rosafe.tree.block import Block


class State(enum.Enum):
    """The four states of the user guide (figure 11) and two final states."""

    WAIT_EXEC = "waitExec"
    EXEC = "exec"
    WAIT_RELEASE = "waitRelease"
    RELEASE = "release"
    DONE = "done"  # its input has ended
    REMOVED = "removed"


# Enumerations are slow to look up.
WAIT_EXEC, EXEC, WAIT_RELEASE, RELEASE = State.WAIT_EXEC, State.EXEC, State.WAIT_RELEASE, State.RELEASE
DONE, REMOVED = FINAL_STATES = (State.DONE, State.REMOVED)

NO_BLOCK = Block(0, (), 0, SignalFormat.sound(1.0))  # stands for an unpublished block without consumers


class StateMachine:
    """States and tokens of one processor. All methods are called with the tree's lock held.

    Attributes
    ----------
    depth : int
        Number of ancestors.
    busy : bool
        Whether a worker works on it, from `begin_work` to `end_work`.
    input_pending : bool
        Only for the input: whether there may be sound to read.
    current_block : Block or None
        The block that the worker processes.
    has_consumers : bool
        Whether the last block is retained: it is published, and a new child starts from it. If False, its memory is
        reused as soon as the children are finished, while it is still in the cache.
    last_block : Block or None
        The block released last, from which a new child starts. None without consumers.
    unpublished_block : Block or None
        The block released last, until it is published; `NO_BLOCK` without consumers.
    observers : sequence of callable
        Called with the processor, its new state, and the number of the current block or None. They must not block.
    """

    observers: Sequence[Callable[[Any, State, int | None], None]] = ()
    skipped = False  # set on an instance only during the call in which `skip` was called

    def __init__(self, parent: StateMachine | None) -> None:
        self.parent = parent
        self.children: list[StateMachine] = []
        self.depth: int = 0 if parent is None else parent.depth + 1
        self.state = WAIT_EXEC
        self.busy = self.input_pending = False
        self.current_block: Block | None = None
        self.has_consumers = True
        self.last_block: Block | None = None
        self.unpublished_block: Block | None = None
        self._pending_block: Block | None = None  # computed; is released when no child holds the previous one
        self._next_block: Block | None = None  # the parent's block that this one has not begun yet
        self._block_owner: StateMachine | None = None  # whose block it holds; the input may be replaced meanwhile
        self._readers: set[StateMachine] = set()  # children that still hold the last block

    # --- hooks of a processor ---

    def on_ready(self) -> None:
        """Called when it becomes ready."""

    def on_finished(self) -> None:
        """Called when it is `finished`."""

    # --- attach, remove, end ---

    def attach(self) -> None:
        """Become a child of its parent, starting from the parent's last block if there is one."""
        if self.parent is None:
            return
        self.parent.children.append(self)
        if self.parent.last_block is not None:
            self.parent._offer(self, self.parent.last_block)
        self._end_if_exhausted()

    def notify_input(self) -> None:
        """Note that there may be sound to read."""
        self.input_pending = True
        if self.ready:
            self.on_ready()

    def move(self, parent: StateMachine) -> None:
        """Become a child of another parent, which has released nothing yet. A block that was not begun is dropped."""
        self._detach()
        self.parent, self._next_block = parent, None
        parent.children.append(self)

    def remove(self) -> None:
        """Remove it immediately: the parent no longer waits for it, and it releases no further block."""
        self._set_state(REMOVED)
        self.last_block = self._pending_block = self._next_block = None
        self._detach()
        if not self.busy:
            self.on_finished()

    def end_of_stream(self) -> None:
        """Mark the stream as ended. Children may still take the last released block."""
        self.release_input()
        self._set_state(DONE)
        if self.parent is not None and self._next_block is not None:  # it has failed
            self._next_block = None
            self.parent._reader_done(self)
        for child in self.children:
            child._end_if_exhausted()
        if not self.busy:
            self.on_finished()

    def _detach(self) -> None:
        if self.parent is not None and self in self.parent.children:
            self.parent.children.remove(self)
            self.parent._reader_done(self)

    def _end_if_exhausted(self) -> None:
        if self.parent is None or self.parent.state is not DONE or self._next_block is not None:
            return
        if not self.busy and self.state is WAIT_EXEC:
            self.end_of_stream()

    @property
    def removed(self) -> bool:
        """Return whether it was removed."""
        return self.state is REMOVED

    @property
    def waits(self) -> bool:
        """Return whether it has processed and released all blocks that it was offered."""
        return self.state is WAIT_EXEC and self._next_block is None

    @property
    def finished(self) -> bool:
        """Return whether no worker works on it, now or later."""
        return self.state in FINAL_STATES and not self.busy

    # --- the four states ---

    @property
    def ready(self) -> bool:
        """Return whether there is a block to process or to publish."""
        if self.busy:
            return False
        state = self.state
        return self._next_block is not None or self.input_pending if state is WAIT_EXEC else state is RELEASE

    def begin_work(self) -> bool:
        """Begin to work on the next block, or to publish the last one. Return False if there is nothing to do."""
        if self.busy:
            return False
        state = self.state
        if state is WAIT_EXEC:
            block = self._next_block
            if block is None:
                if not self.input_pending:
                    return False
                self.input_pending = False
            else:
                self._next_block = None
                self._block_owner = self.parent
                self.state = EXEC
                if self.observers:
                    self._tell_observers(block.number)
            self.current_block = block
        elif state is not RELEASE:
            return False
        self.busy = True
        return True

    def accept_input_block(self, block: Block, more: bool = True) -> None:
        """Process a block that the input has read. `more` is False if the source will notify of the next one."""
        if more:
            self.input_pending = True
        self.current_block = block
        self._set_state(EXEC, block.number)

    def finish_block(self, computed: Block | None) -> None:
        """Accept the block `computed`, if any. It is released when no child holds the previous one."""
        if self.skipped:
            del self.skipped
        self.release_input()
        if computed is not None and self.state is not REMOVED:
            self.state = WAIT_RELEASE
            if self.observers:
                self._tell_observers(computed.number)
            if self._readers:
                self._pending_block = computed
            else:
                self._release(computed)

    def skip(self) -> None:
        """Return the parent's block during a long computation: siblings continue, this processor misses blocks."""
        self.skipped = True
        self.release_input()

    def release_input(self) -> None:
        """Return the parent's block, so that the parent can release the next one."""
        reading = self._block_owner
        if reading is not None:
            self._block_owner = None
            reading._reader_done(self)

    def end_work(self) -> None:
        """End the work on it; it may be ready again."""
        self.busy, self.current_block = False, None
        state = self.state
        if state is EXEC or (state is RELEASE and self.unpublished_block is None):
            self.state = WAIT_EXEC
            if self.observers:
                self._tell_observers(None)
            if self._next_block is not None or self.input_pending:
                self.on_ready()
            elif self.parent is not None and self.parent.state is DONE:
                self._end_if_exhausted()
        elif state in FINAL_STATES:
            self.on_finished()
        elif self.ready:
            self.on_ready()

    def _reader_done(self, child: StateMachine) -> None:
        self._readers.discard(child)
        if not self._readers and self.state is WAIT_RELEASE:
            block, self._pending_block = self._pending_block, None
            assert block is not None
            self._release(block)

    def _release(self, block: Block) -> None:
        """Release a block when no child holds the previous one; usually called by the child that returned it last."""
        self.state = RELEASE
        if self.observers:
            self._tell_observers(block.number)
        self.last_block, self.unpublished_block = (block, block) if self.has_consumers else (None, NO_BLOCK)
        for child in self.children:
            if child.state is not DONE and not child.skipped:
                self._offer(child, block)
        if not self.busy:
            self.on_ready()

    def _offer(self, child: StateMachine, block: Block) -> None:
        self._readers.add(child)
        child._next_block = block
        if child.state is WAIT_EXEC and not child.busy:
            child.on_ready()

    def _set_state(self, state: State, number: int | None = None) -> None:
        if self.state is not REMOVED:
            self.state = state
            self._tell_observers(number)

    def _tell_observers(self, number: int | None) -> None:
        for observer in self.observers:
            observer(self, self.state, number)
