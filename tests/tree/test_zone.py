"""The token protocol alone: every state that a small tree can get into, by every order of steps."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from rosafe.tree.zone import Block, SharedZone

NOTHING = np.zeros((2, 0))
LAST = 2  # blocks 0 to LAST


@dataclass
class Node:
    """A processor without its thread: what `Processor` does under the lock, as single steps."""

    name: str
    parent: str = ""
    attached: bool = False
    gone: bool = False
    finished: bool = False
    reading: int | None = None
    private: int | None = None
    begins: int | None = None  # the first block that it should see; None: any
    seen: list[int] = field(default_factory=list)
    zone: SharedZone = field(default_factory=SharedZone)

    def copy(self) -> Node:
        twin, zone = copy.copy(self), copy.copy(self.zone)
        for group in ("_children", "_fresh", "_held"):
            setattr(zone, group, set(getattr(zone, group)))
        twin.seen, twin.zone = list(self.seen), zone
        return twin


class World:
    """A root with two children, one of which has a child of its own; all but the root may come and go."""

    def __init__(self, nodes: dict[str, Node]) -> None:
        self.nodes = nodes

    def fingerprint(self) -> tuple[object, ...]:
        return tuple(
            (
                *(node.attached, node.gone, node.finished, node.reading, node.private, tuple(node.seen)),
                *(node.zone.block.number if node.zone.block else None, node.zone._closed),
                *(frozenset(group) for group in (node.zone._children, node.zone._fresh, node.zone._held)),
            )
            for node in self.nodes.values()
        )

    def steps(self) -> Iterator[tuple[str, str]]:
        """All that can happen next, each as a name and a step."""
        for name, node in self.nodes.items():
            for step in ("come", "go", "take", "give_back", "release", "end"):
                if getattr(self, f"can_{step}")(node):
                    yield name, step

    def after(self, name: str, step: str) -> World:
        """The world after that step. What the step does not touch is shared."""
        nodes = dict(self.nodes)
        for node in self.nodes.values():
            if name in (node.name, node.parent) or node.name == nodes[name].parent:
                nodes[node.name] = node.copy()
        world = World(nodes)
        getattr(world, step)(nodes[name])
        return world

    def above(self, node: Node) -> SharedZone:
        return self.nodes[node.parent].zone

    # a child comes, or goes with its own child

    def can_come(self, node: Node) -> bool:
        if not node.parent:
            return False
        parent = self.nodes[node.parent]
        return not node.attached and parent.attached and not parent.gone

    def come(self, node: Node) -> None:
        node.attached = True
        zone = self.above(node)
        if zone.block is not None:
            node.begins = zone.block.number
        zone.attach(node.name)

    def can_go(self, node: Node) -> bool:
        return node.attached and not node.gone and bool(node.parent)

    def go(self, node: Node) -> None:
        for child in self.nodes.values():
            if child.parent == node.name and not child.gone:
                child.attached = child.gone = True
                node.zone.detach(child.name)
        node.gone = True
        self.above(node).detach(node.name)

    # the steps of a processor

    def can_take(self, node: Node) -> bool:
        idle = node.attached and not node.gone and not node.finished and node.reading is None and node.private is None
        if not node.parent:
            return idle and len(node.seen) <= LAST
        return idle and self.above(node).has_token(node.name)

    def take(self, node: Node) -> None:
        number = self.above(node).take(node.name).number if node.parent else len(node.seen)
        node.reading = number
        node.seen.append(number)

    def can_give_back(self, node: Node) -> bool:
        return node.reading is not None  # also one that was removed in the middle of its work

    def give_back(self, node: Node) -> None:
        if node.parent:
            self.above(node).give_back(node.name)
        node.reading, node.private = None, node.reading

    def can_release(self, node: Node) -> bool:
        return not node.gone and node.private is not None and node.zone.free

    def release(self, node: Node) -> None:
        assert node.private is not None
        node.zone.release(Block(node.private, NOTHING, 0, 1.0))
        node.private = None

    def can_end(self, node: Node) -> bool:
        idle = node.attached and not node.gone and not node.finished and node.reading is None and node.private is None
        if not node.parent:
            return idle and len(node.seen) > LAST
        return idle and self.above(node).exhausted(node.name)

    def end(self, node: Node) -> None:
        node.finished = True
        node.zone.close()
        if node.parent:
            self.above(node).detach(node.name)

    def check(self) -> None:
        """What holds at any moment."""
        for node in self.nodes.values():
            assert node.seen == list(range(node.seen[0], node.seen[-1] + 1) if node.seen else [])
            if node.seen and node.begins is not None:
                assert node.seen[0] == node.begins
            if node.zone.block is not None:
                for child in self.nodes.values():
                    if child.parent == node.name and child.reading is not None and not child.gone:
                        assert child.reading == node.zone.block.number, "a block changed under its reader"

    def check_end(self) -> None:
        """What holds where nothing can happen any more."""
        for node in self.nodes.values():
            if node.attached and not node.gone:
                assert node.finished, f"{node.name} waits for ever"
                assert not node.zone._held
                if node.seen or node.begins is not None:
                    assert node.seen[-1] == LAST


@pytest.mark.long
def test_every_order_of_steps() -> None:
    """All reachable states: every child sees a contiguous run from where it came to the end, and nobody waits in vain.

    The ends are those states in which nobody else comes or goes and all that is left to do is done.
    """
    nodes = (Node("root", attached=True), Node("a", "root"), Node("b", "root"), Node("c", "a"))
    start = World({node.name: node for node in nodes})
    known = {start.fingerprint()}
    unexplored = [start]
    ends = 0
    while unexplored:
        world = unexplored.pop()
        steps = list(world.steps())
        if all(step in ("come", "go") for _, step in steps):
            world.check_end()
            ends += 1
        for name, step in steps:
            following = world.after(name, step)
            following.check()
            mark = following.fingerprint()
            if mark not in known:
                known.add(mark)
                unexplored.append(following)
    assert len(known) > 5_000
    assert ends > 50


def test_a_release_while_a_child_holds_the_block_is_refused() -> None:
    zone = SharedZone()
    zone.attach("child")
    zone.release(Block(0, NOTHING, 0, 1.0))
    assert zone.take("child").number == 0
    with pytest.raises(RuntimeError, match="while a child holds"):
        zone.release(Block(1, NOTHING, 0, 1.0))
    assert zone.block is not None
    assert zone.block.number == 0


def test_a_token_is_taken_once() -> None:
    zone = SharedZone()
    zone.release(Block(0, NOTHING, 0, 1.0))
    zone.attach("late")
    assert zone.has_token("late")
    zone.take("late")
    with pytest.raises(KeyError):
        zone.take("late")


def test_siblings_read_the_same_memory() -> None:
    zone = SharedZone()
    data = np.zeros((2, 3))
    for child in "abc":
        zone.attach(child)
    zone.release(Block(0, data, 3, 1.0))
    assert all(zone.take(child).data is data for child in "abc")
    assert not zone.free
    for child in "abc":
        zone.give_back(child)
    assert zone.free
