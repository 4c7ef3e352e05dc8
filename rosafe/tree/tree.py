"""The tree of processors: who hangs on whom, by name, and every request that changes or asks something."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

from rosafe.declarations.parameter import Parameter, short_repr
from rosafe.declarations.text import did_you_mean, join_names
from rosafe.dsp.plugin_checks import PluginError
from rosafe.dsp.stage import Stage
from rosafe.interface import KINDS, ROSAFE, ComponentError
from rosafe.representations import STAGES
from rosafe.tree import sizes
from rosafe.tree.block import Source
from rosafe.tree.context import Observer, TreeContext, TreeListener
from rosafe.tree.member import EARS
from rosafe.tree.processor import Processor, subtree
from rosafe.tree.sizes import Rows
from rosafe.tree.states import State
from rosafe.tree.workers import Workers, workers_to_use

INPUT = next(kind for kind, representation in KINDS.items() if not representation.parent)


MAX_FAILURES = 20  # processors whose failures are remembered


class Failure(NamedTuple):
    """Why a processor ended by itself.

    `children` are the processors below it, which ended with it.
    """

    name: str
    kind: str
    reason: str
    children: tuple[str, ...]

    @classmethod
    def of(cls, processor: Processor) -> Failure:
        """The failure of a processor whose `error` is set; it is still in the tree."""
        error = processor.error
        reason = str(error) if isinstance(error, PluginError) else f"{type(error).__name__}: {error}"
        below = tuple(one.name for one in subtree(processor) if one is not processor)
        return cls(processor.name, processor.kind, " ".join(reason.split()), below)

    def __str__(self) -> str:
        below = f"; ended with it: {', '.join(self.children)}" if self.children else ""
        return f"{self.name} ({self.kind}) failed: {self.reason}{below}"


class Planned(NamedTuple):
    """A processor as it would be after a request."""

    processor: Processor
    stage: Stage
    rows: Rows  # that it would get


class Tree:
    """All processors of one component.

    Requests are atomic and may come from any thread. Errors are `ComponentError` with the original's names.

    Parameters
    ----------
    listener : Listener
        Hears of every block and every end.
    workers : int, optional
        How many threads compute. By default as many as the environment variable ROSAFE_WORKERS says, or as there are
        cores to use.

    Raises
    ------
    ValueError
        For another number of workers than 1 to 1024.
    """

    def __init__(self, listener: TreeListener, workers: int | None = None) -> None:
        self._processors: dict[str, Processor] = {}  # in the order of creation, as getParameters reports them
        self._lock = threading.RLock()  # guards all tokens
        self._requests = threading.RLock()  # one request at a time; taken before _lock
        self._failures: dict[str, Failure] = {}  # by the processor's name
        self._workers = Workers(self._lock, workers_to_use(workers))
        self._company = TreeContext(self._workers, listener, self.end, threading.Condition(self._lock))
        self.sample_rate = 0.0
        self.port_seconds = 1.0
        self.history_seconds = 1.0

    # --- asking ---

    @property
    def workers(self) -> int:
        """How many may compute at the same time."""
        return self._workers.count

    @property
    def processors(self) -> list[Processor]:
        """All processors in the order of their creation."""
        with self._requests:
            return list(self._processors.values())

    @property
    def input(self) -> Processor | None:
        """The root, if there is one."""
        with self._requests:
            return next((p for p in self._processors.values() if p.parent is None), None)

    @property
    def failures(self) -> list[Failure]:
        """The processors that ended by themselves, oldest first; without those that were created again since."""
        with self._requests:
            return list(self._failures.values())

    def find(self, name: str) -> Processor:
        """The processor called `name`, or e_noSuchProcessor."""
        with self._requests:
            try:
                return self._processors[name]
            except KeyError:
                raise ROSAFE.error("e_noSuchProcessor", self._no_processor(name)) from None

    def _no_processor(self, name: str) -> str:
        failure = self._failures.get(name)
        reason = f": {failure}" if failure is not None else ""
        return f"there is no processor {short_repr(name)}{reason}; there are: {join_names(self._processors)}"

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
            self._company.observers.append(observer)

        def end() -> None:
            with self._lock:
                self._company.observers.remove(observer)

        return end

    # --- building ---

    def check_input(self, name: str, sample_rate: float) -> None:
        """Whether an input could begin now (it may replace the one there is)."""
        with self._requests:
            holder = self._processors.get(name)
            if holder is not None and holder.parent is not None:
                raise ROSAFE.error("e_existsAlready", f"{short_repr(name)} exists already, of kind {holder.kind}")
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
                with _as_value_error():
                    stage = STAGES[INPUT](source.sample_rate, **(parameters or {}))
                    new = Processor(name, stage, None, history_seconds, self._company, source)
                    heir = old if old is not None and old.state is not State.DONE else new
                    self._check(_planned(heir, stage, EARS, None), max(port_seconds, history_seconds), old)
            except ComponentError:
                source.stop()
                raise
            self.sample_rate = source.sample_rate
            self.port_seconds = port_seconds
            self.history_seconds = history_seconds
            if old is not None:
                self._replace(old, new)
            else:
                self._failures.clear()
            self._begin(new)
            return new

    def _replace(self, old: Processor, new: Processor) -> None:
        """Hang all that depends on input `old` on `new`, and remove `old`; if it has ended, remove it all."""
        with self._lock:
            if old.state is not State.DONE:
                for child in list(old.children):
                    child.move(new)
        self._remove(old)
        for processor in self._processors.values():
            processor.history.seconds = self.history_seconds
        self._processors = {new.name: new, **self._processors}

    def check(self, kind: str, name: str, parent_name: str) -> Processor:
        """The parent of a processor that could be added now; the original's order of errors."""
        with self._requests:
            wanted = KINDS[kind].parent
            parent = self._processors.get(parent_name)
            if parent is None:
                raise ROSAFE.error(
                    "e_noUpperDependencie", f"{self._no_processor(parent_name)}{self._descendants_of_kind(wanted)}"
                )
            if name in self._processors:
                there = self._processors[name].kind
                raise ROSAFE.error("e_existsAlready", f"{short_repr(name)} exists already, of kind {there}")
            if parent.kind != wanted:
                raise ROSAFE.error(
                    "e_noUpperDependencie",
                    f"{short_repr(parent_name)} is of kind {parent.kind}, wanted is {wanted}"
                    f"{self._descendants_of_kind(wanted)}",
                )
            return parent

    def _descendants_of_kind(self, kind: str) -> str:
        names = [processor.name for processor in self._processors.values() if processor.kind == kind]
        return f"; of kind {kind}: {join_names(names)}"

    def add(self, kind: str, name: str, parent_name: str, parameters: Mapping[str, Any] | None = None) -> Processor:
        """Add a processor of `kind` under `parent_name`; it runs when this returns."""
        with self._requests:
            parent = self.check(kind, name, parent_name)
            with _as_value_error():
                stage = STAGES[kind](parent.signal, **(parameters or {}))
                processor = Processor(name, stage, parent, self.history_seconds, self._company)
                self._check(_planned(processor, stage, parent.output_shape, parent.stage), self._longest)
            self._begin(processor)
            return processor

    def _begin(self, processor: Processor) -> None:
        self._processors[processor.name] = processor
        self._failures.pop(processor.name, None)
        try:
            self._company.listener.on_added(processor)
            processor.start()
        except BaseException:
            self._remove(processor)
            raise

    @property
    def _longest(self) -> float:
        """Seconds of output that are kept, on a port or as history: these refer to the same blocks."""
        return max(self.port_seconds, self.history_seconds)

    def _check(self, planned: Iterable[Planned], seconds: float, instead_of: Processor | None = None) -> None:
        """ValueError where what is `final_stage` would fill the memory.

        That is with `seconds` of output or with the samples of one frame, or with the output of the whole tree as it
        would be then: without `instead_of` and all below it.
        """
        coming = [(stage, rows) for _, stage, rows in planned]
        for stage, rows in coming:
            sizes.check_stage(stage, rows, seconds)
        replaced = set(subtree(instead_of)) if instead_of is not None else set()
        others = [p for p in self._processors.values() if p not in replaced]
        sizes.check_all([*coming, *filter(None, [p.ask(_sized) for p in others])], seconds)

    # --- changing ---

    def modify(
        self,
        name: str,
        parameter_name: str,
        text: str,
        taken: Callable[[Parameter, Any], Any] = Parameter.resolve_choice,
    ) -> Processor:
        """modifyParameter: change one parameter, given as text, from the processor's next block on.

        `taken(parameter, value)` is what is taken for a value that may be an unknown word.
        """
        with self._requests:
            processor = self.find(name)
            try:
                parameter = processor.representation.parameter(parameter_name)
            except KeyError:
                known = [p.name for p in processor.representation.parameters]
                raise ROSAFE.error(
                    "e_noSuchParameter",
                    f"processors of kind {processor.kind} have no {short_repr(parameter_name)}, but: "
                    f"{join_names(known)}"
                    f"{did_you_mean(parameter_name, known)}",
                ) from None
            with _as_value_error():
                self._change(processor, parameter.name, taken(parameter, parameter.parse(text, parameter_name)))
            return processor

    def schedule(self, block: int, parameter_name: str, value: Any) -> None:
        """Change a parameter, of every processor that has it, before block `block` of the input.

        Several changes come in the order of their blocks: each is checked after all that were made before it.
        """
        with self._requests, _as_value_error():
            for processor in self._processors.values():
                if any(parameter_name == p.name for p in processor.representation.parameters):
                    self._change(processor, parameter_name, value, block)

    def _change(self, processor: Processor, name: str, value: Any, block: int = 0) -> None:
        """Change a parameter if all processors below can go on then; else ValueError, and nothing has changed."""
        changed = processor.changes.preview(name, value)
        above = None if processor.parent is None else processor.parent.stage
        planned = list(_planned(processor, changed, processor.input_shape, above))
        self._check(planned, self._longest, processor)
        for one, stage, _ in planned:
            one.changes.final_stage = stage
        processor.changes.enqueue(changed, name, value, block)

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
                if processor.error is not None:
                    self._failures[processor.name] = Failure.of(processor)
                    for name in list(self._failures)[:-MAX_FAILURES]:
                        del self._failures[name]
                self._remove(processor)

    def skip(self, processor: Processor, block: int) -> None:
        """Let all others continue while `processor` still computes its block number `block`: it misses blocks then."""
        with self._lock:
            if processor.state is State.EXEC and processor.blocks == block and not processor.skipped:
                processor.skip()
                self._workers.wake()

    def stop(self) -> None:
        """Remove everything. Workers may still be at a block each, of which nobody will hear."""
        with self._requests:
            root = self.input
            if root is not None:
                self._remove(root)

    def join(self) -> None:
        """After `stop`, wait until the workers have ended."""
        self._workers.join()

    def _remove(self, processor: Processor) -> list[Processor]:
        # Their threads may still work on one long block; nobody waits for that, and nobody will see it.
        going = list(subtree(processor))
        for one in going:
            one.end()
            del self._processors[one.name]
        return going


@contextmanager
def _as_value_error() -> Iterator[None]:
    """Make e_badNewValue of any ValueError."""
    try:
        yield
    except ValueError as problem:
        raise ROSAFE.error("e_badNewValue", what=str(problem)) from None


def _planned(processor: Processor, stage: Stage, rows: Rows, above: Stage | None) -> Iterator[Planned]:
    """`processor` with `stage`, and all below it as they would be then; ValueError where one could not go on.

    `above` is the stage of its parent.
    """
    if above is not None and stage.required_extra and stage.required_extra not in above.EXTRAS:
        raise ValueError(f"{processor.kind} needs the {stage.required_extra} of {above.REPRESENTATION}, which has none")
    yield Planned(processor, stage, rows)
    for child in list(processor.children):
        below = child.ask(
            lambda one: list(
                _planned(one, one.changes.preview_input(stage.output_format), stage.output_rows(rows), stage)
            )
        )
        yield from below or ()


def _sized(processor: Processor) -> tuple[Stage, Rows]:
    """The stage of a processor and the rows of its input, once the stage has answered what its sizes are."""
    stage, rows = processor.stage, processor.input_shape
    sizes.output_size(stage, rows, 0.0)
    sizes.state_size(stage, rows)
    return stage, rows
