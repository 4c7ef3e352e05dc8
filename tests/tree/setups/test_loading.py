"""Loading a setup is a transaction: the tree is complete, or nothing changes; so is the sound, which clients start."""

from __future__ import annotations

import asyncio
import functools
import json
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping
from contextlib import asynccontextmanager
from typing import Any

import pytest

from rosafe.interface import BASS, ROSAFE, ComponentError
from rosafe.representations import STAGES
from rosafe.ros1.client import whole_trees as module_of_whole_trees
from rosafe.tree.setups import Setup, dry_run, plan, read, setup_processor, write
from rosafe.tree.tree import Tree
from tests.tree.support import Recorder, end
from tests.tree.test_tree_builder import Client

whole_trees: Any = module_of_whole_trees  # with `Graph` instead of a client
SETUP = """
sound: {device: "scene:", nFramesPerChunk: 441}
connections: {Audio: bass/Audio}
processors:
  input: {kind: input, nFramesPerBlock: 441}
  preProc: {kind: preProc, parent: input, pp_coefPreEmphasis: 0}
  wide: {kind: gammatone, parent: preProc, fb_nChannels: 4}
  narrow: {kind: gammatone, parent: preProc, fb_cfHz: [500, 1000]}
  ihc: {kind: ihc, parent: wide}
  ild: {kind: ild, parent: ihc, ild_hSizeSec: 0.007}
  ratemap: {kind: ratemap, parent: ihc}
"""
NAMES = ["input", "preProc", "wide", "narrow", "ihc", "ild", "ratemap"]

# --- the tree ---------------------------------------------------------------------------------------------------


@pytest.fixture
def client() -> Iterator[Client]:
    listener = Recorder()
    tree = Tree(listener)
    yield Client(tree)
    end(tree, listener)


def load(client: Client, text: str) -> tuple[list[str], list[str]]:
    """Load a setup; return the names of the processors that were created, and of those that were reused."""
    done = client.builder.build(functools.partial(plan, read(text)), client.open_input)
    return done.created, done.reused


def saved(client: Client, full: bool = False) -> str:
    return write(Setup(processors=tuple(map(setup_processor, client.builder.processors()))), full)


@pytest.mark.parametrize("full", [False, True])
def test_a_saved_setup_is_loaded_identically(client: Client, full: bool) -> None:
    assert load(client, SETUP) == (NAMES, [])
    before, text = client.state(), saved(client, full)
    assert read(text).processors == read(SETUP).processors
    client.tree.stop()
    assert load(client, text) == (NAMES, [])
    assert client.state() == before and saved(client, full) == text
    assert client.tree.find("preProc").stage.parameters["pp_coefPreEmphasis"] == 0.0


def test_existing_processors_are_reused(client: Client) -> None:
    load(client, SETUP)
    before = client.state()
    assert load(client, SETUP) == ([], NAMES)
    client.tree.remove("ihc")
    assert load(client, SETUP)[0] == ["ihc", "ild", "ratemap"]
    assert client.state() == before


def test_an_input_of_another_name_is_reused(client: Client) -> None:
    load(client, SETUP.replace("input: {kind", "ears: {kind").replace("parent: input", "parent: ears"))
    client.tree.remove("wide")
    assert load(client, SETUP)[1] == ["ears", "preProc", "narrow"]


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (("fb_nChannels: 4", "fb_nChannels: 5"), "'wide' exists already and has fb_nChannels 4, in the setup 5"),
        (("parent: ihc, ild_hSizeSec: 0.007", "parent: ihc"), "'ild' exists already and has ild_hSizeSec 0.007"),
        (("ihc: {kind: ihc, parent: wide}", "ihc: {kind: ihc, parent: narrow}"), "is a child of 'wide'"),
        (("ild: {kind: ild, parent: ihc, ild_hSizeSec: 0.007", "ild: {kind: ratemap, parent: ihc"), "of kind ild"),
        (("nFramesPerBlock: 441", "nFramesPerBlock: 882"), "'input' exists already and has nFramesPerBlock 441"),
        (("441}\n  pre", "441, in_doNormalize: no}\n  pre"), "'input' exists already and has in_doNormalize 1"),
        (("narrow: {kind: gammatone", "other: {kind: gammatone, fb_nGamma: 2"), ""),
        (("ratemap: {kind: ratemap, parent: ihc", "other: {kind: ratemap, parent: ihc, rm_wSizeSec: 1e-9"), "rm_wSize"),
        (
            ("narrow: {kind: gammatone, parent: preProc, fb_cfHz: [500, 1000]", "x: {kind: gammatone, fb_cfHz: [3e4]"),
            "fb",
        ),
    ],
)
def test_a_conflict_with_existing_processors_changes_nothing(
    client: Client, change: tuple[str, str], what: str
) -> None:
    load(client, SETUP)
    before = client.state()
    assert change[0] in SETUP
    if what:
        with pytest.raises(ComponentError, match=what):
            load(client, SETUP.replace(*change))
        assert client.state() == before
    else:
        assert load(client, SETUP.replace(*change))[0] == ["other"]


def test_a_text_that_is_not_a_setup_names_the_line() -> None:
    with pytest.raises(ValueError, match="line 2"):
        read("processors:\n  a: {kind: nothing}\n")


def test_an_extra_that_the_parent_does_not_provide_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    setup = read(SETUP.replace("ihc: {kind: ihc, parent: wide}", "ihc: {kind: ihc, parent: wide, ihc_method: hilbert}"))
    dry_run(setup, 44100.0)
    monkeypatch.setattr(STAGES["gammatone"], "EXTRAS", ())
    with pytest.raises(ComponentError, match="'ihc' at 44100 Hz: requires the envelope, which 'wide' does not provide"):
        dry_run(setup, 44100.0)


# --- the sound --------------------------------------------------------------------------------------------------


class Bass:
    """The services of bass that setups use."""

    component = BASS
    node = "/bass"

    def __init__(self) -> None:
        self.acquired: dict[str, Any] = {}
        self.broken = False

    async def outputs(self, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        await asyncio.sleep(0)
        if service == "Acquire":
            if self.broken:
                raise BASS.error("e_device", "busy")
            self.acquired = dict(values)
        if service == "Stop":
            self.acquired = {}
        await asyncio.sleep(0)
        return {"running": bool(self.acquired), **self.acquired} if service == "getAcquisition" else {}


class Graph:
    """The services of a rosAFE and of a bass; the call `fail` of the node fails."""

    node = "/rosAFE"

    def __init__(self, fail: int = 0) -> None:
        self.bass = Bass()
        self.created: list[str] = []
        self.calls: list[dict[str, Any]] = []
        self.connected = "/bass/Audio"
        self.silent = 0  # attempts without sound
        self._fail = fail

    async def outputs(self, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        assert service == "connect_port"
        self.connected = values["remote"]
        return {}

    async def node_outputs(self, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        await asyncio.sleep(0)
        self.calls.append({"service": service, **values})
        if len(self.calls) == self._fail:
            raise ROSAFE.error("e_noMemory")
        if service == "saveSetup":
            return {"setup": write(read("connections: {Audio: bass/Audio}"))}
        if service == "removeUnused":
            self.created = [name for name in self.created if name not in values["names"]]
            return {"removed": values["names"]}
        names = NAMES[self.created == NAMES :] if service == "loadSetup" else ["input_0"]
        if not values.get("check"):
            self.silent -= 1
            if self.silent >= 0:
                raise ROSAFE.error("e_noData")
            self.created += names
            self.connected = "/bass/Audio"
        await asyncio.sleep(0)
        return {"created": names, "reused": []}

    async def check_plugins(self, requests: Iterable[str]) -> None:
        await asyncio.sleep(0)

    async def port_connected(self, port: str) -> str:
        return self.connected

    async def published(self, topic: str) -> bool:
        return True

    @asynccontextmanager
    async def other(self, node: str) -> AsyncIterator[Any]:
        if node != "/bass":
            raise ComponentError("::genom::mwerr", what="not running")
        yield self.bass


def rejected(graph: Graph, text: str) -> ComponentError:
    """Return the exception of a setup that is rejected, and check that nothing has changed."""
    before = dict(graph.bass.acquired)
    with pytest.raises(ComponentError) as error:
        asyncio.run(whole_trees.load(graph, text))
    assert (graph.created, graph.bass.acquired) == ([], before)
    return error.value


def test_the_sound_is_started_or_reused_and_saved() -> None:
    graph = Graph()
    assert asyncio.run(whole_trees.load(graph, SETUP)) == {"created": NAMES, "reused": [], "sound": "started"}
    assert [call["check"] for call in graph.calls] == [True, False]
    assert graph.bass.acquired["nFramesPerChunk"] == 441
    assert asyncio.run(whole_trees.load(graph, SETUP))["sound"] == "reused"
    setup = read(asyncio.run(whole_trees.save(graph, False)))
    assert (setup.sound, dict(setup.connections)) == (read(SETUP).sound, {"Audio": "bass/Audio"})


def test_the_sound_may_arrive_later(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = Graph()
    graph.silent = 2
    assert asyncio.run(whole_trees.load(graph, SETUP))["created"] == NAMES
    graph = Graph()
    graph.silent = 1000
    monkeypatch.setattr(whole_trees, "SOUND_SECONDS", 0.3)
    assert rejected(graph, SETUP).ex == "::rosAFE::e_noData"
    assert graph.silent < 999


def test_a_rejected_sound_or_tree_leaves_nothing() -> None:
    for fail in (1, 2):  # the check before the sound is started, and the creation after it
        assert rejected(Graph(fail), SETUP).ex == "::rosAFE::e_noMemory"
    graph = Graph()
    graph.bass.broken = True
    assert rejected(graph, SETUP).ex == "::bass::e_device"
    assert len(graph.calls) == 1
    assert "start it with: bass-ros" in str(rejected(graph, SETUP.replace("bass/Audio", "left/Audio")))
    running = Graph()
    running.bass.acquired = dict(read(SETUP.replace("441", "882")).sound.values)  # type: ignore[union-attr]
    assert "bass acquires with nFramesPerChunk 882, the setup expects 441" in str(rejected(running, SETUP))


@pytest.mark.parametrize("service", ["loadSetup", "request"])
def test_a_cancelled_request_leaves_nothing(service: str) -> None:
    """Also if the cleanup is cancelled again: the node completes a request although its client no longer waits."""

    async def cancelled(steps: int, again: int) -> Graph:
        graph = Graph()
        graph.connected = "/left/Audio"
        values = {"setup": SETUP} if service == "loadSetup" else {"representation": "input", "connect": "x"}
        task = asyncio.create_task(whole_trees.call(graph, service, values))
        for wait in (steps, again):
            for _ in range(wait):
                await asyncio.sleep(0)
            task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        return graph

    for steps in range(1, 12 if service == "loadSetup" else 4):
        for again in (1, 3):
            graph = asyncio.run(cancelled(steps, again))
            assert (graph.created, graph.bass.acquired) == ([], {}), (steps, again)
            assert graph.connected == "/left/Audio" or service == "request"


def test_the_request_in_its_form_as_a_ros_service() -> None:
    graph = Graph()
    values = {"representation": "ild", "fb_cfHz": [100.1, 200.0], "in_doNormalize": False, "connect": "left/Audio"}
    asyncio.run(whole_trees.call(graph, "request", values))
    (call,) = graph.calls
    assert (call["representation"], call["connect"]) == ("ild", "left/Audio")
    assert json.loads(call["parameters"]) == {"fb_cfHz": [100.1, 200.0], "in_doNormalize": False}
