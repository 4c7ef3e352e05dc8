"""A long setup gives way: other builds of the same component come between two of its steps."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from rosafe.client import setup_transaction
from rosafe.interface import ComponentError
from rosafe.tree import tree_builder
from tests.setups.test_loading import Graph

COUNT = 60
SETUP = (
    'sound: {device: "scene:"}\nconnections: {Audio: bass/Audio}\nprocessors:\n  input: {kind: input}\n'
    "  preProc: {kind: preProc, parent: input}\n"
    + "".join(f"  filterbank_{i}: {{kind: gammatone, parent: preProc, fb_nChannels: 2}}\n" for i in range(COUNT))
)
NAMES = ["input", "preProc", *(f"filterbank_{i}" for i in range(COUNT))]


async def among(graph: Graph, text: str, **values: Any) -> tuple[Any, dict[str, Any], int]:
    """Load `text`, and once it is under way `request` something else.

    Returns the answer to the first (or its exception), that to the second, and how many processors the setup made from
    the second's beginning to its end.
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


def test_another_build_waits_for_one_step() -> None:
    graph = Graph()
    loaded, built, between = asyncio.run(among(graph, SETUP, representation="gammatone", fb_nChannels=3))
    assert between <= 2
    assert built["reused"] == ["input", "preProc"]
    assert built["created"] == [f"filterbank_{COUNT}"]  # none of the names that the setup is going to make
    assert loaded == {"created": NAMES, "reused": [], "sound": "started"}
    assert set(graph.processors) == {*NAMES, f"filterbank_{COUNT}"}
    assert graph.turns.reserved == frozenset()


def test_what_another_build_uses_stays_if_the_setup_fails() -> None:
    graph = Graph()
    bad = SETUP + "  last: {kind: gammatone, parent: preProc, fb_cfHz: [21000, 22049]}\n"
    fail = ComponentError("::rosAFE::e_badNewValue", what="no")
    real = graph._make

    def make(service: str, values: Any) -> dict[str, Any]:
        if values.get("name") == "last":
            raise fail
        return real(service, values)

    graph._make = make  # type: ignore[method-assign]
    problem, built, _ = asyncio.run(among(graph, bad, representation="gammatone", fb_nChannels=2))
    assert problem is fail
    assert built["created"] == []
    assert list(graph.processors) == built["dependencies"]  # also a leaf, on which nothing depends


def test_a_setup_alone_gives_way_to_nobody_and_two_follow_each_other() -> None:
    graph = Graph()

    async def both() -> list[dict[str, Any]]:
        return list(await asyncio.gather(*(setup_transaction.load(graph, {"setup": SETUP}) for _ in range(2))))

    first, second = sorted(asyncio.run(both()), key=lambda answer: len(answer["reused"]))  # whichever began
    assert (first["created"], second["created"]) == (NAMES, [])
    assert second["reused"] == NAMES


def test_a_cancelled_setup_leaves_the_turn_to_others() -> None:
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


def test_what_an_earlier_build_used_does_not_stay_for_ever() -> None:
    """The names of its processors may be those of a later build, of which nothing is left if it fails."""
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
