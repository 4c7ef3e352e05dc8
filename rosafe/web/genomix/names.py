"""Additional names of this machine that clients of genomixd may use: `--name` and the ROS parameter `~names`."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from rosafe.interface import ComponentError
from rosafe.ros1.client.graph import Graph, NotRegisteredError
from rosafe.web.server.access import host_name

READ_SECONDS = 1.0  # between two reads of the parameter, regardless of the number of requests

log = logging.getLogger("genomixd")


class Names:
    """The names that genomixd accepts in the header Host.

    Parameters
    ----------
    graph : Graph
        The graph whose master has the parameter.
    parameter : str
        The full name of the ROS parameter `~names`: a name, or a list of them.
    names : iterable of str
        Names that are always accepted.
    """

    def __init__(self, graph: Graph, parameter: str, names: Iterable[str]) -> None:
        self._graph, self._parameter = graph, parameter
        self.known: Collection[str] = {host_name(name) for name in names} - {""}
        self._next_read = 0.0
        self._value: Any = []
        self._from_parameter: Collection[str] = ()

    async def from_parameter(self) -> Collection[str]:
        """Return the names in `~names`, read at most once a second; the previous ones if the master does not answer."""
        now = asyncio.get_running_loop().time()
        if now >= self._next_read:
            self._next_read = now + READ_SECONDS
            try:
                value = await self._graph.master("getParam", self._parameter)
            except NotRegisteredError:
                value = []
            except ComponentError:
                return self._from_parameter
            if value != self._value:
                self._value = value
                self._from_parameter = _parse(value, self._parameter)
        return self._from_parameter


def parameter_name(arguments: Sequence[str], environ: Mapping[str, str] = os.environ) -> str:
    """Return the full name of `~names` for the node name that roslaunch or `__name:=` sets."""
    remappings = dict(text.split(":=", 1) for text in arguments if ":=" in text)
    namespace = remappings.get("__ns", environ.get("ROS_NAMESPACE", ""))
    path = f"{namespace}/{remappings.get('__name', 'genomixd')}/names"
    return "/" + "/".join(filter(None, path.split("/")))


def _parse(value: Any, parameter: str) -> set[str]:
    """Return the names in the value of a ROS parameter; other texts are logged."""
    names = set()
    for text in value if isinstance(value, list) else [value]:
        name = host_name(text) if isinstance(text, str) else ""
        if name:
            names.add(name)
        else:
            log.warning("%s: expected the name of a host, such as robot.lab, got %s", parameter, repr(text)[:80])
    return names
