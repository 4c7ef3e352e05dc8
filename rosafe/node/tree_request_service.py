"""The service `request`: a whole tree by the node's own services, as genomixd makes one by those of the graph."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping
from typing import Any

from rosafe.component.component import ComponentNode
from rosafe.interface import ROSAFE, ComponentError
from rosafe.setups import read_parameters
from rosafe.transport import master
from rosafe.tree import tree_builder
from rosafe.tree.tree_planner import kind_of


class TreeRequestService:
    """Builds them on `node`; `heard()` is the topic that the Audio port is connected to, or nothing.

    It is what `rosafe.tree.tree_builder` asks for services.
    """

    def __init__(self, node: ComponentNode, heard: Callable[[], str]) -> None:
        self.instance = node.name.strip("/")
        self._node = node
        self._heard = heard
        self.turns = tree_builder.Turns()
        self._building = threading.Lock()  # one tree at a time: what one has found is not removed by another that fails

    def build(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Handle the service."""
        given: dict[str, Any] = {"representation": values["representation"]}
        if values["connect"]:
            given["connect"] = values["connect"]
        try:
            kind_of(values["representation"])
            given |= read_parameters(values["parameters"])
        except ValueError as problem:
            raise ROSAFE.error("e_badNewValue", what=str(problem)) from None
        with self._building:
            self.turns = tree_builder.Turns()  # of this event loop; there is nobody to give way to
            return asyncio.run(tree_builder.build(self, given))

    async def outputs(self, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """What a service of the node returns; an activity, nothing, as soon as it runs. Raises ComponentError."""
        answer = self._node.call_service(service, values)  # whoever waits, waits for this: there is nothing beside it
        whole = answer.get("response")
        return answer if whole is None else {name: getattr(whole, name) for name, _ in ROSAFE.service(service).outputs}

    async def port_connected(self, port: str) -> str:
        """The topic that an input port is connected to, or nothing."""
        return self._heard()

    async def published(self, topic: str) -> bool:
        """Whether somebody publishes `topic`."""
        try:
            return topic in master.published_topics(master.uri(), self._node.name)
        except master.MasterError as problem:
            raise ComponentError("::genom::port_io", str(problem)) from None
