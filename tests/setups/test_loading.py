"""Loading a setup is one transaction, on components in this process: wholly, or nothing is changed."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any

import pytest

from rosafe.client import setup_transaction
from rosafe.interface import BASS, ROSAFE, ComponentError
from rosafe.representations import STAGES
from rosafe.setups import read, write
from tests.request.model import Model, Processor

SETUP = """
sound: {device: "scene:", nFramesPerChunk: 441}
connections: {Audio: bass/Audio}
processors:
  input: {kind: input}
  preProc: {kind: preProc, parent: input, pp_coefPreEmphasis: 0}
  wide: {kind: gammatone, parent: preProc, fb_nChannels: 4}
  narrow: {kind: gammatone, parent: preProc, fb_cfHz: [500, 1000]}
  ihc: {kind: ihc, parent: wide}
  ild: {kind: ild, parent: ihc, ild_hSizeSec: 0.007}
  ratemap: {kind: ratemap, parent: ihc}
"""


class Bass:
    """A bass, as setups see one."""

    component = BASS
    instance = "bass"

    def __init__(self) -> None:
        self.acquired: dict[str, Any] = {}
        self.broken = False

    async def outputs(self, service: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        if service == "Acquire":
            if self.broken:
                raise BASS.error("e_device", "busy")
            self.acquired = dict(values)
        if service == "Stop":
            self.acquired = {}
        return {"running": bool(self.acquired), **self.acquired} if service == "getAcquisition" else {}


class Graph(Model):
    """A rosAFE beside a bass."""

    def __init__(self) -> None:
        super().__init__()
        self.bass = Bass()

    @asynccontextmanager
    async def other(self, instance: str) -> AsyncIterator[Any]:
        if instance != "bass":
            raise ComponentError("::genom::mwerr", what="not running")
        yield self.bass

    def everything(self) -> Any:
        """All that there is, to be compared."""
        return self.state(), dict(self.bass.acquired)


def load(graph: Graph, text: str) -> dict[str, Any]:
    return asyncio.run(setup_transaction.load(graph, {"setup": text}))


def saved(graph: Graph, full: bool = False) -> str:
    return str(asyncio.run(setup_transaction.save(graph, {"full": full}))["setup"])


def refused(graph: Graph, text: str) -> ComponentError:
    """The exception of a setup that is refused, which has changed nothing."""
    before = graph.everything()
    with pytest.raises(ComponentError) as error:
        load(graph, text)
    assert graph.everything() == before
    return error.value


@pytest.mark.parametrize("full", [False, True])
def test_what_is_saved_is_what_is_loaded(full: bool) -> None:
    first, second = Graph(), Graph()
    answer = load(first, SETUP)
    assert answer == {
        "created": ["input", "preProc", "wide", "narrow", "ihc", "ild", "ratemap"],
        "reused": [],
        "sound": "started",
    }
    load(second, saved(first, full))
    assert second.everything() == first.everything()
    assert list(second.processors) == list(first.processors)
    assert first.processors["preProc"].stage.parameters["pp_coefPreEmphasis"] == 0.0
    assert saved(second, full) == saved(first, full)
    assert read(saved(first)) == read(write(read(SETUP)))


def test_what_is_there_is_used() -> None:
    graph = Graph()
    load(graph, SETUP)
    before = graph.everything()
    answer = load(graph, SETUP)
    assert (answer["created"], answer["sound"], len(answer["reused"])) == ([], "reused", 7)
    graph._removeProcessor("", {"name": "ihc"})
    assert load(graph, SETUP)["created"] == ["ihc", "ild", "ratemap"]
    assert graph.everything() == before


def test_an_input_is_used_under_whatever_name() -> None:
    graph = Graph()
    load(graph, SETUP.replace("input: {kind", "ears: {kind").replace("parent: input", "parent: ears"))
    graph._removeProcessor("", {"name": "wide"})
    assert load(graph, SETUP)["reused"] == ["ears", "preProc", "narrow"]


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (("fb_nChannels: 4", "fb_nChannels: 5"), "'wide' is there already and has fb_nChannels 4, in the setup 5"),
        (("parent: ihc, ild_hSizeSec: 0.007", "parent: ihc"), "'ild' is there already and has ild_hSizeSec 0.007"),
        (("ihc: {kind: ihc, parent: wide}", "ihc: {kind: ihc, parent: narrow}"), "hangs on 'wide'"),
        (("ild: {kind: ild", "ild: {kind: ratemap"), "of kind ild"),
        (("ratemap: {kind: ratemap", "wide: {kind: ratemap"), "twice"),
        (("nFramesPerChunk: 441", "nFramesPerChunk: 882"), "bass acquires with nFramesPerChunk 441"),
        (("bass/Audio", "left/Audio"), "the tree hears /bass/Audio"),
        (("{kind: input}", "{kind: input, in_doNormalize: no}"), "'input' is there already and has in_doNormalize 1"),
        (("kind: ratemap, parent: ihc", "kind: ratemap, parent: ihc, rm_wSizeSec: 1e-9"), "rm_wSizeSec"),
        (("fb_cfHz: [500, 1000]", "fb_cfHz: [500, 30000]"), "fb_cfHz"),
    ],
)
def test_what_does_not_go_with_what_is_there_changes_nothing(change: tuple[str, str], what: str) -> None:
    graph = Graph()
    load(graph, SETUP)
    changed = SETUP.replace(*change)
    if "ild: {kind: ratemap" in changed:
        changed = changed.replace(", ild_hSizeSec: 0.007", "")
    assert what in str(refused(graph, changed))


def test_whatever_step_fails_nothing_is_left() -> None:
    whole = Graph()
    load(whole, SETUP)
    steps = [number for number, call in enumerate(whole.calls) if call not in ("getProcessors", "connect_port")]
    assert len(steps) == 7
    for number in steps:
        graph = Graph()
        graph.fail[number] = ROSAFE.error("e_noMemory")
        assert refused(graph, SETUP).ex == "::rosAFE::e_noMemory"
        assert load(graph, SETUP)["created"] == list(whole.processors)  # nothing is in the way


def test_what_others_have_made_stays() -> None:
    graph = Graph()
    load(graph, SETUP)
    for name in ("ild", "ratemap"):
        graph._removeProcessor("", {"name": name})
    before = graph.everything()
    graph.fail[len(graph.calls) + 3] = ROSAFE.error("e_noMemory")  # two looks, one processor, and then
    assert refused(graph, SETUP).ex == "::rosAFE::e_noMemory"
    assert graph.everything() == before


def test_a_bass_that_refuses() -> None:
    graph = Graph()
    graph.bass.broken = True
    assert refused(graph, SETUP).ex == "::bass::e_device"
    assert "connect_port" not in graph.calls
    assert "start it with: bass-ros" in str(refused(graph, SETUP.replace("bass/Audio", "left/Audio")))


def test_a_cancelled_load_leaves_nothing() -> None:
    async def cancelled(number: int) -> Graph:
        graph = Graph()
        task = asyncio.create_task(setup_transaction.load(graph, {"setup": SETUP}))
        graph.cancel[number] = task
        with pytest.raises(asyncio.CancelledError):
            await task
        return graph

    for number in range(2, 10):
        graph = asyncio.run(cancelled(number))
        assert graph.everything() == ({}, {}), number


def test_a_kind_that_is_not_known_here_is_not_left_out() -> None:
    class Elsewhere(Graph):
        def _getProcessors(self, service: str, values: Mapping[str, Any]) -> dict[str, Any]:
            told = super()._getProcessors(service, values)
            told["processors"][-1]["kind"] = "loudness"
            return told

    graph = Elsewhere()
    graph.connected = "bass/Audio"
    graph.processors["loud"] = Processor("input", "", STAGES["input"](44100.0))
    with pytest.raises(ComponentError, match="'loud' is of kind loudness, which is not known here"):
        saved(graph)


def test_a_text_that_is_no_setup() -> None:
    error = refused(Graph(), "processors:\n  a: {kind: nothing}\n")
    assert error.ex == "::rosAFE::e_badNewValue"
    assert "line 2" in error.detail["what"]
