"""One processor of the tree: a thread that goes through waitExec, exec, waitRelease and release."""

from __future__ import annotations

import copy
import enum
import itertools
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from rosafe.tree.window import History, WindowView
from rosafe.tree.zone import Block, SharedZone


class State(enum.Enum):
    """The four states of the user guide (figure 11), and the two ends."""

    WAIT_EXEC = "waitExec"
    EXEC = "exec"
    WAIT_RELEASE = "waitRelease"
    RELEASE = "release"
    DONE = "done"  # its input has come to its end
    REMOVED = "removed"


class Source(Protocol):
    """Where the input processor reads."""

    sample_rate: float

    def read(self) -> tuple[np.ndarray, int] | None:
        """The next block, (2, n), and the index of the frame after it; None at the end. Blocks; `stop` ends that."""

    def stop(self) -> None:
        """Make `read` return None, now and from now on."""


class Listener(Protocol):
    """Who hears of what the processors do. Called on their threads; must not wait for the tree."""

    def added(self, processor: Processor) -> None:
        """A processor is about to start; nothing was released yet. Where this raises, it is taken out again."""

    def executed(self, processor: Processor, seconds: float) -> None:
        """One block was computed in so many seconds; the last one perhaps after `ended`."""

    def released(self, processor: Processor, block: Block) -> None:
        """A block was released. Never called after `ended`."""

    def ended(self, processor: Processor) -> None:
        """The processor is gone; `processor.error` tells why where it was not asked to."""


# Gets (processor, state that it enters, number of the block at hand or None). Called under the tree's lock: no waiting.
Observer = Callable[["Processor", State, "int | None"], None]


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
        self.turn = threading.Condition(lock)
        self._lock = lock
        self.stage = stage  # as it will be after all changes, to be asked and not to be run
        self._stage = stage  # at work
        self._source = source
        self._listener = listener
        self._failed = failed
        self._observers = observers
        self._private: Block | None = None  # computed, and to be released as soon as no child holds the last one
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
            while self._cycle():
                self.blocks += 1
        except BaseException as problem:  # whatever it was: the tree must hear of it, and nobody may wait for this one
            self.error = problem
        with self._lock:
            self._enter(State.DONE)
            self.zone.close()
            for child in self.children:
                child.turn.notify_all()
        if self.error is not None:
            self._failed(self)

    # --- the four states ---

    def _cycle(self) -> bool:
        """One block; False when there is no more."""
        self._enter(State.WAIT_EXEC)
        taken = self._wait_exec() if self._source is None else self._read(self._source)
        if taken is None:
            return False
        self._enter(State.EXEC, taken.number)
        begun = time.perf_counter()
        private = self._exec(taken)
        seconds = time.perf_counter() - begun
        self._give_back()
        self._listener.executed(self, seconds)
        if private is not None and self._wait_release(private):
            self._publish(private)
        return True

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
        """Wait for a token of the parent; None where none will come."""
        with self._lock:
            while not self._gone:
                parent = self.parent
                assert parent is not None
                if parent.zone.has_token(self):
                    self._reading = parent
                    return parent.zone.take(self)
                if parent.zone.exhausted(self):
                    return None
                self.turn.wait()
            return None

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
                self.turn.wait()
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
            for child in self.children:
                child.turn.notify_all()
            self.turn.notify_all()

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
