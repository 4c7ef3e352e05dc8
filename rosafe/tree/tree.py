"""The tree of processors, and the requests that build, change and query it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.text import did_you_mean, join_names, short_repr
from rosafe.dsp.plugin_checks import PluginError
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage
from rosafe.interface import BLOCK_AND_BUFFERS, KINDS, ROSAFE, ComponentError
from rosafe.representations import STAGES
from rosafe.tree import sizes
from rosafe.tree.block import Source
from rosafe.tree.processor import Observer, Processor, TreeContext, TreeListener, subtree
from rosafe.tree.states import State
from rosafe.tree.workers import Workers, workers_to_use

MAX_FAILURES = 20  # that are kept


class Failure(NamedTuple):
    """The failure of a processor. `children` are its descendants, which were removed with it."""

    name: str
    kind: str
    reason: str
    children: tuple[str, ...]

    @classmethod
    def of(cls, processor: Processor) -> Failure:
        """Return the failure of a processor whose `error` is set and which is still in the tree."""
        error = processor.error
        reason = str(error) if isinstance(error, PluginError) else f"{type(error).__name__}: {error}"
        below = tuple(one.name for one in subtree(processor) if one is not processor)
        return cls(processor.name, processor.kind, " ".join(reason.split()), below)

    def __str__(self) -> str:
        below = f"; ended with it: {', '.join(self.children)}" if self.children else ""
        return f"{self.name} ({self.kind}) failed: {self.reason}{below}"


class ProcessorPreview(NamedTuple):
    """A processor with the stage, and the leading shape of its input, that it would have after a request."""

    processor: Processor
    stage: Stage
    rows: sizes.Rows


INPUT = next(kind for kind, representation in KINDS.items() if not representation.parent)


class Tree:
    """All processors of one component.

    Requests are atomic and may be called from any thread. They raise `ComponentError` with the original's exceptions.

    Parameters
    ----------
    listener : TreeListener
        Is notified of every block and every removal.
    workers, real_time : int (optional), bool
        See `Workers`; by default as many as `workers_to_use` returns, which raises ValueError beyond its limits.

    Attributes
    ----------
    lock : threading.RLock
        Held by each request. A caller that holds it makes several requests as one.
    input_values : dict
        The parameters of the input's request, by their names in the interface: its block and its buffers.
    """

    def __init__(self, listener: TreeListener, workers: int | None = None, real_time: bool = False) -> None:
        self._by_name: dict[str, Processor] = {}  # in the order of creation, in which getParameters reports them
        self._failures: dict[str, Failure] = {}  # oldest first, without processors that were created again
        self._lock = threading.RLock()  # guards all tokens
        self.lock = threading.RLock()  # acquired before _lock
        self._workers = Workers(self._lock, workers_to_use(workers), real_time)
        self._context = TreeContext(self._workers, listener, self.end, threading.Condition(self._lock))
        self.wait_idle = self._workers.wait_idle
        self.sample_rate = 0.0
        self.port_seconds = self.history_seconds = 1.0
        self.input_values: dict[str, Any] = {}

    # --- queries ---

    @property
    def workers(self) -> int:
        """The maximum number of processors that compute at the same time."""
        return self._workers.count

    @property
    def processors(self) -> list[Processor]:
        """All processors in the order of their creation."""
        with self.lock:
            return list(self._by_name.values())

    @property
    def input(self) -> Processor | None:
        """The root, if there is one."""
        with self.lock:
            return next((p for p in self._by_name.values() if p.parent is None), None)

    @property
    def failures(self) -> list[Failure]:
        """The processors that failed, oldest first, without those that were created again."""
        with self.lock:
            return list(self._failures.values())

    def find(self, name: str) -> Processor:
        """Return the processor called `name`. Raises e_noSuchProcessor."""
        with self.lock:
            if name not in self._by_name:
                raise ROSAFE.error("e_noSuchProcessor", self._missing(name))
            return self._by_name[name]

    def _missing(self, name: str) -> str:
        reason = f": {self._failures[name]}" if name in self._failures else ""
        return f"there is no processor {short_repr(name)}{reason}; there are: {join_names(self._by_name)}"

    def dependencies(self, name: str) -> list[str]:
        """Return the names from the input down to `name`."""
        with self.lock:
            chain = [self.find(name)]
            while (parent := chain[-1].parent) is not None:
                chain.append(parent)
            return [processor.name for processor in reversed(chain)]

    def observe(self, observer: Observer) -> Callable[[], None]:
        """Call `observer` with each processor's state, now and after each change; return a function that ends this."""
        with self.lock, self._lock:
            for processor in self._by_name.values():
                observer(processor, processor.state, None)
            self._context.observers.append(observer)

        def end() -> None:
            with self._lock:
                self._context.observers.remove(observer)

        return end

    # --- add processors ---

    def check_input(self, name: str, sample_rate: float) -> None:
        """Raise ComponentError if no input can start now. It may replace the present one."""
        with self.lock:
            holder = self._by_name.get(name)
            if holder is not None and holder.parent is not None:
                raise _already_exists(holder)
            root = self.input
            if root is not None and root.children and sample_rate != self.sample_rate:
                rates = f"the tree runs at {self.sample_rate:g} Hz, Audio is at {sample_rate:g} Hz"
                raise ROSAFE.error("e_badNewValue", what=f"{rates}: call Stop first")

    def add_input(
        self,
        name: str,
        source: Source,
        frames_per_block: int,
        port_seconds: float,
        history_seconds: float,
        parameters: Mapping[str, Any] | None = None,
        ears: int = 2,
    ) -> Processor:
        """Add the input, which starts to read `source`. It takes over the children of an input that it replaces.

        Histories are raised to two blocks, as the original intended. A tree whose source has ended is removed. If the
        input is rejected, `source` is stopped. Plugins, and processors that compare ears, require `ears` to be 2.
        """
        with self.lock:
            requested = (frames_per_block, port_seconds, history_seconds)
            history_seconds = max(history_seconds, 2 * frames_per_block / source.sample_rate)
            old = self.input
            try:
                self.check_input(name, source.sample_rate)
                with _bad_new_value():
                    stage = STAGES[INPUT](SignalFormat.sound(source.sample_rate, ears), **(parameters or {}))
                    new = Processor(name, stage, None, history_seconds, port_seconds, self._context, source)
                    root_after = old if old is not None and old.state is not State.DONE else new
                    self._check_memory(_preview_subtree(root_after, stage), old, max(port_seconds, history_seconds))
            except ComponentError:
                source.stop()
                raise
            self.sample_rate = source.sample_rate
            self.port_seconds, self.history_seconds = port_seconds, history_seconds
            self.input_values = {p.name: value for p, value in zip(BLOCK_AND_BUFFERS, requested, strict=True)}
            if old is not None:
                self._replace(old, new)
            else:
                self._failures.clear()
            self._start(new)
            return new

    def _replace(self, old: Processor, new: Processor) -> None:
        """Move the children of input `old` to `new` and remove `old`. If `old` has ended, remove its children too."""
        with self._lock:
            if old.state is not State.DONE:
                for child in list(old.children):
                    child.move(new)
        self._remove(old)
        for processor in self._by_name.values():
            processor.history.seconds, processor.history.port_seconds = self.history_seconds, self.port_seconds
        self._by_name = {new.name: new, **self._by_name}

    def check(self, kind: str, name: str, parent_name: str) -> Processor:
        """Return the parent of a processor that can be added now. Raises ComponentError in the original's order.

        ``e_noUpperDependencie`` if the parent is missing or of the wrong kind; ``e_existsAlready`` if `name` is in use.
        """
        expected = KINDS[kind].parent
        with self.lock:
            names = join_names([p.name for p in self._by_name.values() if p.kind == expected])
            known = f"; of kind {expected}: {names}"
            parent = self._by_name.get(parent_name)
            if parent is None:
                raise ROSAFE.error("e_noUpperDependencie", f"{self._missing(parent_name)}{known}")
            if name in self._by_name:
                raise _already_exists(self._by_name[name])
            if parent.kind != expected:
                text = f"expected a processor of kind {expected}, got kind {parent.kind}{known}"
                raise ROSAFE.error("e_noUpperDependencie", f"{short_repr(parent_name)}: {text}")
            return parent

    def add(self, kind: str, name: str, parent_name: str, parameters: Mapping[str, Any] | None = None) -> Processor:
        """Add a processor of `kind` below `parent_name`. It is running when this returns."""
        with self.lock:
            parent = self.check(kind, name, parent_name)
            with _bad_new_value():
                stage = STAGES[kind](parent.signal, **(parameters or {}))
                processor = Processor(name, stage, parent, self.history_seconds, self.port_seconds, self._context)
                self._check_memory(_preview_subtree(processor, stage))
            self._start(processor)
            return processor

    def _start(self, processor: Processor) -> None:
        self._by_name[processor.name] = processor
        self._failures.pop(processor.name, None)
        try:
            self._context.listener.on_added(processor)
            processor.start()
        except BaseException:
            self._remove(processor)
            raise

    def _check_memory(
        self, previews: list[ProcessorPreview], replaced: Processor | None = None, seconds: float | None = None
    ) -> None:
        """Raise ValueError if the previewed processors, instead of the subtree of `replaced`, need too much memory."""
        limit = max(self.port_seconds, self.history_seconds) if seconds is None else seconds  # of the same blocks
        without = set(subtree(replaced)) if replaced is not None else set()
        for _, stage, rows in previews:
            sizes.check_stage(stage, rows, limit)
        taken = [sizes.total_size(stage, rows, limit) for _, stage, rows in previews]
        for other in list(self._by_name.values()):
            if other not in without:
                taken.append(other.ask(lambda one: sizes.total_size(one.stage, one.input_shape, limit)) or 0.0)
        sizes.check_all(taken, limit)

    # --- change parameters ---

    def modify(
        self,
        name: str,
        parameter_name: str,
        text: str,
        resolve: Callable[[Parameter, Any], Any] = Parameter.resolve_choice,
    ) -> Processor:
        """modifyParameter: change one parameter, given as text, from the processor's next block on.

        `resolve(parameter, value)` returns the value to use for a value that may be an unknown choice.
        """
        with self.lock:
            processor = self.find(name)
            parameter = _find_parameter(processor, parameter_name)
            with _bad_new_value():
                self._change(processor, parameter.name, resolve(parameter, parameter.parse(text, parameter_name)))
            return processor

    def schedule(self, block: int, parameter_name: str, value: Any) -> None:
        """Change a parameter of every processor that has it before block `block` of the input.

        The blocks of successive calls ascend: each change is checked after all previous ones.
        """
        with self.lock, _bad_new_value():
            for processor in self._by_name.values():
                if any(parameter_name == p.name for p in processor.representation.parameters):
                    self._change(processor, parameter_name, value, block)

    def _change(self, processor: Processor, name: str, value: Any, block: int = 0) -> None:
        """Change a parameter. If a descendant rejects the change, raise ValueError and change nothing."""
        changed = processor.changes.preview(name, value)
        previews = _preview_subtree(processor, changed)
        self._check_memory(previews, replaced=processor)
        for one, stage, _ in previews:
            one.changes.final_stage = stage
        processor.changes.enqueue(changed, name, value, block)

    # --- remove processors ---

    def remove(self, name: str) -> list[Processor]:
        """Remove a processor and its descendants, leaves first, and return them."""
        with self.lock:
            processor = self.find(name)
            if processor.parent is None:
                raise ROSAFE.error("e_noSuchProcessor", f"{name!r} is the input, which cannot be removed: call Stop")
            return self._remove(processor)

    def end(self, processor: Processor) -> None:
        """Remove `processor`, which may be the input, and its descendants, if it is still in the tree."""
        with self.lock:
            if self._by_name.get(processor.name) is processor:
                if processor.error is not None:
                    self._failures[processor.name] = Failure.of(processor)
                    for name in list(self._failures)[:-MAX_FAILURES]:
                        del self._failures[name]
                self._remove(processor)

    def skip(self, processor: Processor, block: int) -> None:
        """Let all others continue while `processor` still computes block number `block`. It misses blocks then."""
        with self._lock:
            if processor.state is State.EXEC and processor.blocks == block and not processor.skipped:
                processor.skip()
                self._workers.wake()

    def stop(self) -> None:
        """Remove all processors. Each worker may still compute a block, whose result is discarded."""
        with self.lock:
            if (root := self.input) is not None:
                self._remove(root)

    def join(self) -> None:
        """Wait until the workers have ended, after `stop`."""
        self._workers.join()

    def _remove(self, processor: Processor) -> list[Processor]:
        removed = list(subtree(processor))
        for one in removed:  # a worker may still compute a long block of it: this is not waited for
            one.end()
            del self._by_name[one.name]
        return removed


def _already_exists(processor: Processor) -> ComponentError:
    """Return the error of a request to add a processor with the name of an existing one."""
    return ROSAFE.error("e_existsAlready", f"{short_repr(processor.name)} exists already, of kind {processor.kind}")


def _preview_subtree(processor: Processor, stage: Stage) -> list[ProcessorPreview]:
    """Return the preview of `processor` with `stage`, and those of its descendants.

    Raises ValueError if one of them rejects the request.
    """
    parent_stage = None if processor.parent is None else processor.parent.stage
    return list(_previews(processor, stage, processor.input_shape, parent_stage))


def _previews(
    processor: Processor, stage: Stage, rows: sizes.Rows, parent_stage: Stage | None
) -> Iterator[ProcessorPreview]:
    extra = stage.required_extra
    if parent_stage is not None and extra and extra not in parent_stage.EXTRAS:
        raise ValueError(f"{processor.kind} needs the {extra} of {parent_stage.REPRESENTATION}, which has none")
    yield ProcessorPreview(processor, stage, rows)

    def preview_child(child: Processor) -> list[ProcessorPreview]:
        changed = child.changes.preview_input(stage.output_format)
        return list(_previews(child, changed, stage.output_rows(rows), stage))

    for child in list(processor.children):
        yield from child.ask(preview_child) or ()


def _find_parameter(processor: Processor, name: str) -> Parameter:
    try:
        return processor.representation.parameter(name)
    except KeyError:
        known = [p.name for p in processor.representation.parameters]
        text = f"processors of kind {processor.kind} have no {short_repr(name)}; they have: {join_names(known)}"
        raise ROSAFE.error("e_noSuchParameter", f"{text}{did_you_mean(name, known)}") from None


@contextmanager
def _bad_new_value() -> Iterator[None]:
    """Raise e_badNewValue instead of ValueError."""
    try:
        yield
    except ValueError as problem:
        raise ROSAFE.error("e_badNewValue", what=str(problem)) from None
