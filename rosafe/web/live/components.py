"""Requests of the page to the components: the tree, its changes and the capture of audio."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from typing import Any

from rosafe.audio.devices import device_lines
from rosafe.interface import BASS, KINDS, LOAD_SETUP, REQUEST, ROSAFE, SAVE_SETUP, ComponentError, Service
from rosafe.ros1.client.component_client import ComponentClient
from rosafe.ros1.client.description import describe_parameter
from rosafe.ros1.client.graph import Graph
from rosafe.ros1.client.tree_snapshot import TreeSnapshot
from rosafe.tree import tree_planner

Action = Callable[[Mapping[str, Any]], Awaitable[dict[str, Any]]]

TREE_TIMEOUT_SECONDS = 3.0  # for the answer to getProcessors
DEFAULT_REPRESENTATIONS = ("ratemap", "ild", "itd", "ic")  # one for each type of plot


class ComponentFacade:
    """The requests to one rosAFE and one bass.

    Parameters
    ----------
    graph : Graph
    rosafe, bass : str
        Full names of the two nodes.
    """

    def __init__(self, graph: Graph, rosafe: str, bass: str) -> None:
        self._graph = graph
        self._rosafe = ComponentClient(graph, ROSAFE, graph.shorten(rosafe))
        self._bass = ComponentClient(graph, BASS, graph.shorten(bass))

    async def close(self) -> None:
        """Close all connections."""
        await self._rosafe.close()
        await self._bass.close()

    async def tree(self) -> TreeSnapshot:
        """Return the processors; raise ComponentError if rosAFE does not answer."""
        try:
            answer = await asyncio.wait_for(self._rosafe.outputs("getProcessors", {}), TREE_TIMEOUT_SECONDS)
            return TreeSnapshot.of(answer["processors"])
        except TimeoutError:
            raise ComponentError("::genom::mwerr", what=f"{self._rosafe.instance} does not answer") from None
        except ValueError as problem:
            raise ComponentError("::genom::mwerr", what=f"getProcessors: {problem}") from None

    # --- requests: each takes the values of the page and returns the answer ---

    async def devices(self, _: Mapping[str, Any]) -> dict[str, Any]:
        """Return the devices that Acquire accepts, as printed by ListDevices."""

        def list_devices() -> list[dict[str, str]]:
            devices = []
            with suppress(ComponentError):  # no sound card: only the built-in sources, which come first
                for line in device_lines():
                    name, _, doc = line.partition(" ")
                    devices.append({"name": name, "doc": re.sub(r"[\[\]]", "", doc)})
            return devices

        return {"devices": await asyncio.to_thread(list_devices)}

    async def acquire(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Start the capture of audio."""
        service = self._bass.service("Acquire")
        await self._bass.call(service, self._bass.arguments(service, {**values}))
        return {}

    async def stop_capture(self, _: Mapping[str, Any]) -> dict[str, Any]:
        """Stop the capture of audio."""
        await self._bass.outputs("Stop", {})
        return {}

    async def build(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Build a representation with all processors that it needs, or find it, as `rosafe request` does."""
        return await self._call(REQUEST, values)

    async def build_default_tree(self, _: Mapping[str, Any]) -> dict[str, Any]:
        """Build the default representations."""
        created: list[str] = []
        for kind in DEFAULT_REPRESENTATIONS:
            created += (await self.build({"representation": kind}))["created"]
        return {"created": created}

    def actions(self) -> dict[str, Action]:
        """Return the requests of the page by name."""
        modify, remove = (self._rosafe.service(name) for name in ("modifyParameter", "removeProcessor"))
        return {
            "devices": self.devices,
            "acquire": self.acquire,
            "silence": self.stop_capture,
            "build": self.build,
            "usual": self.build_default_tree,
            "modify": lambda values: self._call(modify, values),
            "remove": lambda values: self._call(remove, values),
            "save": lambda _: self._call(SAVE_SETUP, {}),
            "load": lambda values: self._call(LOAD_SETUP, values),
        }

    async def _call(self, service: Service, values: Mapping[str, Any]) -> dict[str, Any]:
        return dict((await self._rosafe.call(service, self._rosafe.arguments(service, {**values}))).values)


def catalogue() -> dict[str, Any]:
    """Return the declarations of all kinds of processors and of the parameters of Acquire and InputProc."""
    return {
        "kinds": {
            kind.kind: {
                "doc": kind.doc,
                "chain": [above.kind for above in tree_planner.ancestor_kinds(kind)],
                "parts": [{"name": part.name, "axes": list(part.axes), "unit": part.unit} for part in kind.parts],
                "parameters": {p.name: describe_parameter(p) for p in kind.parameters},
                "derived": [derived.name for derived in kind.derived],
            }
            for kind in KINDS.values()
        },
        "input": {p.name: describe_parameter(p) for p in ROSAFE.service("InputProc").parameters[1:]},
        "acquire": {p.name: describe_parameter(p) for p in BASS.service("Acquire").parameters},
    }


def format_error(problem: ComponentError) -> str:
    """Return an error in one line: its name and its reason."""
    name = problem.ex.rpartition("::")[2]
    reason = problem.what or {**BASS.exceptions, **ROSAFE.exceptions}.get(name, "")
    return f"{name}: {reason}" if reason else problem.ex
