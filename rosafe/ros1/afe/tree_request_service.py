"""The service `request`: builds a whole tree with the node's own services."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping
from typing import Any

import rospy

from rosafe.interface import ROSAFE, ComponentError
from rosafe.ros1.component.component import ComponentNode
from rosafe.ros1.transport import master
from rosafe.setups import read_parameters
from rosafe.tree import tree_builder
from rosafe.tree.tree_planner import kind_of


class TreeRequestService:
    """Builds trees on `node`, as the `Services` of `rosafe.tree.tree_builder`.

    `audio_topic()` returns the topic to which the Audio port is connected, or ''.
    """

    def __init__(self, node: ComponentNode, audio_topic: Callable[[], str]) -> None:
        self.node = node.name
        self._component = node
        self._audio_topic = audio_topic
        self.turns = tree_builder.Turns()
        self._building = threading.Lock()  # one tree at a time: a failing request must not remove another's processors

    def build(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Handle the service."""
        explicit = {name: values[name] for name in ("representation", "connect") if values[name]}
        try:
            kind_of(values["representation"])
            explicit |= read_parameters(values["parameters"])
        except ValueError as problem:
            raise ROSAFE.error("e_badNewValue", what=str(problem)) from None
        with self._building:
            self.turns = tree_builder.Turns()  # of this event loop, in which no other request runs
            return asyncio.run(tree_builder.build(self, explicit))

    async def outputs(self, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Call a service of the node; an activity has no outputs, and is running then. Raises ComponentError."""
        outputs = self._component.call_service(service, values)  # may block the event loop, which has no other task
        message = outputs.get("response")
        if message is None:
            return outputs
        return {name: getattr(message, name) for name, _ in ROSAFE.service(service).outputs}

    async def port_connected(self, port: str) -> str:
        """Return the topic to which an input port is connected, or ''."""
        return self._audio_topic()

    async def published(self, topic: str) -> bool:
        """Return whether `topic` has a publisher."""
        try:
            return rospy.resolve_name(topic) in master.published_topics(master.uri(), self.node)
        except master.MasterError as problem:
            raise ComponentError("::genom::port_io", str(problem)) from None
