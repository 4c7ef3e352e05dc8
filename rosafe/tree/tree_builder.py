"""Requests for whole trees: plan, create and roll back, while no other request changes the tree."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from time import monotonic, sleep
from typing import Any, NamedTuple

from rosafe.interface import BLOCK_AND_BUFFERS, KINDS, ROSAFE
from rosafe.representations import BUILTIN
from rosafe.tree import tree_planner
from rosafe.tree.block import Source
from rosafe.tree.processor import Processor
from rosafe.tree.tree import Tree
from rosafe.tree.tree_planner import ExistingProcessor, NewProcessor, TreePlan, TreeRequest

POLL_SECONDS = 0.02
INPUT_VALUES = tuple(p.name for p in BLOCK_AND_BUFFERS)  # arguments of `Tree.add_input`
BEGIN_BLOCKS, BEGIN_SECONDS = 2.5, 2.0  # how long new plugins are observed: blocks, and at most seconds

Planner = Callable[[Sequence[ExistingProcessor]], TreePlan]
# Called with the input to create and a function: waits for sound, and calls the function with the source of the sound.
# It returns the created input, or None if another client has created one meanwhile. Without a call, the request is
# planned again. ComponentErrors end the request.
OpenInput = Callable[[NewProcessor, Callable[[Source], Processor | None]], None]


class RequestResult(NamedTuple):
    """The processors of a requested representation.

    Attributes
    ----------
    name, kind : str
        Of the representation's processor.
    dependencies : list of str
        The names from the input down to it.
    created, reused : list of str
        Those that were created, and those that existed.
    unused : list of str
        The parameters of the request that have no effect.
    """

    name: str
    kind: str
    dependencies: list[str]
    created: list[str]
    reused: list[str]
    unused: list[str]


class TreeBuilder:
    """Builds whole trees in `tree`. Safe from any thread.

    Parameters
    ----------
    tree : Tree
    on_created : callable
        Called with each processor that was created, except the input, under the tree's lock: must not block on the
        tree. If it raises an exception, all processors of the request are removed again.
    """

    def __init__(self, tree: Tree, on_created: Callable[[Processor], object]) -> None:
        self._tree = tree
        self._on_created = on_created
        self._building = threading.Lock()  # no other request uses new processors before their first blocks succeeded

    def request(self, values: Mapping[str, Any], open_input: OpenInput) -> RequestResult:
        """Create or reuse the processors for `values`, which are parameters of `interface.REQUEST`.

        All missing processors are created, or none. If a plugin fails with one of its first blocks, the created
        processors are removed again, except those with children of other clients.

        Raises
        ------
        ComponentError
            The error of the component; ``::rosAFE::e_noSuchProcessor``, with the reason, for a plugin that failed.
        """
        request = _parse(values)
        plugins = bool(set(request.kinds) - BUILTIN)
        return _result(request, self.build(lambda found: tree_planner.plan(request, found), open_input, plugins))

    def find(self, values: Mapping[str, Any]) -> RequestResult:
        """Return the result of `request` if all processors exist. Raises ``::rosAFE::e_noSuchProcessor`` if not."""
        request = _parse(values)
        found = tree_planner.plan(request, self.processors())
        if found.steps:
            missing = ", ".join(KINDS[step.kind].request for step in found.steps)
            raise ROSAFE.error("e_noSuchProcessor", what=f"there is none with these parameters; missing: {missing}")
        return _result(request, found)

    def build(self, plan: Planner, open_input: OpenInput, plugins: bool = False) -> TreePlan:
        """Return the plan for the existing processors after it has been executed, completely or not at all.

        `plan` is called under the tree's lock, again after the sound of a new input has arrived. With `plugins`, the
        first blocks of the created processors are awaited.
        """
        executed: list[TreePlan] = []
        planned = TreePlan([], [])

        def execute(source: Source | None) -> Processor | None:
            nonlocal planned
            with self._building:
                with self._tree.lock:
                    planned = plan(self.processors())
                    if source is None and planned.new_input is not None:
                        return None
                    created = self._create(planned.steps, source)
                if plugins and created:
                    self._observe_begin(created)
            executed.append(planned)
            if planned.new_input is not None:
                return created[0]
            if source is not None:
                source.stop()
            return None

        execute(None)
        while not executed:
            assert planned.new_input is not None
            open_input(planned.new_input, execute)
            if not executed:
                execute(None)
        return executed[0]

    def _create(self, steps: Sequence[NewProcessor], source: Source | None) -> list[Processor]:
        created: list[Processor] = []
        try:
            for step in steps:
                if step.parent:
                    created.append(self._tree.add(step.kind, step.name, step.parent, step.parameters))
                    self._on_created(created[-1])
                else:
                    assert source is not None
                    frames, port, history = (step.input_values[name] for name in INPUT_VALUES)
                    created.append(self._tree.add_input(step.name, source, frames, port, history, step.parameters))
        except BaseException:
            for processor in reversed(created):
                self._tree.end(processor)
            raise
        return created

    def _observe_begin(self, created: Sequence[Processor]) -> None:
        """Raise ComponentError if one of the new processors fails in one of its first blocks, as plugins may."""
        block = self._tree.input_values[INPUT_VALUES[0]] / self._tree.sample_rate
        deadline = monotonic() + min(BEGIN_SECONDS, BEGIN_BLOCKS * block)
        names = [processor.name for processor in created]
        try:
            while monotonic() < deadline:
                for name in names:
                    self._tree.find(name)
                sleep(POLL_SECONDS)
        except BaseException:
            self.remove_unused(names)
            raise

    def remove_unused(self, names: Sequence[str]) -> list[str]:
        """Remove the processors `names`, in the order of their creation, except those with children that stay.

        Return the names of those that were removed, leaves first. Names of missing processors are ignored.
        """
        with self._tree.lock:
            found = {processor.name: processor for processor in self._tree.processors}
            removed = []
            for name in reversed(names):
                if name in found and not found[name].children:
                    self._tree.end(found.pop(name))
                    removed.append(name)
            return removed

    def processors(self) -> list[ExistingProcessor]:
        """Return all processors of the tree."""
        with self._tree.lock:
            return [one for one in (p.ask(self._describe) for p in self._tree.processors) if one is not None]

    def _describe(self, processor: Processor) -> ExistingProcessor:
        parent, values = "", processor.stage.parameters
        if processor.parent is None:
            values = values | self._tree.input_values
        else:
            parent = processor.parent.name
        return ExistingProcessor(processor.name, processor.kind, parent, values, processor.rate)


def _parse(values: Mapping[str, Any]) -> TreeRequest:
    parameters = dict(values)
    return tree_planner.parse_request(tree_planner.kind_of(parameters.pop("representation")), parameters)


def _result(request: TreeRequest, plan: TreePlan) -> RequestResult:
    kinds = [spec.kind for spec in request.specs]
    unused = tree_planner.unused(kinds, request.explicit, plan.new_input is not None)
    return RequestResult(plan.names[-1], kinds[-1].kind, plan.names, plan.created, plan.reused, unused)
