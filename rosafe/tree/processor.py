"""One processor of the tree: a thread that goes through waitExec, exec, waitRelease and release.

To wake a thread takes some ten microseconds of both processors of the machine, and then the two want the interpreter
lock in turn. A processor whose blocks take not much longer than that is carried: the thread that has released its
parent's block goes through the child's states too, while the child's own thread sleeps. It wakes up as soon as its
blocks take longer, and for the end.
"""

from __future__ import annotations

import copy
import itertools
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from rosafe.tree.roles import Listener, Observer, Source, State
from rosafe.tree.window import History, WindowView
from rosafe.tree.zone import Block, SharedZone

SHORT = 1.5e-4  # seconds: a processor that works so long on a block is better off on a thread of its own
OBSERVED = 8  # blocks that a processor does on its own thread before it may be carried
RISE = 1.1  # what a processor takes for a block is the least of late; that is forgotten at this pace per block


class Change(NamedTuple):
    """A parameter change that waits for the processor's next block, or for a later one."""

    block: int  # of the input; it is made before this one, or the next one if that is a later one
    name: str
    value: Any


class Processor:
    """A node of the tree. Made and wired by `Tree`; the public members are safe from any thread.

    Locks are taken in this order: the tree's requests, `_publishing`, `_changing` or the tree's lock.

    Parameters
    ----------
    name, kind : str
        The user's name for it; a key of `rosafe.interface.KINDS`.
    stage : rosafe.dsp.Stage
        The numerics.
    parent : Processor or None
        None for the input, which reads from `source`.
    lock : threading.RLock
        The tree's lock, which guards all tokens.
    failed : callable
        Called at the end of its thread where `error` is set.
    observers : sequence of Observer
        The tree's, as they come and go.
    """

    def __init__(
        self,
        name: str,
        kind: str,
        stage: Any,
        parent: Processor | None,
        source: Source | None,
        lock: threading.RLock,
        listener: Listener,
        history_seconds: float,
        failed: Callable[[Processor], None],
        observers: Sequence[Observer] = (),
    ) -> None:
        self.name = name
        self.kind = kind
        self.parent = parent
        self.children: list[Processor] = []
        self.state = State.WAIT_EXEC
        self.error: BaseException | None = None
        self.blocks = 0
        self.next_index = 0
        self.history_seconds = history_seconds
        self.zone = SharedZone()
        self.turn = threading.Condition(lock)  # its own thread waits for a block
        self._released = threading.Condition(lock)  # whoever works for it waits for its children
        self._lock = lock
        self.stage = stage  # as it will be after all changes, to be asked and not to be run
        self._stage = stage  # at work
        self._source = source
        self._listener = listener
        self._failed = failed
        self._observers = observers
        self._private: Block | None = None  # computed, and to be released as soon as no child holds the last one
        self._working = False  # on a block, until its children have done theirs that are carried
        self._carried = False  # the thread that works for its parent has taken on its block, or will
        self._carries: list[Processor] = []  # the children whose block is taken on
        self._usual = math.inf  # seconds that it takes for a block
        self._telling = 0.0  # seconds that the listener took for the last block
        self._reading: Processor | None = None  # the parent whose block it holds: the input may be replaced meanwhile
        self._changing = threading.Lock()  # guards _changes, and the exchange of _stage
        self._changes: list[Change] = []
        self._publishing = threading.Lock()  # `released` and `ended` exclude each other
        self._history = History(self.rows, self.rate, history_seconds)
        self._thread = threading.Thread(target=self._run, name=f"{kind}:{name}", daemon=True)

    def __repr__(self) -> str:
        return f"<{self.kind} {self.name!r} {self.state.value}>"

    # --- what it is ---

    @property
    def rows(self) -> tuple[int, ...]:
        """Leading shape of its output: (2,), (2, channels), (channels,) or (channels, lags)."""
        return tuple(self.stage.output_rows(self.parent.rows if self.parent is not None else (2,)))

    @property
    def rate(self) -> float:
        """Frames of output per second."""
        return float(self.stage.output_rate)

    def parameters(self) -> dict[str, Any]:
        """The values from the next block on, in the order of the parameter structure; `cc_lags` (s) at its end."""
        stage = self.stage
        values = dict(stage.parameters)
        if hasattr(stage, "lags"):
            values["cc_lags"] = stage.lags.tolist()
        return values

    # --- changes ---

    def change(self, name: str, value: Any, accept: Callable[[Any], None], block: int = 0) -> None:
        """Change one parameter before block `block` of the input, or before the next one if that is a later one.

        `accept` sees the changed stage before it is put to work and may raise ValueError; then, as where the stage
        itself does, everything stays as it was. The caller makes one change at a time, in the order of their blocks.
        """
        change = Change(block, name, value)
        planned = _changed(self.stage, [change])
        accept(planned)
        with self._changing:
            self._changes.append(change)
            self.stage = planned

    def _due(self, block: int) -> list[Change]:
        return list(itertools.takewhile(lambda change: change.block <= block, self._changes))

    def _apply_changes(self, taken: Block) -> None:
        """Make the changes that are due, up to the last one after which the stage can work on block `taken`.

        A method that needs the filterbank's envelope waits for a block that has it.
        """
        if not self._changes:
            return
        with self._changing:
            due = self._due(taken.number)
            while due:
                stage = _changed(self._stage, due)
                if taken.envelope is not None or not _needs_envelope(stage):
                    self._stage = stage
                    del self._changes[: len(due)]
                    return
                due.pop()

    def wants_envelope(self, number: int) -> bool:
        """Whether block `number` of the parent should carry its envelope."""
        if not self._changes:
            return _needs_envelope(self._stage)
        with self._changing:
            return _needs_envelope(_changed(self._stage, self._due(number)))

    # --- life ---

    def start(self) -> None:
        """Begin to work, with the block that the parent released last."""
        with self._lock:
            self._thread.start()  # nothing is attached where the system has no thread left
            if self.parent is not None:
                self.parent.children.append(self)
                self.parent.zone.attach(self)

    def remove(self) -> None:
        """Take it out of the tree at once: its parent no longer waits for it and it will release nothing more."""
        with self._lock:
            self._enter(State.REMOVED)
            if self.parent is not None:
                self.parent.zone.detach(self)
                if self in self.parent.children:
                    self.parent.children.remove(self)
                self.parent._release_if_free()
            self.turn.notify_all()
            self._released.notify_all()
        if self._source is not None:
            self._source.stop()
        with self._publishing:
            self._listener.ended(self)

    def adopt(self, child: Processor) -> None:
        """Before the start: take over a child of another processor, from the next block that the child takes."""
        with self._lock:
            assert child.parent is not None
            child.parent.zone.detach(child)
            child.parent.children.remove(child)
            child.parent = self
            self.children.append(child)
            self.zone.attach(child)

    def join(self, timeout: float | None = None) -> bool:
        """Wait for its thread; whether that has ended."""
        if self._thread.ident is not None:
            self._thread.join(timeout)
        return not self._thread.is_alive()

    @property
    def _gone(self) -> bool:
        return self.state is State.REMOVED

    def _run(self) -> None:
        try:
            while (taken := self._next()) is not None:
                self._cycle(taken)
        except BaseException as problem:  # whatever it was: the tree must hear of it, and nobody may wait for this one
            self.error = problem
        with self._lock:
            self._enter(State.DONE)
            self.zone.close()
            for child in self._carries:
                child._carried = False
            for child in (*self._carries, *self.children):  # those carried may have another parent by now
                child.turn.notify_all()
        if self.error is not None:
            self._failed(self)

    # --- the four states ---

    def _next(self) -> Block | None:
        return self._wait_exec() if self._source is None else self._read(self._source)

    def _cycle(self, taken: Block) -> None:
        """Do one block, and that of the children that are carried."""
        self._enter(State.EXEC, taken.number)
        begun, work = time.perf_counter(), time.thread_time()
        private = self._exec(taken)
        seconds, work = time.perf_counter() - begun, time.thread_time() - work
        self._give_back()
        self._listener.executed(self, seconds)
        if private is not None and self._wait_release(private):
            begun = time.perf_counter()
            self._publish(private)
            self._telling = time.perf_counter() - begun
        self._usual = min(work, RISE * self._usual)
        self.blocks += 1
        self._enter(State.WAIT_EXEC)
        for child in self._carries:
            child._ride(self)
        self._carries = []

    def _ride(self, parent: Processor) -> None:
        """Do the block of `parent`, on the thread that works for that one."""
        with self._lock:
            while self._working and self.parent is parent and not self._gone:  # its own thread is on the last block
                self._released.wait()
            mine = self.parent is parent and not self._gone and self.error is None
            taken = self._take() if mine else None
        if taken is not None:
            try:
                self._cycle(taken)
            except BaseException as problem:  # its own thread will tell
                self.error = problem
        with self._lock:
            self._carried = False
            if taken is not None:
                self._working = False
            if taken is None or self.error is not None or self.parent is not parent or self._exhausted:
                self.turn.notify_all()

    def _enter(self, state: State, block: int | None = None) -> None:
        with self._lock:
            if not self._gone:
                self.state = state
                for observer in self._observers:
                    observer(self, state, block)

    def _read(self, source: Source) -> Block | None:
        got = source.read()
        if got is None or self._gone:
            return None
        return Block(self.blocks, *got, source.sample_rate)

    def _wait_exec(self) -> Block | None:
        """Wait on its own thread for a token of the parent; None where none will come."""
        with self._lock:
            self._working = False
            self._released.notify_all()
            while not self._gone and self.error is None:
                if not self._carried:
                    if (taken := self._take()) is not None:
                        return taken
                    if self._exhausted:
                        return None
                self.turn.wait()
            return None

    def _take(self) -> Block | None:
        """The block that the parent has released for it, if there is one. With the tree's lock held."""
        parent = self.parent
        assert parent is not None
        if not parent.zone.has_token(self):
            return None
        self._working = True
        self._reading = parent
        return parent.zone.take(self)

    @property
    def _exhausted(self) -> bool:
        return self.parent is not None and self.parent.zone.exhausted(self)

    def _exec(self, taken: Block) -> Block | None:
        """Compute into the private zone; None where the block cannot be used."""
        self._apply_changes(taken)
        stage = self._stage
        if not _needs_envelope(stage):
            if hasattr(stage, "provide_envelope"):
                with self._lock:
                    children = list(self.children)
                stage.provide_envelope = any(child.wants_envelope(taken.number) for child in children)
            data = stage.process(taken.data)
        elif taken.envelope is not None:
            data = stage.process(taken.data, taken.envelope)
        else:  # from before the filterbank knew that somebody wants the envelope
            return None
        envelope = getattr(stage, "envelope", None)
        return Block(taken.number, data, taken.next_index, float(stage.output_rate), envelope)

    def _give_back(self) -> None:
        """Return the token: the parent may release its next block."""
        with self._lock:
            if self._reading is not None:
                self._reading.zone.give_back(self)
                self._reading._release_if_free()
                self._reading = None

    def _wait_release(self, private: Block) -> bool:
        """Wait until no child holds the last block and `private` is released; False where it was removed instead."""
        with self._lock:
            self._enter(State.WAIT_RELEASE, private.number)
            self._private = private
            self._release_if_free()
            while self._private is not None and not self._gone:
                self._released.wait()
            return self._private is None

    def _release_if_free(self) -> None:
        """Release the block that waits for that, if no child holds the last one. With the tree's lock held.

        Called by whoever may have made it possible, which is mostly a child: that one goes on with the new block at
        once and need not wait until this processor has woken up.
        """
        if self._private is not None and self.zone.free and not self._gone:
            self._enter(State.RELEASE, self._private.number)
            self.zone.release(self._private)
            self._private = None
            self._carries = [child for child in self.children if self._can_carry(child)]
            for child in self.children:
                if child in self._carries:
                    child._carried = True
                else:
                    child.turn.notify_all()
            self._released.notify_all()

    def _can_carry(self, child: Processor) -> bool:
        """Whether whoever works for this processor should do the child's block, too: both take little time."""
        known = child.blocks >= OBSERVED and not child._carried
        return known and max(child._usual, child._telling, self._telling) < SHORT

    def _publish(self, block: Block) -> None:
        """Tell the world, while the children work on the block."""
        with self._publishing:
            if not self._gone:
                self.next_index = block.next_index
                self._remember(block)
                self._listener.released(self, block)

    # --- history, for getSignals ---

    def _remember(self, block: Block) -> None:
        like = (block.data.shape[:-1], block.rate, self.history_seconds)
        if (self._history.rows, self._history.rate, self._history.seconds) != like:
            self._history = History(*like)  # frames of different shapes or rates do not go together
        self._history.append(block.data)

    def take_signals(self) -> tuple[WindowView, int, float]:
        """What it released since the last call: data, index after it in audio frames, frames per second."""
        with self._publishing:
            return self._history.take(), self.next_index, self._history.rate


def _changed(stage: Any, changes: list[Change]) -> Any:
    """`stage` after `changes`. It shares the state of `stage`, which does not notice."""
    if changes:
        stage = copy.copy(stage)
    for change in changes:
        stage.configure(**{change.name: change.value})
    return stage


def _needs_envelope(stage: Any) -> bool:
    return bool(getattr(stage, "needs_envelope", False))


def subtree(processor: Processor) -> Iterator[Processor]:
    """`processor` and all below it, leaves first."""
    for child in list(processor.children):
        yield from subtree(child)
    yield processor
