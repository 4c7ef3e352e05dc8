"""Other tree requests to the same component run between two steps of a long setup."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from rosafe.interface import ComponentError
from rosafe.ros1.client import setup_transaction
from rosafe.tree import tree_builder
from tests.setups.test_loading import Graph

COUNT = 60
SETUP = (
    'sound: {device: "scene:"}\nconnections: {Audio: bass/Audio}\nprocessors:\n  input: {kind: input}\n'
    "  preProc: {kind: preProc, parent: input}\n"
    + "".join(f"  filterbank_{i}: {{kind: gammatone, parent: preProc, fb_nChannels: 2}}\n" for i in range(COUNT))
)
NAMES = ["input", "preProc", *(f"filterbank_{i}" for i in range(COUNT))]


async def load_during(graph: Graph, text: str, **values: Any) -> tuple[Any, dict[str, Any], int]:
    """Load `text`, and during this `request` a tree.

    Returns the response of the first (or its exception), that of the second, and the number of processors that the
    setup created during the second.
    """
    first = asyncio.create_task(setup_transaction.load(graph, {"setup": text}))
    while len(graph.processors) < 10:
        await asyncio.sleep(0)
    before = len(graph.processors)
    async with graph.turns.turn():
        second = await tree_builder.build(graph, values)
        between = len(graph.processors) - before - len(second["created"])
    try:
        return await first, second, between
    except ComponentError as problem:
        return problem, second, between


def test_another_request_waits_for_one_step() -> None:
    graph = Graph()
    loaded, built, between = asyncio.run(load_during(graph, SETUP, representation="gammatone", fb_nChannels=3))
    assert between <= 2
    assert built["reused"] == ["input", "preProc"]
    assert built["created"] == [f"filterbank_{COUNT}"]  # none of the names in the setup
    assert loaded == {"created": NAMES, "reused": [], "sound": "started"}
    assert set(graph.processors) == {*NAMES, f"filterbank_{COUNT}"}
    assert graph.turns.reserved == frozenset()


def test_processors_used_by_another_request_stay_if_the_setup_fails() -> None:
    graph = Graph()
    bad = SETUP + "  last: {kind: gammatone, parent: preProc, fb_cfHz: [21000, 22049]}\n"
    fail = ComponentError("::rosAFE::e_badNewValue", what="no")
    real = graph._make

    def make(service: str, values: Any) -> dict[str, Any]:
        if values.get("name") == "last":
            raise fail
        return real(service, values)

    graph._make = make  # type: ignore[method-assign]
    problem, built, _ = asyncio.run(load_during(graph, bad, representation="gammatone", fb_nChannels=2))
    assert problem is fail
    assert built["created"] == []
    assert list(graph.processors) == built["dependencies"]  # also a leaf


def test_two_setups_run_one_after_the_other() -> None:
    graph = Graph()

    async def both() -> list[dict[str, Any]]:
        return list(await asyncio.gather(*(setup_transaction.load(graph, {"setup": SETUP}) for _ in range(2))))

    first, second = sorted(asyncio.run(both()), key=lambda answer: len(answer["reused"]))  # whichever was first
    assert (first["created"], second["created"]) == (NAMES, [])
    assert second["reused"] == NAMES


def test_a_cancelled_setup_releases_the_lock() -> None:
    graph = Graph()

    async def cancel() -> dict[str, Any]:
        task = asyncio.create_task(setup_transaction.load(graph, {"setup": SETUP}))
        while len(graph.processors) < 10:
            await asyncio.sleep(0)
        task.cancel()
        async with graph.turns.turn():
            built = await tree_builder.build(graph, {"representation": "ild"})
        with pytest.raises(asyncio.CancelledError):
            await task
        return built

    built = asyncio.run(asyncio.wait_for(cancel(), 60))
    assert list(graph.processors) == built["dependencies"]


def test_use_by_an_earlier_request_does_not_persist() -> None:
    """A later request can use the same names, and none of its processors stays if it fails."""
    graph = Graph()
    asyncio.run(tree_builder.build(graph, {"representation": "time"}))
    graph.processors.clear()
    real = graph._make

    def make(service: str, values: Any) -> dict[str, Any]:
        if service == "GammatoneProc":
            raise ComponentError("::rosAFE::e_badNewValue", what="no")
        return real(service, values)

    graph._make = make  # type: ignore[method-assign]
    with pytest.raises(ComponentError, match=r"^no$"):
        asyncio.run(tree_builder.build(graph, {"representation": "ild"}))
    assert not graph.processors
