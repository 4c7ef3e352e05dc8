"""The tree of the node: requests by the names of ROS 2, setups, and the sound that it processes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rosafe.interface import KINDS, ROSAFE, Representation
from rosafe.representations import BUILTIN, STAGES
from rosafe.ros2.outputs import FrameConsumer, Outputs, check_name
from rosafe.ros2.sound import Sound
from rosafe.tree import tree_planner
from rosafe.tree.health import ProcessorHealth
from rosafe.tree.processor import Processor
from rosafe.tree.setups import Setup, plan, setup_processor
from rosafe.tree.tree import Tree
from rosafe.tree.tree_builder import TreeBuilder
from rosafe.tree.tree_planner import ExistingProcessor, NewProcessor, TreePlan


class NodeTree:
    """The tree. Its requests may be called from any thread, and raise ComponentError or ValueError.

    Parameters
    ----------
    outputs : Outputs
        The listener of the tree.
    sound : Sound
    frames_per_block : int
        Of an input that is created.
    reserved : iterable of str
        Names that processors cannot have.
    log : object
        With `warning` and `error`.

    Attributes
    ----------
    tree : Tree
    health : ProcessorHealth
    consumers : list of FrameConsumer
        Get all blocks.
    find, stop, remove_unused, existing : callable
        As of `Tree` and `TreeBuilder`: find a processor by its name; remove all, or some without use; describe all.
    """

    def __init__(
        self, outputs: Outputs, sound: Sound, frames_per_block: int, reserved: Iterable[str], log: Any
    ) -> None:
        self.tree = Tree(outputs, real_time=True)
        self.health = outputs.health = ProcessorHealth(self.tree, log.warning, log.error)
        self.consumers: list[FrameConsumer] = outputs.consumers
        self.find, self.stop = self.tree.find, self.tree.stop
        self.time_of = sound.time_of
        self._builder = TreeBuilder(self.tree, lambda processor: None)
        self.remove_unused, self.existing = self._builder.remove_unused, self._builder.processors
        self._sound = sound
        self._block = frames_per_block
        self._reserved = frozenset(reserved)

    def processors(self) -> list[Processor]:
        """Return all processors, parents first."""
        return self.tree.processors

    def block(self) -> int:
        """Return the length of a block in frames."""
        reader = self._sound.reader
        return self._block if reader is None else reader.block

    def sound_rate(self) -> float:
        """Return the sample rate (Hz) at which the tree runs, or would run; 0 without sound."""
        root = self.tree.input
        return float(self._sound.ring.sample_rate) if root is None else root.rate

    def check_rate(self, rate: float) -> None:
        """Raise ``e_badNewValue`` if the tree cannot process sound at this rate (Hz); remove an input without use."""
        root = self.tree.input
        if root is not None:
            self.tree.check_input(root.name, rate)
            if rate != root.rate:
                self.tree.stop()

    # --- requests ---

    def request(self, representation: str, parameters: Mapping[str, Any], name: str = "") -> TreePlan:
        """Create or reuse the processors for a representation: see `TreeBuilder.request`. `name` is that of the last.

        A new processor is named by its kind, or by the kind and a number if there is one of this name already.
        """
        kind = tree_planner.kind_of(representation)
        request = tree_planner.parse_request(kind, {"nFramesPerBlock": self._block, **parameters})
        if name:
            check_name(name, self._reserved)

        def planned(found: Sequence[ExistingProcessor]) -> TreePlan:
            if not name:
                return _named(tree_planner.plan(request, found), found)
            others = [one for one in found if one.kind != kind.kind or one.name == name]
            plan = tree_planner.plan(request, others)
            return _named(plan, found, {plan.names[-1]: name})

        return self._builder.build(planned, self._sound.open_input, bool(set(request.kinds) - BUILTIN))

    def add(self, kind: Representation, name: str, parent: str, parameters: Mapping[str, Any]) -> str:
        """Add a processor, and return its name. An empty name or parent is that of its kind."""
        name = name or kind.name
        check_name(name, self._reserved)
        own = {p.name for p in kind.parameters}
        for other in parameters:
            if other not in own and (kind.parent or other not in tree_planner.OF_THE_INPUT):
                known = ", ".join(p.name for p in kind.parameters) or "none"
                what = f"processors of kind {kind.kind} have no {other!r}; they have: {known}"
                raise ROSAFE.error("e_noSuchParameter", what)
        if not kind.parent:
            return self.request(kind.kind, parameters, name).names[-1]
        parent = parent or KINDS[kind.parent].name
        self.tree.check(kind.kind, name, parent)
        return self.tree.add(kind.kind, name, parent, STAGES[kind.kind].request_values(parameters)).name

    def remove(self, name: str) -> list[str]:
        """Remove a processor and its descendants; return their names."""
        return [processor.name for processor in self.tree.remove(name)]

    # --- setups ---

    def load(self, setup: Setup) -> TreePlan:
        """Create the processors of a setup, all or none."""
        for processor in setup.processors:
            check_name(processor.name, self._reserved)
        return self._builder.build(lambda found: plan(setup, found), self._sound.open_input)

    def describe(self) -> Setup:
        """Return the tree as a setup, without sound."""
        return Setup(processors=tuple(map(setup_processor, self._builder.processors())))


def _named(plan: TreePlan, found: Sequence[ExistingProcessor], names: Mapping[str, str] = {}) -> TreePlan:
    """Return a plan whose new processors are named by their kind, if no other one is; `names` has other names."""
    used = {one.name for one in found}
    new = dict(names)
    for step in plan.steps:
        name = KINDS[step.kind].name
        if step.name not in new and name not in {*used, *new.values()}:
            new[step.name] = name
    steps = [
        NewProcessor(
            new.get(step.name, step.name),
            step.kind,
            new.get(step.parent, step.parent),
            step.parameters,
            step.input_values,
        )
        for step in plan.steps
    ]
    return TreePlan([new.get(name, name) for name in plan.names], steps)
