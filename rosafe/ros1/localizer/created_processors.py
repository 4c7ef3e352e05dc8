"""The processors that the localizer has created in rosAFE, and which it removes at its end."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable

import rospy

from rosafe.interface import RESTORED_PARAM, ComponentError
from rosafe.ros1.client.component_client import ComponentClient
from rosafe.ros1.client.graph import Graph, NotRegisteredError
from rosafe.ros1.transport import registration


class CreatedProcessors:
    """The names of the processors, without the input, which cannot be removed.

    The private ROS parameter ~created contains them too, for a node of the same name that replaces this one; a
    restarted master gets it again.

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

    async def recall(self, graph: Graph, instance: str, node: str) -> None:
        """Read the parameter if rosAFE at the address `node` is another one than before.

        The processors of the rosAFE before it exist again if it has restored its tree (`rosAFE-ros --keep`).
        """
        if node == self.node:
            return
        stored = await _list_parameter(graph, self._parameter)
        names = stored[1:] or self.names
        if stored[:1] != [node]:
            restored = await _list_parameter(graph, f"{instance}/{RESTORED_PARAM}")
            names = [name for name in names if restored[:1] == [node] and name in restored[1:]]
        self.node, self.names = node, []
        await self._set(graph, names)

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
            stored = registration.registrar().parameters[self._parameter] = [self.node, *names]
            await graph.master("setParam", self._parameter, stored)

    async def remove(self, graph: Graph, client: ComponentClient) -> None:
        """Remove them from rosAFE, except those with children of other clients."""
        with contextlib.suppress(ComponentError):
            await client.node_outputs("removeUnused", {"names": self.names})
        await self.keep(graph, (processor.name for processor in await client.processors()))
        if not self.names:
            registration.registrar().parameters.pop(self._parameter, None)
            with contextlib.suppress(NotRegisteredError):
                await graph.master("deleteParam", self._parameter)


async def _list_parameter(graph: Graph, name: str) -> list[str]:
    """Return a ROS parameter that is a list of texts; empty if there is none."""
    try:
        value = await graph.master("getParam", name)
    except NotRegisteredError:
        return []
    return [str(item) for item in value] if isinstance(value, list) else []
