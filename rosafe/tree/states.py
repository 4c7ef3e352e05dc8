"""What a processor is at, and the tokens that it exchanges with its parent and its children. No threads in here.

    waitExec --begin--> exec --done--> waitRelease --once no child holds the last block--> release --rest--> waitExec

A parent releases a block only while nobody holds a token of its last one; every child then gets a token of its own,
takes the block with it, and gives it back when done. Children read the parent's memory.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from typing import Any

from rosafe.dsp.signal import Signal
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
DONE, REMOVED = ENDS = (State.DONE, State.REMOVED)

NOTHING = Block(0, (), 0, Signal.sound(1.0))  # to be told of a block that nobody hears of


class StateMachine:
    """States and tokens of one processor. All is done with the tree's lock held.

    Attributes
    ----------
    depth : int
        How many there are above it.
    at_work : bool
        A worker is at it, from `begin` to `rest`.
    called : bool
        Of the input: there may be sound to read.
    taken : Block or None
        What the worker has to work on.
    heard : bool
        Somebody may want the last block later: the world is told of it, and a new child begins with it. Else its memory
        is free, and still in the cache, as soon as the children have done with it.
    shared : Block or None
        Released last; a new child begins with it. None where it is not `heard`.
    untold : Block or None
        Released last, until the world has been told of it; `NOTHING` where it is not `heard`.
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
        self.at_work = self.called = False
        self.taken: Block | None = None
        self.heard = True
        self.shared: Block | None = None
        self.untold: Block | None = None
        self._private: Block | None = None  # computed, and to be released as soon as no child holds the last one
        self._token: Block | None = None  # the parent's, not taken yet
        self._reading: StateMachine | None = None  # whose block it holds: the input may be replaced meanwhile
        self._holders: set[StateMachine] = set()  # children that have not given the last block back

    # --- what a processor adds ---

    def rouse(self) -> None:
        """It has become ready."""

    def settle(self) -> None:
        """It is `over`."""

    # --- coming and going ---

    def attach(self) -> None:
        """Become a child of its parent, and begin with the block that this has released last, if there is one."""
        if self.parent is None:
            return
        self.parent.children.append(self)
        if self.parent.shared is not None:
            self.parent._hand(self, self.parent.shared)
        self._end_if_exhausted()

    def call(self) -> None:
        """There may be sound to read."""
        self.called = True
        if self.ready:
            self.rouse()

    def move(self, parent: StateMachine) -> None:
        """Become a child of another parent, which has released nothing yet; a block that was not taken is dropped."""
        self._leave()
        self.parent, self._token = parent, None
        parent.children.append(self)

    def remove(self) -> None:
        """Gone at once: its parent waits for it no longer, and it will release nothing more."""
        self._enter(REMOVED)
        self.shared = self._private = self._token = None
        self._leave()
        if not self.at_work:
            self.settle()

    def finish(self) -> None:
        """Nothing more will come of it; children may still take the block released last."""
        self.give_back()
        self._enter(DONE)
        if self.parent is not None and self._token is not None:  # it has failed
            self._token = None
            self.parent._freed_by(self)
        for child in self.children:
            child._end_if_exhausted()
        if not self.at_work:
            self.settle()

    def _leave(self) -> None:
        if self.parent is not None and self in self.parent.children:
            self.parent.children.remove(self)
            self.parent._freed_by(self)

    def _end_if_exhausted(self) -> None:
        if self.parent is None or self.parent.state is not DONE or self._token is not None:
            return
        if not self.at_work and self.state is WAIT_EXEC:
            self.finish()

    @property
    def gone(self) -> bool:
        """Whether it was removed."""
        return self.state is REMOVED

    @property
    def over(self) -> bool:
        """Whether nobody works on it and nobody ever will."""
        return self.state in ENDS and not self.at_work

    # --- the four states ---

    @property
    def ready(self) -> bool:
        """Whether there is something to do: a block to take, or one to tell of."""
        if self.at_work:
            return False
        state = self.state
        return self._token is not None or self.called if state is WAIT_EXEC else state is RELEASE

    def begin(self) -> bool:
        """Somebody works on it from now on, and takes the block that waits for it, if there is one.

        False where there is nothing to do.
        """
        if self.at_work:
            return False
        state = self.state
        if state is WAIT_EXEC:
            taken = self._token
            if taken is None:
                if not self.called:
                    return False
                self.called = False
            else:
                self._token = None
                self._reading = self.parent
                self.state = EXEC
                if self.observers:
                    self._tell_observers(taken.number)
            self.taken = taken
        elif state is not RELEASE:
            return False
        self.at_work = True
        return True

    def read(self, block: Block) -> None:
        """The input has read a block."""
        self.called = True  # perhaps there is more
        self.taken = block
        self._enter(EXEC, block.number)

    def done(self, private: Block | None) -> None:
        """It has computed `private`, or nothing: that is released at once or as soon as no child holds the last one."""
        if self.skipped:
            del self.skipped
        self.give_back()
        if private is not None and self.state is not REMOVED:
            self.state = WAIT_RELEASE
            if self.observers:
                self._tell_observers(private.number)
            if self._holders:
                self._private = private
            else:
                self._release(private)

    def skip(self) -> None:
        """Release the parent's block during a long computation: siblings continue, this one misses blocks meanwhile."""
        self.skipped = True
        self.give_back()

    def give_back(self) -> None:
        """Return the parent's block, which may release its next one then."""
        reading = self._reading
        if reading is not None:
            self._reading = None
            reading._freed_by(self)

    def rest(self) -> None:
        """Nobody works on it any more."""
        self.at_work, self.taken = False, None
        state = self.state
        if state is EXEC or (state is RELEASE and self.untold is None):
            self.state = WAIT_EXEC
            if self.observers:
                self._tell_observers(None)
            if self._token is not None or self.called:
                self.rouse()
            elif self.parent is not None and self.parent.state is DONE:
                self._end_if_exhausted()
        elif state in ENDS:
            self.settle()
        elif self.ready:
            self.rouse()

    def _freed_by(self, child: StateMachine) -> None:
        self._holders.discard(child)
        if not self._holders and self.state is WAIT_RELEASE:
            block, self._private = self._private, None
            assert block is not None
            self._release(block)

    def _release(self, block: Block) -> None:
        """Called, while no child holds a block, by whoever has made that possible, which is mostly a child."""
        self.state = RELEASE
        if self.observers:
            self._tell_observers(block.number)
        self.shared, self.untold = (block, block) if self.heard else (None, NOTHING)
        for child in self.children:
            if child.state is not DONE and not child.skipped:
                self._hand(child, block)
        if not self.at_work:
            self.rouse()

    def _hand(self, child: StateMachine, block: Block) -> None:
        self._holders.add(child)
        child._token = block
        if child.state is WAIT_EXEC and not child.at_work:
            child.rouse()

    def _enter(self, state: State, number: int | None = None) -> None:
        if self.state is not REMOVED:
            self.state = state
            self._tell_observers(number)

    def _tell_observers(self, number: int | None) -> None:
        for observer in self.observers:
            observer(self, self.state, number)
