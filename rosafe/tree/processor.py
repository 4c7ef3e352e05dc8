"""One processor of the tree: a thread that goes through waitExec, exec, waitRelease and release."""

from __future__ import annotations

import copy
import enum
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import numpy as np

from rosafe.dsp.haircell import ENVELOPE_METHODS
from rosafe.tree.window import History, WindowView
from rosafe.tree.zone import Block, SharedZone

# The stage wants an envelope that only blocks from the next exec of its parent on carry.
_ENVELOPE_PARAMETER = "ihc_method"


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
        """A processor is in the tree and about to start; nothing was released yet."""

    def executed(self, processor: Processor, seconds: float) -> None:
        """One block was computed in so many seconds."""

    def released(self, processor: Processor, block: Block) -> None:
        """A block was released. Never called after `ended`."""

    def ended(self, processor: Processor) -> None:
        """The processor is gone; `processor.error` tells why where it was not asked to."""


class Processor:
    """A node of the tree. Made and wired by `Tree`; the public members are safe from any thread.

    Parameters
    ----------
    name, kind : str
        The user's name for it; a key of `rosafe.interface.KINDS`.
    stage : object
        The numerics, of `rosafe.dsp.STAGES`.
    parent : Processor or None
        None for the input, which reads from `source`.
    lock : threading.RLock
        The tree's lock, which guards all tokens.
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
        self._stage = stage
        self._source = source
        self._listener = listener
        self._failed = failed
        self._computing = threading.Lock()  # held while the stage works: changes are made between blocks
        self._changing = threading.Lock()  # held while parameters change, which is short; taken after _computing
        self._publishing = threading.RLock()  # `released` and `ended` exclude each other
        self._scheduled: list[tuple[int | None, str, Any]] = []
        self._history: History | None = None
        self._thread = threading.Thread(target=self._run, name=f"{kind}:{name}", daemon=True)

    def __repr__(self) -> str:
        return f"<{self.kind} {self.name!r} {self.state.value}>"

    # --- what it is ---

    @property
    def rows(self) -> tuple[int, ...]:
        """Leading shape of its output: (2,), (2, channels), (channels,) or (channels, lags)."""
        return self._stage.output_rows(self.parent.rows if self.parent is not None else (2,))

    def check_rows(self, rows: tuple[int, ...], check: Callable[[tuple[int, ...], float], None]) -> None:
        """Call `check(rows, rate)` for what it and all below would put out if its parent's rows were `rows`."""
        mine = self._stage.output_rows(rows)
        check(mine, self.rate)
        for child in self.children:
            child.check_rows(mine, check)

    @property
    def rate(self) -> float:
        """Frames of output per second."""
        return float(self._stage.output_rate)

    @property
    def lags(self) -> np.ndarray | None:
        """Lags of a cross-correlation in seconds, (L,); None for other kinds."""
        return getattr(self._stage, "lags", None)

    def parameters(self) -> dict[str, Any]:
        """The values in force, or about to be from the next block on, in the order of the parameter structure."""
        with self._changing:
            values = dict(self._stage.parameters)
            values.update({name: value for at, name, value in self._scheduled if at is None})
        return values

    # --- changes ---

    def configure(self, name: str, value: Any, accept: Callable[[Any], None]) -> None:
        """Change one parameter from the next block on.

        `accept` sees the changed stage before it is put to work and may raise; then, as with any ValueError of the
        stage itself, everything stays as it was.
        """
        with self._computing, self._changing:
            changed = copy.deepcopy(self._stage)
            changed.configure(**{name: value})
            accept(changed)
            if name == _ENVELOPE_PARAMETER:
                # Blocks that are already on their way may lack the envelope: the change waits for one that has it.
                self._scheduled.append((None, name, value))
            else:
                self._stage = changed

    def schedule(self, block: int, name: str, value: Any) -> None:
        """Change one parameter before block `block` of the input."""
        with self._changing:
            self._scheduled.append((block, name, value))

    def wants_envelope(self, number: int) -> bool:
        """Whether block `number` of the parent should carry its envelope."""
        with self._changing:
            wanted = getattr(self._stage, "needs_envelope", False)
            due = [v for at, name, v in self._scheduled if name == _ENVELOPE_PARAMETER and (at is None or at <= number)]
            return wanted or any(method in ENVELOPE_METHODS for method in due)

    # --- life ---

    def start(self) -> None:
        """Begin to work."""
        self._thread.start()

    def hang_on(self, parent: Processor) -> None:
        """Become a child of `parent`; begins with the block that it released last."""
        with self.turn:
            parent.children.append(self)
            parent.zone.attach(self)

    def remove(self) -> None:
        """Take it out of the tree at once: its parent no longer waits for it and it will release nothing more."""
        with self.turn:
            self.state = State.REMOVED
            if self.parent is not None:
                self.parent.zone.detach(self)
                self.parent.children.remove(self)
                self.parent.turn.notify_all()
            self.turn.notify_all()
        if self._source is not None:
            self._source.stop()
        with self._publishing:
            self._listener.ended(self)

    def join(self, timeout: float | None = None) -> bool:
        """Wait for its thread; whether that has ended."""
        self._thread.join(timeout)
        return not self._thread.is_alive()

    @property
    def is_this_thread(self) -> bool:
        """Whether the caller runs on this processor's thread."""
        return threading.current_thread() is self._thread

    def adopt(self, child: Processor) -> None:
        """Take over a child of another processor, from the next block on."""
        with self.turn:
            if child.parent is None or self.zone.block is not None:
                raise RuntimeError("only a processor that has not started can adopt, and not an input")
            child.parent.zone.detach(child)
            child.parent.children.remove(child)
            child.parent = self
            self.zone.attach(child)
            self.children.append(child)
            child.turn.notify_all()

    @property
    def _gone(self) -> bool:
        return self.state is State.REMOVED

    def _run(self) -> None:
        try:
            while self._cycle():
                self.blocks += 1
        except BaseException as problem:  # whatever it was: the tree must hear of it, and the children must not wait
            self.error = problem
        with self.turn:
            if not self._gone:
                self.state = State.DONE
            self.zone.closed = True
            if self.parent is not None:
                self.parent.zone.detach(self)
                self.parent.turn.notify_all()
            for child in self.children:
                child.turn.notify_all()
        if self.error is not None:
            self._failed(self)

    def _cycle(self) -> bool:
        """One block; False when there is no more."""
        self._set(State.WAIT_EXEC)
        taken = self._read() if self.parent is None else self._wait_exec()
        if taken is None:
            return False
        self._set(State.EXEC)
        begun = time.perf_counter()
        block = self._exec(taken)
        self._listener.executed(self, time.perf_counter() - begun)
        self._token_back()
        return block is None or (self._wait_release() and self._release(block))

    def _set(self, state: State) -> None:
        with self.turn:
            if not self._gone:
                self.state = state

    def _read(self) -> Block | None:
        assert self._source is not None
        got = self._source.read()
        if got is None or self._gone:
            return None
        data, next_index = got
        return Block(self.blocks, data, next_index, self._source.sample_rate)

    def _wait_exec(self) -> Block | None:
        with self.turn:
            while True:
                if self._gone:
                    return None
                assert self.parent is not None
                if self.parent.zone.has_token(self):
                    return self.parent.zone.take(self)
                if self.parent.zone.exhausted(self):
                    return None
                self.turn.wait()

    def _exec(self, taken: Block) -> Block | None:
        """Compute into the private zone; None where the block cannot be used."""
        with self.turn:
            children = list(self.children)
        envelope_wanted = any(child.wants_envelope(taken.number) for child in children)
        with self._computing:
            with self._changing:
                self._apply_changes(taken)
            stage = self._stage
            if getattr(stage, "needs_envelope", False):
                if taken.envelope is None:  # released before the filterbank knew that somebody wants it
                    return None
                data = stage.process(taken.data, taken.envelope)
            else:
                if hasattr(stage, "provide_envelope"):
                    stage.provide_envelope = envelope_wanted
                data = stage.process(taken.data)
            return Block(
                taken.number, data, taken.next_index, float(stage.output_rate), getattr(stage, "envelope", None)
            )

    def _apply_changes(self, taken: Block) -> None:
        later = []
        for change in self._scheduled:
            at, name, value = change
            waits = (at is not None and at > taken.number) or (
                name == _ENVELOPE_PARAMETER and value in ENVELOPE_METHODS and taken.envelope is None
            )
            if waits:
                later.append(change)
            else:
                self._stage.configure(**{name: value})
        self._scheduled = later

    def _token_back(self) -> None:
        if self.parent is None:
            return
        with self.turn:
            if self.parent is not None:
                self.parent.zone.give_back(self)
                self.parent.turn.notify_all()

    def _wait_release(self) -> bool:
        with self.turn:
            if not self._gone:
                self.state = State.WAIT_RELEASE
            while not self.zone.free and not self._gone:
                self.turn.wait()
            return not self._gone

    def _release(self, block: Block) -> bool:
        with self._publishing:
            if self._gone:
                return False
            self._set(State.RELEASE)
            self._remember(block)
            self.next_index = block.next_index
            self._listener.released(self, block)
        with self.turn:
            self.zone.release(block)
            for child in self.children:
                child.turn.notify_all()
        return True

    # --- history, for getSignals ---

    def _remember(self, block: Block) -> None:
        rows, capacity = block.data.shape[:-1], int(self.history_seconds * block.rate + 1e-9)
        if self._history is None or (self._history.rows, self._history.capacity) != (rows, capacity):
            self._history = History(rows, capacity)
        self._history.append(block.data)

    def take_signals(self) -> tuple[WindowView, int, float]:
        """What it released since the last call: data, index after it in audio frames, frames per second."""
        with self._publishing:
            if self._history is None:
                return WindowView.of(np.empty((*self.rows, 0))), self.next_index, self.rate
            return self._history.take(), self.next_index, self.rate


def subtree(processor: Processor) -> Iterable[Processor]:
    """`processor` and all below it, leaves first."""
    for child in list(processor.children):
        yield from subtree(child)
    yield processor
