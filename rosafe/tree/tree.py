"""The tree of processors: who hangs on whom, by name, and every request that changes or asks something."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from rosafe.dsp import STAGES
from rosafe.interface import KINDS, ROSAFE, ProcessorKind
from rosafe.tree.processor import Listener, Processor, Source, subtree

MAX_WINDOW_BYTES = 2**30  # of one output port or one processor's history
_JOIN_SECONDS = 0.5  # a removed processor's thread may still be busy with one long block; nobody needs it any more


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
        self.sample_rate = 0.0
        self.port_seconds = 1.0
        self.history_seconds = 1.0
        self.error: BaseException | None = None  # of the first processor that failed

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

    # --- building ---

    def check_input(self, name: str, sample_rate: float) -> None:
        """Whether an input could begin now (it may replace the one there is)."""
        with self._requests:
            holder = self._processors.get(name)
            if holder is not None and holder.parent is not None:
                raise ROSAFE.error("e_existsAlready", f"{name!r} is a {holder.kind} processor")
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

        Histories are raised to two blocks, as the original meant to.
        """
        with self._requests:
            self.check_input(name, source.sample_rate)
            history_seconds = max(history_seconds, 2 * frames_per_block / source.sample_rate)
            _check_size((2,), source.sample_rate, max(port_seconds, history_seconds))
            old = self.input
            stage = _make_stage("input", source.sample_rate, parameters or {})
            self.sample_rate = source.sample_rate
            self.port_seconds = port_seconds
            self.history_seconds = history_seconds
            new = self._processor(name, "input", stage, None, source)
            others = [p for p in self._processors.values() if p is not old]
            for child in list(old.children) if old is not None else ():
                new.adopt(child)
            for processor in others:
                processor.history_seconds = history_seconds
            if old is not None:
                old.remove()
            self._processors = {p.name: p for p in (new, *others)}
            self._listener.added(new)
            new.start()
            return new

    def check(self, kind: str, name: str, parent_name: str) -> Processor:
        """The parent of a processor that could be added now; the original's order of errors."""
        with self._requests:
            wanted = KINDS[kind].parent
            parent = self._processors.get(parent_name)
            if parent is None:
                raise ROSAFE.error("e_noUpperDependencie", f"there is no processor {parent_name!r} to hang {name!r} on")
            if name in self._processors:
                raise ROSAFE.error("e_existsAlready", f"there is a {self._processors[name].kind} {name!r} already")
            if parent.kind != wanted:
                raise ROSAFE.error("e_noUpperDependencie", f"{parent_name!r} is a {parent.kind}, wanted is a {wanted}")
            return parent

    def add(self, kind: str, name: str, parent_name: str, parameters: Mapping[str, Any] | None = None) -> Processor:
        """Add a processor of `kind` under `parent_name`; it runs when this returns."""
        with self._requests:
            parent = self.check(kind, name, parent_name)
            stage = _make_stage(kind, self.sample_rate, parameters or {})
            _check_size(stage.output_rows(parent.rows), stage.output_rate, max(self.port_seconds, self.history_seconds))
            processor = self._processor(name, kind, stage, parent, None)
            self._processors[name] = processor
            self._listener.added(processor)
            processor.hang_on(parent)
            processor.start()
            return processor

    def _processor(
        self, name: str, kind: str, stage: Any, parent: Processor | None, source: Source | None
    ) -> Processor:
        return Processor(
            name, kind, stage, parent, source, self._lock, self._listener, self.history_seconds, self._failed
        )

    # --- changing ---

    def modify(self, name: str, parameter_name: str, text: str) -> None:
        """modifyParameter: change one parameter, given as text, from the processor's next block on."""
        with self._requests:
            processor = self.find(name)
            parameter = _parameter(KINDS[processor.kind], parameter_name)
            if parameter_name == "set_rm_scailing":  # the original's misspelt name came with misspelt values
                text = text.strip().removeprefix("_")
            try:
                value = parameter.parse(text)
                if parameter.choices:
                    value = parameter.known_word(value)
                processor.configure(parameter.name, value, lambda stage: self._check_sizes(processor, stage))
            except ValueError as problem:
                raise ROSAFE.error("e_badNewValue", what=str(problem)) from None

    def schedule(self, block: int, parameter_name: str, value: Any) -> None:
        """Change a parameter, of every processor that has it, before block `block` of the input."""
        with self._requests:
            for processor in self._processors.values():
                if any(parameter_name == p.name for p in KINDS[processor.kind].parameters):
                    processor.schedule(block, parameter_name, value)

    def _check_sizes(self, processor: Processor, stage: Any) -> None:
        """Refuse a changed `stage` where its windows, or those of processors below, would get absurdly large."""
        seconds = max(self.port_seconds, self.history_seconds)
        rows = stage.output_rows(processor.parent.rows if processor.parent is not None else (2,))
        _check_size(rows, stage.output_rate, seconds)
        for child in processor.children:
            child.check_rows(rows, lambda rows, rate: _check_size(rows, rate, seconds))

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
        going = list(subtree(processor))
        for one in going:
            one.remove()
            del self._processors[one.name]
        for one in going:
            if one.is_this_thread:
                continue
            one.join(_JOIN_SECONDS)
        return going

    def _failed(self, processor: Processor) -> None:
        # On the processor's own thread, which holds no lock here.
        with self._requests:
            self.error = self.error or processor.error
            self.end(processor)

    def wait_done(self) -> None:
        """Wait until every processor has come to the end of the input; raises what a processor failed with."""
        for processor in self.processors:
            processor.join()
        if self.error is not None:
            raise self.error


def _parameter(kind: ProcessorKind, name: str) -> Any:
    try:
        return kind.parameter(name)
    except KeyError:
        known = ", ".join(p.name for p in kind.parameters)
        raise ROSAFE.error("e_noSuchParameter", f"a {kind.kind} processor has no {name!r}, but: {known}") from None


def _make_stage(kind: str, sample_rate: float, parameters: Mapping[str, Any]) -> Any:
    try:
        return STAGES[kind](sample_rate, **parameters)
    except ValueError as problem:
        raise ROSAFE.error("e_badNewValue", what=str(problem)) from None


def _check_size(rows: tuple[int, ...], rate: float, seconds: float) -> None:
    size = 8.0 * rate * seconds
    for length in rows:
        size *= length
    if size > MAX_WINDOW_BYTES:
        raise ROSAFE.error(
            "e_badNewValue",
            what=f"{seconds:g} s of {'x'.join(map(str, rows))} values at {rate:g} Hz are {size / 2**20:.0f} MiB, "
            f"more than {MAX_WINDOW_BYTES // 2**20} MiB",
        )
