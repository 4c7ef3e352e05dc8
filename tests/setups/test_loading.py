"""Loading a setup is a transaction, here on components in this process: it is complete, or nothing changes."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any

import pytest

from rosafe.interface import BASS, ROSAFE, ComponentError
from rosafe.representations import STAGES
from rosafe.ros1.client import setup_transaction
from rosafe.setups import dry_run, read, write
from tests.ros1.client.model import Model, Processor

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
    """The services of bass that setups use."""

    component = BASS
    node = "/bass"

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
    """The services of a rosAFE and of a bass."""

    def __init__(self) -> None:
        super().__init__()
        self.bass = Bass()

    @asynccontextmanager
    async def other(self, node: str) -> AsyncIterator[Any]:
        if node != "/bass":
            raise ComponentError("::genom::mwerr", what="not running")
        yield self.bass

    def full_state(self) -> Any:
        """Return the whole state, for comparison."""
        return self.state(), dict(self.bass.acquired)


def load(graph: Graph, text: str) -> dict[str, Any]:
    return asyncio.run(setup_transaction.load(graph, {"setup": text}))


def saved(graph: Graph, full: bool = False) -> str:
    return str(asyncio.run(setup_transaction.save(graph, {"full": full}))["setup"])


def rejected(graph: Graph, text: str) -> ComponentError:
    """Return the exception of a setup that is rejected, and check that nothing has changed."""
    before = graph.full_state()
    with pytest.raises(ComponentError) as error:
        load(graph, text)
    assert graph.full_state() == before
    return error.value


@pytest.mark.parametrize("full", [False, True])
def test_a_saved_setup_is_loaded_identically(full: bool) -> None:
    first, second = Graph(), Graph()
    answer = load(first, SETUP)
    assert answer == {
        "created": ["input", "preProc", "wide", "narrow", "ihc", "ild", "ratemap"],
        "reused": [],
        "sound": "started",
    }
    load(second, saved(first, full))
    assert second.full_state() == first.full_state()
    assert list(second.processors) == list(first.processors)
    assert first.processors["preProc"].stage.parameters["pp_coefPreEmphasis"] == 0.0
    assert saved(second, full) == saved(first, full)
    assert read(saved(first)) == read(write(read(SETUP)))


def test_existing_processors_are_reused() -> None:
    graph = Graph()
    load(graph, SETUP)
    before = graph.full_state()
    answer = load(graph, SETUP)
    assert (answer["created"], answer["sound"], len(answer["reused"])) == ([], "reused", 7)
    graph._removeProcessor("", {"name": "ihc"})
    assert load(graph, SETUP)["created"] == ["ihc", "ild", "ratemap"]
    assert graph.full_state() == before


def test_an_input_of_another_name_is_reused() -> None:
    graph = Graph()
    load(graph, SETUP.replace("input: {kind", "ears: {kind").replace("parent: input", "parent: ears"))
    graph._removeProcessor("", {"name": "wide"})
    assert load(graph, SETUP)["reused"] == ["ears", "preProc", "narrow"]


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (("fb_nChannels: 4", "fb_nChannels: 5"), "'wide' exists already and has fb_nChannels 4, in the setup 5"),
        (("parent: ihc, ild_hSizeSec: 0.007", "parent: ihc"), "'ild' exists already and has ild_hSizeSec 0.007"),
        (("ihc: {kind: ihc, parent: wide}", "ihc: {kind: ihc, parent: narrow}"), "is a child of 'wide'"),
        (("ild: {kind: ild", "ild: {kind: ratemap"), "of kind ild"),
        (("ratemap: {kind: ratemap", "wide: {kind: ratemap"), "twice"),
        (("nFramesPerChunk: 441", "nFramesPerChunk: 882"), "bass acquires with nFramesPerChunk 441"),
        (("bass/Audio", "left/Audio"), "the tree is connected to /bass/Audio"),
        (("{kind: input}", "{kind: input, in_doNormalize: no}"), "'input' exists already and has in_doNormalize 1"),
        (("kind: ratemap, parent: ihc", "kind: ratemap, parent: ihc, rm_wSizeSec: 1e-9"), "rm_wSizeSec"),
        (("fb_cfHz: [500, 1000]", "fb_cfHz: [500, 30000]"), "fb_cfHz"),
    ],
)
def test_a_conflict_with_existing_processors_changes_nothing(change: tuple[str, str], what: str) -> None:
    graph = Graph()
    load(graph, SETUP)
    changed = SETUP.replace(*change)
    if "ild: {kind: ratemap" in changed:
        changed = changed.replace(", ild_hSizeSec: 0.007", "")
    assert what in str(rejected(graph, changed))


def test_a_failure_of_any_step_leaves_nothing() -> None:
    whole = Graph()
    load(whole, SETUP)
    steps = [number for number, call in enumerate(whole.calls) if call not in ("getProcessors", "connect_port")]
    assert len(steps) == 7
    for number in steps:
        graph = Graph()
        graph.fail[number] = ROSAFE.error("e_noMemory")
        assert rejected(graph, SETUP).ex == "::rosAFE::e_noMemory"
        assert load(graph, SETUP)["created"] == list(whole.processors)  # there is no conflict


def test_processors_of_other_clients_stay() -> None:
    graph = Graph()
    load(graph, SETUP)
    for name in ("ild", "ratemap"):
        graph._removeProcessor("", {"name": name})
    before = graph.full_state()
    graph.fail[len(graph.calls) + 3] = ROSAFE.error("e_noMemory")  # after two queries and one creation
    assert rejected(graph, SETUP).ex == "::rosAFE::e_noMemory"
    assert graph.full_state() == before


def test_a_bass_that_rejects_acquire() -> None:
    graph = Graph()
    graph.bass.broken = True
    assert rejected(graph, SETUP).ex == "::bass::e_device"
    assert "connect_port" not in graph.calls
    assert "start it with: bass-ros" in str(rejected(graph, SETUP.replace("bass/Audio", "left/Audio")))


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
        assert graph.full_state() == ({}, {}), number


def test_an_unknown_kind_is_an_error_and_not_omitted() -> None:
    class Elsewhere(Graph):
        def _getProcessors(self, service: str, values: Mapping[str, Any]) -> dict[str, Any]:
            outputs = super()._getProcessors(service, values)
            outputs["processors"][-1]["kind"] = "loudness"
            return outputs

    graph = Elsewhere()
    graph.connected = "bass/Audio"
    graph.processors["loud"] = Processor("input", "", STAGES["input"](44100.0))
    with pytest.raises(ComponentError, match="'loud' is of kind loudness, which is not available here"):
        saved(graph)


def test_a_text_that_is_not_a_setup() -> None:
    error = rejected(Graph(), "processors:\n  a: {kind: nothing}\n")
    assert error.ex == "::rosAFE::e_badNewValue"
    assert "line 2" in error.detail["what"]


def test_an_extra_that_the_parent_does_not_provide_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    setup = read(SETUP.replace("ihc: {kind: ihc, parent: wide}", "ihc: {kind: ihc, parent: wide, ihc_method: hilbert}"))
    dry_run(setup, 44100.0)
    monkeypatch.setattr(STAGES["gammatone"], "EXTRAS", ())
    with pytest.raises(ComponentError, match="'ihc' at 44100 Hz: requires the envelope, which 'wide' does not provide"):
        dry_run(setup, 44100.0)
