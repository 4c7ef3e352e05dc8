"""The settings of the localizer node in the ROS parameter server, and whether the node runs."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

from rosafe.ros1.client.graph import Graph, NotRegisteredError
from rosafe.tree.setups import LOCALIZER

NODE = "localizer"  # in the namespace of its rosAFE


async def set_parameters(graph: Graph, node: str, settings: Mapping[str, Any]) -> None:
    """Set the private parameters of the `node`, which reads them when it starts; delete those that are not given.

    Raises ComponentError without a master.
    """
    for parameter in LOCALIZER:
        name = f"{node}/{parameter.name}"
        if parameter.name in settings:
            await graph.master("setParam", name, settings[parameter.name])
        else:
            with contextlib.suppress(NotRegisteredError):
                await graph.master("deleteParam", name)


async def is_registered(graph: Graph, node: str) -> bool:
    """Return whether the localizer `node` is registered at the master."""
    return f"{node}/sources" in await graph.published_by(node)
