"""The link to rosAFE when the master does not know the node."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest

from rosafe.localization.live import WARN
from rosafe.ros1.client.graph import NotRegisteredError
from rosafe.ros1.localizer import tree_link
from rosafe.ros1.localizer.settings import node_status
from tests.harness import wait_for


class Client:
    """A client of a component that answers."""

    closed = 0

    @classmethod
    async def load(cls, *_: Any) -> Client:
        return cls()

    async def close(self) -> None:
        Client.closed += 1


def test_a_node_that_the_master_does_not_know(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its services answer at their known address; the link waits, closes its client, and tries again."""

    class Graph:
        def __init__(self, *_: Any) -> None:
            pass

        async def node_uri(self, instance: str) -> str:
            raise NotRegisteredError(f"unknown node [/{instance}]")

        async def close(self) -> None:
            pass

    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:1")
    monkeypatch.setattr(tree_link, "Graph", Graph)
    monkeypatch.setattr(Client, "closed", 0)
    monkeypatch.setattr(tree_link, "ComponentClient", Client)
    monkeypatch.setattr(tree_link, "POLL_SECONDS", 0.01)
    monkeypatch.setattr("rospy.resolve_name", lambda name: name)
    status = node_status(lambda: None)
    unused: Any = None
    link = tree_link.TreeLink("/rosAFE", "", unused, unused, status)
    link.start()
    try:
        wait_for(lambda: Client.closed > 2)
        assert status.state() == (WARN, "waiting for rosAFE: /rosAFE is not registered at the master")
    finally:
        link.close()


@pytest.mark.parametrize("replaced", [False, True], ids=["alone", "replaced"])
def test_a_node_that_was_replaced_leaves_its_processors_to_its_successor(
    monkeypatch: pytest.MonkeyPatch, replaced: bool
) -> None:
    removed: list[list[str]] = []

    class Created:
        names: ClassVar[list[str]] = ["ild"]

        async def remove(self, graph: Any, client: Any) -> None:
            removed.append(self.names)

    monkeypatch.setattr(tree_link, "CreatedProcessors", Created)
    monkeypatch.setattr(tree_link, "ComponentClient", Client)
    monkeypatch.setattr(tree_link.registration, "registrar", lambda: SimpleNamespace(is_replaced=replaced))
    unused: Any = None
    link = tree_link.TreeLink("/rosAFE", "", unused, unused, node_status(lambda: None))
    asyncio.run(link._remove_created(unused))
    assert removed == ([] if replaced else [["ild"]])
