"""The processors that the localizer has created in rosAFE, and which it removes at its end."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable

import rospy

from rosafe.client.component_client import ComponentClient
from rosafe.client.graph import Graph, NotRegisteredError
from rosafe.tree import tree_builder


class CreatedProcessors:
    """The names of the processors, without the input, which cannot be removed.

    The private ROS parameter ~created contains them too, for a node of the same name that replaces this one.

    Attributes
    ----------
    names : list of str
        In the order of their creation.
    node : str
        The address of the rosAFE that has them.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self.node = ""
        self._parameter = rospy.resolve_name("~created")

    async def recall(self, graph: Graph, node: str) -> None:
        """Read the parameter if rosAFE at the address `node` is another one than before."""
        if node != self.node:
            self.node, self.names = node, []
            with contextlib.suppress(NotRegisteredError):
                kept = await graph.master("getParam", self._parameter)
                if isinstance(kept, list) and kept[:1] == [node]:
                    self.names = [str(name) for name in kept[1:]]

    async def add(self, graph: Graph, names: Iterable[str]) -> None:
        """Add processors."""
        names = list(names)
        await self._set(graph, [*(name for name in self.names if name not in names), *names])

    async def keep(self, graph: Graph, existing: Iterable[str]) -> None:
        """Forget processors that no longer exist: others may be created with their names."""
        existing = set(existing)
        await self._set(graph, [name for name in self.names if name in existing])

    async def _set(self, graph: Graph, names: list[str]) -> None:
        if names != self.names:
            self.names = names
            await graph.master("setParam", self._parameter, [self.node, *names])

    async def remove(self, graph: Graph, client: ComponentClient) -> None:
        """Remove them from rosAFE, except those with children of other clients."""
        await tree_builder.remove(client, self.names)
        await self.keep(graph, (processor.name for processor in await tree_builder.list_processors(client)))
        if not self.names:
            with contextlib.suppress(NotRegisteredError):
                await graph.master("deleteParam", self._parameter)
