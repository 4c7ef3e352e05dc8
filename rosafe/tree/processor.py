"""One processor of the tree: a task that goes through waitExec, exec, waitRelease and release, block after block."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

from numpy.typing import NDArray

from rosafe.dsp.guard import FloatArray
from rosafe.dsp.signal import Signal
from rosafe.dsp.stage import Stage
from rosafe.tree.block import Block
from rosafe.tree.changes import Changes
from rosafe.tree.history import History, Taken
from rosafe.tree.states import State, StateMachine
from rosafe.tree.workers import Workers
from rosafe.vocabulary.representation import Representation

SHORT = 1.5e-4  # seconds: a listener that takes so long is called once nothing deeper in the tree is ready
EARS = (2,)  # leading shape of what the input takes


class Source(Protocol):
    """Where the input reads. Called with no lock of the tree's held, and `read` by one thread at a time.

    Attributes
    ----------
    sample_rate : float
        In Hz.
    ended : bool
        Nothing more will come; what has come may still be read.
    """

    sample_rate: float
    ended: bool

    def open(self, wake: Callable[[], None]) -> None:
        """From now on call `wake` whenever there may be a block to read, or the end. It returns at once.

        There may be one already: the tree looks once without being called.
        """

    def read(self) -> tuple[NDArray[Any], int] | None:
        """The next block, (2, n), and the index of the frame after it; None where there is none yet, or no more."""

    def stop(self) -> None:
        """Nobody will read any more."""


class Listener(Protocol):
    """Who hears of what the processors do. Called by workers, of which others go on; must not wait for the tree."""

    def added(self, processor: Processor) -> None:
        """A processor is about to start; nothing was released yet. Where this raises, it is taken out again."""

    def executed(self, processor: Processor, seconds: float) -> None:
        """One block was computed in so many seconds; the last one perhaps after `ended`."""

    def released(self, processor: Processor, block: Block) -> None:
        """A block was released. Never called after `ended`, and for one processor by one worker at a time."""

    def ended(self, processor: Processor) -> None:
        """The processor is gone; `processor.error` tells why where it was not asked to."""


# Gets (processor, state that it enters, number of the block at hand or None). Called under the tree's lock: no waiting.
Observer = Callable[["Processor", State, "int | None"], None]


@dataclass(frozen=True)
class Company:
    """What all processors of one tree have in common.

    `failed` is called, by the worker, where a processor's `error` is set.
    """

    workers: Workers
    listener: Listener
    failed: Callable[[Processor], None]
    over: threading.Condition  # on the tree's lock: somebody may have come to its end
    observers: list[Observer] = field(default_factory=list)


class Processor(StateMachine):
    """A node of the tree. Made and wired by `Tree`; the public members are safe from any thread.

    Locks are taken in this order: the tree's requests, `_telling`, the tree's lock or those of changes and history.

    Parameters
    ----------
    name : str
        The user's name for it.
    stage : Stage
        The numerics.
    parent : Processor or None
        None for the input, which reads from `source`.
    company : Company
        The others.
    history_seconds : float
        How much of its output it remembers.

    Attributes
    ----------
    kind : str
        Its representation's.
    error : BaseException or None
        Why it came to its end.
    blocks : int
        That it has worked on, and
    busy : float
        the seconds that it took for them.
    place : callable or None
        Gets the frames that it has taken, and tells where its stage may write the output (`Stage.place`).
    """

    parent: Processor | None
    children: list[Processor]  # type: ignore[assignment]  # state machines, all of which are processors

    def __init__(
        self,
        name: str,
        stage: Stage,
        parent: Processor | None,
        company: Company,
        history_seconds: float,
        source: Source | None = None,
    ) -> None:
        super().__init__(parent)
        self.name = name
        self.kind = stage.REPRESENTATION.kind
        self.error: BaseException | None = None
        self.blocks = 0
        self.busy = 0.0
        self.held_up_since = 0.0
        self.changes = Changes(stage)
        self.history = History(self.part_rows, stage.output, history_seconds)
        self._company = company
        self._listener = company.listener
        self.observers = company.observers
        self._workers = company.workers
        self._lock = company.workers.lock
        self._source = source
        self._started = False
        self.place: Callable[[int], FloatArray | None] | None = None
        self._usual_telling = 0.0  # seconds that the listener took for the last block
        self._telling = threading.Lock()  # `released` and `ended` exclude each other

    def __repr__(self) -> str:
        return f"<{self.kind} {self.name!r} {self.state.value}>"

    # --- what it is ---

    @property
    def stage(self) -> Stage:
        """As it will be after all changes, to be asked and not to be run."""
        return self.changes.planned

    @property
    def representation(self) -> Representation:
        """The declaration of what it computes."""
        return self.stage.REPRESENTATION

    @property
    def given_rows(self) -> tuple[int, ...]:
        """Leading shape of what it takes."""
        return EARS if self.parent is None else self.parent.rows

    @property
    def part_rows(self) -> tuple[tuple[int, ...], ...]:
        """Leading shape of each part of its output, such as (2, channels)."""
        return self.stage.part_rows(self.given_rows)

    @property
    def rows(self) -> tuple[int, ...]:
        """That of the first part, which its children take."""
        return self.stage.output_rows(self.given_rows)

    @property
    def axes(self) -> tuple[tuple[str, ...], ...]:
        """What lies along the dimensions of each part, time last."""
        return tuple(part.axes for part in self.representation.parts)

    @property
    def signal(self) -> Signal:
        """The format of its output."""
        return self.stage.output

    @property
    def rate(self) -> float:
        """Frames of output per second."""
        return self.signal.rate

    @property
    def next_index(self) -> int:
        """Of the audio frame after the newest one that its output knows of."""
        return self.history.next_index

    def parameters(self) -> dict[str, Any]:
        """The values from the next block on, in the order of the parameter structure."""
        return self.stage.parameters

    def derived(self) -> dict[str, Any]:
        """What follows from these."""
        return self.stage.derived

    def take(self, reader: str) -> Taken:
        """What it released since `reader` asked last, at most the history."""
        return self.history.take(reader)

    # --- life ---

    def start(self) -> None:
        """Begin to work, with the block that the parent released last."""
        with self._lock:
            self._workers.enter()  # nothing is attached where the system has no thread left
            self._started = True
            self.attach()
            self._workers.wake()
        if self._source is not None:
            self._source.open(self._wake)
            self._wake()

    def _wake(self) -> None:
        """The source may have something."""
        with self._lock:
            self.call()
            self._workers.wake()

    def end(self) -> None:
        """Take it out of the tree, at once; whoever works on it still will not be heard."""
        with self._lock:
            self.remove()
            if self._started:
                self._workers.leave()
            self._workers.wake()
        if self._source is not None:
            self._source.stop()
        with self._telling:
            self._listener.ended(self)

    def join(self, timeout: float | None = None) -> bool:
        """Wait until nobody works on it and nobody will; whether that is so."""
        with self._lock:
            return bool(self._company.over.wait_for(lambda: self.over, timeout))

    def rouse(self) -> None:
        self._workers.push(self)

    def settle(self) -> None:
        self._company.over.notify_all()

    # --- what workers do ---

    def work(self) -> None:
        """Take the next step: tell of the last block, or compute the next one."""
        try:
            if self.untold is not None:
                self._tell(self.untold)
                return
            if self._source is not None:
                self._read(self._source)
            if self.taken is not None:
                self._compute(self.taken)
        except BaseException as problem:  # whatever it was: the tree must hear of it, and nobody may wait for this one
            self.error = problem
            with self._lock:
                self.finish()
            self.held_up_since = time.monotonic()  # by requests
            self._company.failed(self)
            self.held_up_since = 0.0

    def _read(self, source: Source) -> None:
        """Take the next block of the source, if there is one, or come to the end with it."""
        self.held_up_since = time.monotonic()
        while True:
            ended = source.ended  # looked at first: what has come before the end is read
            got = source.read()
            if got is not None or ended == source.ended:
                break
        self.held_up_since = 0.0
        with self._lock:
            if got is not None:
                self.read(Block(self.blocks, (got[0],), got[1], self.stage.given))
            elif ended:
                self.finish()

    def _compute(self, taken: Block) -> None:
        begun = time.monotonic()
        private = self._process(taken)
        seconds = time.monotonic() - begun
        self.blocks += 1
        self.busy += seconds
        with self._lock:
            self.done(private)
        self._listener.executed(self, seconds)
        if self.untold is not None and self._usual_telling < SHORT:
            self._tell(self.untold)

    def _process(self, taken: Block) -> Block | None:
        """What comes out for a block; None where that cannot be used."""
        stage = self.changes.stage_for(taken)
        if stage is None:
            return None
        if stage.PROVIDES:
            with self._lock:
                children = list(self.children)
            wanted = {child.changes.needs(taken.number) for child in children}
            stage.provide = frozenset(wanted.intersection(stage.PROVIDES))
        if self.place is not None and not self.children:  # who take blocks in one piece
            stage.place = self.place(taken.data.shape[-1])
        needs = stage.needs
        output = stage.process(taken.data, taken.extras[needs]) if needs else stage.process(taken.data)
        parts = output if isinstance(output, tuple) else (output,)
        next_index = taken.next_index
        if look_ahead := stage.look_ahead:
            next_index = max(0, next_index - look_ahead * stage.given.hop)
        return Block(taken.number, parts, next_index, stage.output, stage.provided)

    def _tell(self, block: Block) -> None:
        """Tell the world of the block that was released last."""
        self.untold = None
        self.held_up_since = begun = time.monotonic()
        with self._telling:
            if self.state is not State.REMOVED:
                self.history.append(block)
                self._listener.released(self, block)
        self.held_up_since = 0.0
        self._usual_telling = time.monotonic() - begun


def subtree(processor: Processor) -> Iterator[Processor]:
    """`processor` and all below it, leaves first."""
    for child in list(processor.children):
        yield from subtree(child)
    yield processor
