"""The tree of processors: who hangs on whom, by name, and every request that changes or asks something."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rosafe.dsp import STAGES
from rosafe.interface import KINDS, ROSAFE, ComponentError, Parameter, ProcessorKind
from rosafe.tree.processor import Processor, subtree
from rosafe.tree.roles import Listener, Observer, Source, State

MAX_BYTES = 2**30  # of one output port, of one processor's history, and of the samples that it keeps for a frame
SHARE = 0.5  # of the machine's memory, for the output ports and histories of all processors together


class Tree:
    """All processors of one component.

    Requests are atomic and may come from any thread. Errors are `ComponentError` with the original's names.

    Parameters
    ----------
    listener : Listener
        Hears of every block and every end.
    """

    def __init__(self, listener: Listener) -> None:
        self._listener = listener
        self._processors: dict[str, Processor] = {}  # in the order of creation, as getParameters reports them
        self._lock = threading.RLock()  # guards all tokens
        self._requests = threading.RLock()  # one request at a time; taken before _lock
        self._observers: list[Observer] = []
        self.sample_rate = 0.0
        self.port_seconds = 1.0
        self.history_seconds = 1.0

    # --- asking ---

    @property
    def processors(self) -> list[Processor]:
        """All processors in the order of their creation."""
        with self._requests:
            return list(self._processors.values())

    @property
    def input(self) -> Processor | None:
        """The root, if there is one."""
        return next((p for p in self.processors if p.parent is None), None)

    def find(self, name: str) -> Processor:
        """The processor called `name`, or e_noSuchProcessor."""
        with self._requests:
            try:
                return self._processors[name]
            except KeyError:
                raise ROSAFE.error("e_noSuchProcessor", f"there is no processor {name!r}") from None

    def dependencies(self, name: str) -> list[str]:
        """The names from the input down to `name`."""
        with self._requests:
            chain = []
            processor: Processor | None = self.find(name)
            while processor is not None:
                chain.append(processor.name)
                processor = processor.parent
            return chain[::-1]

    def observe(self, observer: Observer) -> Callable[[], None]:
        """Tell `observer` the state of every processor, and from now on each that one enters; returns what ends it."""
        with self._requests, self._lock:
            for processor in self._processors.values():
                observer(processor, processor.state, None)
            self._observers.append(observer)

        def end() -> None:
            with self._lock:
                self._observers.remove(observer)

        return end

    # --- building ---

    def check_input(self, name: str, sample_rate: float) -> None:
        """Whether an input could begin now (it may replace the one there is)."""
        with self._requests:
            holder = self._processors.get(name)
            if holder is not None and holder.parent is not None:
                raise ROSAFE.error("e_existsAlready", f"{name!r} exists already, of kind {holder.kind}")
            root = self.input
            if root is not None and root.children and sample_rate != self.sample_rate:
                raise ROSAFE.error(
                    "e_badNewValue",
                    what=f"the tree runs at {self.sample_rate:g} Hz, Audio is at {sample_rate:g} Hz: call Stop first",
                )

    def add_input(
        self,
        name: str,
        source: Source,
        frames_per_block: int,
        port_seconds: float,
        history_seconds: float,
        parameters: Mapping[str, Any] | None = None,
    ) -> Processor:
        """Add the input, which starts to read `source`; it takes over the children of the one it replaces.

        Histories are raised to two blocks, as the original meant to. A tree whose source has come to its end is
        removed: its processors have ended. A source that is refused is stopped.
        """
        with self._requests:
            history_seconds = max(history_seconds, 2 * frames_per_block / source.sample_rate)
            old = self.input
            try:
                self.check_input(name, source.sample_rate)
                with _refusing():
                    stage = STAGES["input"](source.sample_rate, **(parameters or {}))
                    self._check_sizes(stage, (2,), max(port_seconds, history_seconds), old)
            except ComponentError:
                source.stop()
                raise
            self.sample_rate = source.sample_rate
            self.port_seconds = port_seconds
            self.history_seconds = history_seconds
            new = self._processor(name, "input", stage, None, source)
            if old is not None:
                self._replace(old, new)
            self._begin(new)
            return new

    def _replace(self, old: Processor, new: Processor) -> None:
        """Hang all that depends on input `old` on `new`, and remove `old`; if it has ended, remove it all."""
        with self._lock:
            if old.state is not State.DONE:
                for child in list(old.children):
                    new.adopt(child)
        self._remove(old)
        for processor in self._processors.values():
            processor.history_seconds = self.history_seconds
        self._processors = {new.name: new, **self._processors}

    def check(self, kind: str, name: str, parent_name: str) -> Processor:
        """The parent of a processor that could be added now; the original's order of errors."""
        with self._requests:
            wanted = KINDS[kind].parent
            parent = self._processors.get(parent_name)
            if parent is None:
                raise ROSAFE.error("e_noUpperDependencie", f"there is no processor {parent_name!r} to hang {name!r} on")
            if name in self._processors:
                raise ROSAFE.error("e_existsAlready", f"{name!r} exists already, of kind {self._processors[name].kind}")
            if parent.kind != wanted:
                raise ROSAFE.error(
                    "e_noUpperDependencie", f"{parent_name!r} is of kind {parent.kind}, wanted is {wanted}"
                )
            return parent

    def add(self, kind: str, name: str, parent_name: str, parameters: Mapping[str, Any] | None = None) -> Processor:
        """Add a processor of `kind` under `parent_name`; it runs when this returns."""
        with self._requests:
            parent = self.check(kind, name, parent_name)
            with _refusing():
                stage = STAGES[kind](self.sample_rate, **(parameters or {}))
                self._check_sizes(stage, parent.rows, self._longest)
            processor = self._processor(name, kind, stage, parent, None)
            self._begin(processor)
            return processor

    def _processor(
        self, name: str, kind: str, stage: Any, parent: Processor | None, source: Source | None
    ) -> Processor:
        return Processor(
            name,
            kind,
            stage,
            parent,
            source,
            self._lock,
            self._listener,
            self.history_seconds,
            failed=self.end,
            observers=self._observers,
        )

    def _begin(self, processor: Processor) -> None:
        self._processors[processor.name] = processor
        try:
            self._listener.added(processor)
            processor.start()
        except BaseException:
            self._remove(processor)
            raise

    @property
    def _longest(self) -> float:
        """Seconds of output that are kept, on a port or as history: these refer to the same blocks."""
        return max(self.port_seconds, self.history_seconds)

    def _check_sizes(
        self, stage: Any, rows: tuple[int, ...], seconds: float, instead_of: Processor | None = None
    ) -> None:
        """ValueError where `stage`, given blocks of leading shape `rows`, would fill the memory.

        That is with `seconds` of output or with the samples of one frame, its own or of those that it takes over from
        `instead_of`, or with the output of the whole tree as it would be then.
        """
        planned = list(_planned(stage, rows, instead_of.children if instead_of is not None else ()))
        for one, given in planned:
            _check_size("port or history", seconds, one.output_rows(given), one.output_rate)
            for name, value in one.parameters.items():
                if name.endswith("_wSizeSec"):
                    _check_size(name, value, given, one.sample_rate)
        replaced = set(subtree(instead_of)) if instead_of is not None else set()
        outputs = [(one.output_rows(given), one.output_rate) for one, given in planned]
        outputs += [(other.rows, other.rate) for other in self._processors.values() if other not in replaced]
        size = sum(_bytes(seconds, *output) for output in outputs)
        share = SHARE * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        if size > share:
            raise ValueError(
                f"{seconds:g} s of output of {len(outputs)} processors take {size / 2**20:.0f} MiB, "
                f"more than {share / 2**20:.0f} MiB, which is {SHARE:.0%} of this machine's memory"
            )

    # --- changing ---

    def modify(self, name: str, parameter_name: str, text: str) -> None:
        """modifyParameter: change one parameter, given as text, from the processor's next block on."""
        with self._requests:
            processor = self.find(name)
            parameter = _parameter(KINDS[processor.kind], parameter_name)
            if parameter_name == "set_rm_scailing":  # the original's misspelt name came with misspelt values
                text = text.strip().removeprefix("_")
            with _refusing():
                value = parameter.parse(text)
                if parameter.choices:
                    value = parameter.known_word(value)
                self._change(processor, parameter.name, value)

    def schedule(self, block: int, parameter_name: str, value: Any) -> None:
        """Change a parameter, of every processor that has it, before block `block` of the input.

        Several changes come in the order of their blocks: each is checked after all that were made before it.
        """
        with self._requests, _refusing():
            for processor in self._processors.values():
                if any(parameter_name == p.name for p in KINDS[processor.kind].parameters):
                    self._change(processor, parameter_name, value, block)

    def _change(self, processor: Processor, name: str, value: Any, block: int = 0) -> None:
        rows = processor.parent.rows if processor.parent is not None else (2,)

        def accept(stage: Any) -> None:
            self._check_sizes(stage, rows, self._longest, processor)

        processor.change(name, value, accept, block)

    # --- removing ---

    def remove(self, name: str) -> list[Processor]:
        """Remove a processor and all below it, leaves first; they are gone when this returns."""
        with self._requests:
            processor = self.find(name)
            if processor.parent is None:
                raise ROSAFE.error("e_noSuchProcessor", f"{name!r} is the input, which cannot be removed: call Stop")
            return self._remove(processor)

    def end(self, processor: Processor) -> None:
        """Remove `processor` (the input too) and all below it, if it is still in the tree."""
        with self._requests:
            if self._processors.get(processor.name) is processor:
                self._remove(processor)

    def stop(self) -> None:
        """Remove everything."""
        with self._requests:
            root = self.input
            if root is not None:
                self._remove(root)

    def _remove(self, processor: Processor) -> list[Processor]:
        # Their threads may still work on one long block; nobody waits for that, and nobody will see it.
        going = list(subtree(processor))
        for one in going:
            one.remove()
            del self._processors[one.name]
        return going


def _parameter(kind: ProcessorKind, name: str) -> Parameter:
    try:
        return kind.parameter(name)
    except KeyError:
        known = ", ".join(p.name for p in kind.parameters)
        raise ROSAFE.error(
            "e_noSuchParameter", f"processors of kind {kind.kind} have no {name!r}, but: {known}"
        ) from None


@contextmanager
def _refusing() -> Iterator[None]:
    """Make e_badNewValue of any ValueError."""
    try:
        yield
    except ValueError as problem:
        raise ROSAFE.error("e_badNewValue", what=str(problem)) from None


def _planned(stage: Any, rows: tuple[int, ...], children: Iterable[Processor]) -> Iterator[tuple[Any, tuple[int, ...]]]:
    """`stage` over `children`, and all stages below: each with the leading shape of the blocks that it would get."""
    yield stage, rows
    for child in children:
        yield from _planned(child.stage, stage.output_rows(rows), child.children)


def _bytes(seconds: float, rows: tuple[int, ...], rate: float) -> float:
    return math.prod(rows, start=8.0 * rate * seconds)


def _check_size(what: str, seconds: float, rows: tuple[int, ...], rate: float) -> None:
    size = _bytes(seconds, rows, rate)
    if size > MAX_BYTES:
        shape = "x".join(map(str, rows))
        raise ValueError(
            f"{what}: {seconds:g} s of {shape} values at {rate:g} Hz take {size / 2**20:.0f} MiB, "
            f"more than {MAX_BYTES // 2**20} MiB"
        )
