"""What a processor is at, and the tokens that it exchanges with its parent and its children. No threads in here.

    waitExec --begin--> exec --done--> waitRelease --once no child holds the last block--> release --rest--> waitExec

A parent releases a block only while nobody holds a token of its last one; every child then gets a token of its own,
takes the block with it, and gives it back when done. Children read the parent's memory.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from typing import Any

from rosafe.dsp.signal_format import SignalFormat
from rosafe.tree.block import Block


class State(enum.Enum):
    """The four states of the user guide (figure 11), and the two ends."""

    WAIT_EXEC = "waitExec"
    EXEC = "exec"
    WAIT_RELEASE = "waitRelease"
    RELEASE = "release"
    DONE = "done"  # its input has come to its end
    REMOVED = "removed"


# Enumerations are slow to look up.
WAIT_EXEC, EXEC, WAIT_RELEASE, RELEASE = State.WAIT_EXEC, State.EXEC, State.WAIT_RELEASE, State.RELEASE
DONE, REMOVED = FINAL_STATES = (State.DONE, State.REMOVED)

NO_BLOCK = Block(0, (), 0, SignalFormat.sound(1.0))  # to be told of a block that nobody hears of


class StateMachine:
    """States and tokens of one processor. All is done with the tree's lock held.

    Attributes
    ----------
    depth : int
        How many there are above it.
    at_work : bool
        A worker is at it, from `begin_work` to `end_work`.
    called : bool
        Of the input: there may be sound to read.
    taken : Block or None
        What the worker has to work on.
    heard : bool
        Somebody may want the last block later: the world is told of it, and a new child begins with it. Else its memory
        is free, and still in the cache, as soon as the children have done with it.
    shared : Block or None
        Released last; a new child begins with it. None where it is not `has_consumers`.
    untold : Block or None
        Released last, until the world has been told of it; `NO_BLOCK` where it is not `has_consumers`.
    observers : sequence of callable
        Get the processor, the state that it enters, and the number of the block at hand, or None. No waiting.
    """

    observers: Sequence[Callable[[Any, State, int | None], None]] = ()
    skipped = False  # an instance has it only during the call that `skip` was made in

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
        self._pending_block: Block | None = None  # computed, and to be released as soon as no child holds the last one
        self._next_block: Block | None = None  # the parent's, not taken yet
        self._block_owner: StateMachine | None = None  # whose block it holds: the input may be replaced meanwhile
        self._readers: set[StateMachine] = set()  # children that have not given the last block back

    # --- what a processor adds ---

    def on_ready(self) -> None:
        """It has become ready."""

    def on_finished(self) -> None:
        """It is `finished`."""

    # --- coming and going ---

    def attach(self) -> None:
        """Become a child of its parent, and begin with the block that this has released last, if there is one."""
        if self.parent is None:
            return
        self.parent.children.append(self)
        if self.parent.last_block is not None:
            self.parent._offer(self, self.parent.last_block)
        self._end_if_exhausted()

    def notify_input(self) -> None:
        """There may be sound to read."""
        self.input_pending = True
        if self.ready:
            self.on_ready()

    def move(self, parent: StateMachine) -> None:
        """Become a child of another parent, which has released nothing yet; a block that was not taken is dropped."""
        self._detach()
        self.parent, self._next_block = parent, None
        parent.children.append(self)

    def remove(self) -> None:
        """Gone at once: its parent waits for it no longer, and it will release nothing more."""
        self._set_state(REMOVED)
        self.last_block = self._pending_block = self._next_block = None
        self._detach()
        if not self.busy:
            self.on_finished()

    def end_of_stream(self) -> None:
        """Nothing more will come of it; children may still take the block released last."""
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
        """Whether it was removed."""
        return self.state is REMOVED

    @property
    def finished(self) -> bool:
        """Whether nobody works on it and nobody ever will."""
        return self.state in FINAL_STATES and not self.busy

    # --- the four states ---

    @property
    def ready(self) -> bool:
        """Whether there is something to do: a block to take, or one to tell of."""
        if self.busy:
            return False
        state = self.state
        return self._next_block is not None or self.input_pending if state is WAIT_EXEC else state is RELEASE

    def begin_work(self) -> bool:
        """Somebody works on it from now on, and takes the block that waits for it, if there is one.

        False where there is nothing to do.
        """
        if self.busy:
            return False
        state = self.state
        if state is WAIT_EXEC:
            taken = self._next_block
            if taken is None:
                if not self.input_pending:
                    return False
                self.input_pending = False
            else:
                self._next_block = None
                self._block_owner = self.parent
                self.state = EXEC
                if self.observers:
                    self._tell_observers(taken.number)
            self.current_block = taken
        elif state is not RELEASE:
            return False
        self.busy = True
        return True

    def accept_input_block(self, block: Block) -> None:
        """The input has read a block."""
        self.input_pending = True  # perhaps there is more
        self.current_block = block
        self._set_state(EXEC, block.number)

    def finish_block(self, private: Block | None) -> None:
        """It has computed `private`, or nothing: that is released at once or as soon as no child holds the last one."""
        if self.skipped:
            del self.skipped
        self.release_input()
        if private is not None and self.state is not REMOVED:
            self.state = WAIT_RELEASE
            if self.observers:
                self._tell_observers(private.number)
            if self._readers:
                self._pending_block = private
            else:
                self._release(private)

    def skip(self) -> None:
        """Release the parent's block during a long computation: siblings continue, this one misses blocks meanwhile."""
        self.skipped = True
        self.release_input()

    def release_input(self) -> None:
        """Return the parent's block, which may release its next one then."""
        reading = self._block_owner
        if reading is not None:
            self._block_owner = None
            reading._reader_done(self)

    def end_work(self) -> None:
        """Nobody works on it any more."""
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
        """Called, while no child holds a block, by whoever has made that possible, which is mostly a child."""
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
