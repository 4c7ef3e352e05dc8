"""What the page asks of the components: the tree, its changes, the sound. Refusals come with the component's reason."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Mapping
from typing import Any

from rosafe.bass.sources import device_lines
from rosafe.client.component_client import ComponentClient, describe_parameter
from rosafe.client.graph import Graph
from rosafe.interface import BASS, KINDS, LOAD_SETUP, REQUEST, ROSAFE, SAVE_SETUP, ComponentError, Service
from rosafe.live.plot_data import ProcessorInfo, TreeSnapshot
from rosafe.tree import tree_planner

LOOK_SECONDS = 3.0  # for the answer of a component that is well
# What the page needs to show something of each sort, where there is nothing yet.
DEFAULT_REPRESENTATIONS = ("ratemap", "ild", "itd", "ic")


class ComponentFacade:
    """A rosAFE and a bass on the graph.

    Parameters
    ----------
    graph : Graph
    instance, bass : str
        Their names.
    """

    def __init__(self, graph: Graph, instance: str, bass: str) -> None:
        self._graph = graph
        self._rosafe = ComponentClient(graph, ROSAFE, instance)
        self._bass = ComponentClient(graph, BASS, bass)
        self.audio_topic = f"/{bass}/Audio"

    async def close(self) -> None:
        """Let go of all connections."""
        for proxy in (self._rosafe, self._bass):
            await proxy.close()

    async def tree(self) -> TreeSnapshot:
        """The processors; ComponentError where rosAFE does not answer."""
        try:
            told = await asyncio.wait_for(self._rosafe.outputs("getProcessors", {}), LOOK_SECONDS)
        except TimeoutError:
            name = self._rosafe.instance
            raise ComponentError("::genom::mwerr", what=f"{name} does not answer") from None
        try:
            return TreeSnapshot([ProcessorInfo.of(one) for one in told["processors"]])
        except ValueError as problem:
            raise ComponentError("::genom::mwerr", what=f"getProcessors: {problem}") from None

    # --- what can be asked for; each takes what the page sends and returns what it gets ---

    async def devices(self, _: Mapping[str, Any]) -> dict[str, Any]:
        """The names that Acquire takes, as ListDevices prints them."""

        def look() -> list[dict[str, str]]:
            found = []
            try:
                for line in device_lines():
                    name, _, doc = line.partition(" ")
                    found.append({"name": name, "doc": re.sub(r"[\[\]]", "", doc)})
            except ComponentError:  # no sound card: the built-in ones are there
                pass
            return found

        return {"devices": await asyncio.to_thread(look)}

    async def acquire(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Start the sound."""
        service = self._bass.service("Acquire")
        await self._bass.call(service, self._bass.arguments(service, {**given}))
        return {}

    async def stop_capture(self, _: Mapping[str, Any]) -> dict[str, Any]:
        """Stop the sound."""
        await self._bass.outputs("Stop", {})
        return {}

    async def build(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Build what a representation needs, or find it, as `rosafe request`."""
        values = dict(given)
        kind = KINDS.get(str(values.get("representation", "")))
        if kind is not None:
            values["representation"] = kind.word
        return await self._ask(REQUEST, values)

    async def build_default_tree(self, _: Mapping[str, Any]) -> dict[str, Any]:
        """Build all that the page shows where it is opened for the first time."""
        created: list[str] = []
        for kind in DEFAULT_REPRESENTATIONS:
            created += (await self.build({"representation": kind}))["created"]
        return {"created": created}

    async def modify(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Change one parameter."""
        return await self._ask(self._rosafe.service("modifyParameter"), given)

    async def remove(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Remove a processor and all below it."""
        return await self._ask(self._rosafe.service("removeProcessor"), given)

    async def save_setup(self, _: Mapping[str, Any]) -> dict[str, Any]:
        """The tree with its sound, as the text of a setup."""
        return await self._ask(SAVE_SETUP, {})

    async def load_setup(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Build what the text of a setup says: wholly, or nothing changes."""
        return await self._ask(LOAD_SETUP, given)

    async def _ask(self, service: Service, given: Mapping[str, Any]) -> dict[str, Any]:
        values = self._rosafe.arguments(service, {**given})
        return dict((await self._rosafe.call(service, values)).values)


def catalogue() -> dict[str, Any]:
    """What the table says of each kind of processor, and of the parameters of Acquire and InputProc."""
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
    """A refusal in one line: its name, and what it is about."""
    name = problem.ex.rpartition("::")[2]
    known = {**BASS.exceptions, **ROSAFE.exceptions}
    what = problem.what or known.get(name, "")
    return f"{name}: {what}" if what else problem.ex
