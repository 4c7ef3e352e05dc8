"""Requests for whole trees: existing processors are reused, the others are created, all of them or none."""

from __future__ import annotations

import threading
import tracemalloc
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe.dsp.stage import Stage
from rosafe.interface import KINDS, ComponentError, format_value
from rosafe.representations import BUILTIN, STAGES
from rosafe.tree import tree_builder, tree_planner
from rosafe.tree.block import Source
from rosafe.tree.processor import Processor
from rosafe.tree.tree import Tree
from rosafe.tree.tree_builder import RequestResult, TreeBuilder
from rosafe.tree.tree_planner import NewProcessor
from tests.harness import run_together, wait_for

from .support import Feed, Recorder, end

RATE = 44100.0
CHAIN = ["input_0", "time_0", "filterbank_0", "innerhaircell_0", "ild_0"]
REPRESENTATIONS = [kind.word for kind in KINDS.values()]
# Few values of each, so that requests coincide often; among them the default, and values that the node reads as such.
VALUES: dict[str, list[Any]] = {
    "pp_bRemoveDC": [False, True],
    "pp_coefPreEmphasis": [0.97, 0.0],
    "fb_nChannels": [0, 4],
    "fb_nERBs": [1.0, 2.0],
    "fb_cfHz": [[], [0], [500.0, 1000.0]],
    "fb_highFreqHz": [8000.0, 4000.0],
    "ihc_method": ["dau", "none"],
    "ild_hSizeSec": [0.01, 0.005],
    "cc_wname": ["hann", "hamming"],
}
_ALWAYS: dict[str, st.SearchStrategy[Any]] = {}
PARAMETERS = st.fixed_dictionaries(_ALWAYS, optional={name: st.sampled_from(values) for name, values in VALUES.items()})
REQUESTS = st.tuples(st.sampled_from(["time", "gammatone", "ild", "ratemap", "crosscorrelation"]), PARAMETERS)
CHANGES = st.tuples(st.integers(0, 10**6), st.sampled_from(["remove", "stop", *VALUES]))


class Client:
    """Requests to one tree, whose sound arrives at once."""

    def __init__(self, tree: Tree) -> None:
        self.tree = tree
        self.builder = TreeBuilder(tree, self._on_created)
        self.feeds: list[Feed] = []
        self.failing: dict[int, Exception] = {}  # by the number of the processor that is created
        self._created = 0

    def _on_created(self, processor: Processor) -> None:
        self._created += 1
        if self._created in self.failing:
            raise self.failing[self._created]

    def open_input(self, new: NewProcessor, create: Callable[[Source], Processor | None]) -> None:
        self.feeds.append(Feed(RATE, 441))
        create(self.feeds[-1])

    def build(self, representation: str, **parameters: Any) -> RequestResult:
        return self.builder.request({"representation": representation, **parameters}, self.open_input)

    def find(self, representation: str, **parameters: Any) -> RequestResult:
        return self.builder.find({"representation": representation, **parameters})

    def state(self) -> dict[str, tuple[str, str, dict[str, Any]]]:
        return {p.name: (p.kind, p.parent, dict(p.values)) for p in self.builder.processors()}

    def refused(self, what: str, representation: str, **parameters: Any) -> ComponentError:
        """Return the error of a request that changes nothing."""
        before = self.state()
        with pytest.raises(ComponentError, match=what) as error:
            self.build(representation, **parameters)
        assert self.state() == before
        return error.value


@contextmanager
def new_client() -> Iterator[Client]:
    listener = Recorder()
    tree = Tree(listener, 1)
    try:
        yield Client(tree)
    finally:
        end(tree, listener)


@pytest.fixture
def client(tree: Tree) -> Client:
    return Client(tree)


def stage(kind: str, parameters: Mapping[str, Any]) -> Stage:
    """Return a stage of this kind below its ancestors."""
    own = {p.name: parameters[p.name] for p in KINDS[kind].parameters if p.name in parameters}
    parent = KINDS[kind].parent
    return STAGES[kind](stage(parent, parameters).output_format if parent else RATE, **own)


def check(client: Client, before: Mapping[str, Any], parameters: Mapping[str, Any], result: RequestResult) -> None:
    """The tree is as requested, and only missing processors were created."""
    names, state = result.dependencies, client.state()
    assert names == client.tree.dependencies(result.name)
    assert [state[name][0] for name in names] == [k.kind for k in tree_planner.ancestor_kinds(KINDS[result.kind])]
    for name in names:
        kind, _, values = state[name]
        assert values.items() >= stage(kind, parameters).parameters.items(), name
    assert (result.created, result.reused) == (
        [name for name in names if name not in before],
        [name for name in names if name in before],
    )
    assert {name: state[name] for name in before} == before and set(state) == {*before, *names}
    assert not [name for name in result.created if state[name] in before.values()]


def disturb(tree: Tree, number: int, what: str) -> None:
    """Change the tree as another client: remove or change one processor, or remove all."""
    names = [processor.name for processor in tree.processors if processor.parent is not None]
    if what == "stop":
        tree.stop()
    elif names and what == "remove":
        tree.remove(names[number % len(names)])
    for name in names if what in VALUES else ():
        if what in tree.find(name).stage.parameters:
            tree.modify(name, what, format_value(VALUES[what][number % len(VALUES[what])]))
            return


@settings(max_examples=25)
@given(st.lists(st.one_of(REQUESTS, CHANGES), max_size=6))
def test_any_sequence_of_requests_and_changes(acts: list[tuple[Any, Any]]) -> None:
    with new_client() as client:
        for act in acts:
            if isinstance(act[0], int):
                disturb(client.tree, *act)
                continue
            before = client.state()
            result = client.build(act[0], **act[1])
            check(client, before, act[1], result)
            again = client.build(act[0], **act[1])
            assert (again.dependencies, again.created) == (result.dependencies, [])


def test_concurrent_clients(client: Client) -> None:
    """Each gets its processors, and none exists twice."""
    requested = [("ild", {}), ("ratemap", {"fb_nChannels": 4}), ("ild", {"fb_nChannels": 4})] * 2
    results = run_together(6, lambda number: client.build(requested[number][0], **requested[number][1]))
    for (_, parameters), result in zip(requested, results, strict=True):
        assert result.dependencies == client.tree.dependencies(result.name)
        for name in result.dependencies:
            found = client.tree.find(name)
            assert found.stage.parameters == stage(found.kind, parameters).parameters
    states = list(client.state().values())
    assert not [state for state in states if states.count(state) > 1]
    assert sorted(name for result in results for name in result.created) == sorted(client.state())


@pytest.mark.parametrize("step", [1, 2, 4])
@pytest.mark.parametrize("existing", ["", "time"])
def test_a_failure_of_any_step_leaves_nothing(client: Client, step: int, existing: str) -> None:
    if existing:
        client.build(existing)
        step += 1
    client.failing[step] = ComponentError("::genom::too_many_activities", "too many")
    client.refused("too many", "ild", pp_bRemoveDC=True)
    assert not existing or client.feeds == client.feeds[:1]
    client.failing.clear()
    assert client.build("ild").name == "ild_0"


def test_names_are_those_of_the_original_client(client: Client) -> None:
    assert client.build("ild") == RequestResult("ild_0", "ild", CHAIN, CHAIN, [], [])
    assert client.build("ratemap").created == ["ratemap_0"]
    assert client.build("crosscorrelation", cc_maxDelaySec=0.002).created == ["crosscorrelation_0"]
    assert client.build("input") == RequestResult("input_0", "input", ["input_0"], [], ["input_0"], [])


@pytest.mark.parametrize("word", REPRESENTATIONS)
def test_existing_processors_are_reused_and_found(client: Client, word: str) -> None:
    """Also if the effective values of the processor differ from the requested ones."""
    with pytest.raises(ComponentError, match="missing: InputProc") as missing:
        client.find(word)
    assert missing.value.ex == "::rosAFE::e_noSuchProcessor" and not client.state()
    result = client.build(word)
    again = result._replace(created=[], reused=result.created)
    assert client.build(word) == client.find(word) == again
    if word not in ("input", "time"):
        with pytest.raises(ComponentError, match="missing: GammatoneProc"):
            client.find(word, fb_nChannels=7)
        assert list(client.state()) == result.created
    with pytest.raises(ComponentError, match="which modifyParameter changes for all"):
        client.find(word, in_doNormalize=False)


def test_every_name_of_a_representation() -> None:
    for kind in KINDS.values():
        for name in (kind.kind, kind.word, kind.word.upper()):
            assert tree_planner.kind_of(name) is kind


def test_a_number_is_not_reused_after_a_removal(client: Client) -> None:
    """The original counted the processors and chose a name that existed."""
    for hop in (0.01, 0.02, 0.03):
        client.build("ild", ild_hSizeSec=hop)
    client.tree.remove("ild_0")
    assert client.build("ild", ild_hSizeSec=0.04).name == "ild_3"
    assert client.build("ild", ild_hSizeSec=0.01).name == "ild_4"


def test_names_in_use_by_other_clients() -> None:
    free, ild = tree_planner.free_name, KINDS["ild"]
    assert free(ild, ["ild", "ild_x", "ild_-1", "child_7", "ild_7a"]) == "ild_0"
    assert free(ild, ["ild_5", "ild_007"]) == "ild_8"
    assert free(ild, ["ild_999999999", "ild_1000000000"]) == "ild_1000000001"
    assert free(ild, ["ild_" + "9" * 4000]) == "ild_0"


def test_the_tree_of_a_user_is_used(client: Client) -> None:
    """Also if a shorter chain matches as well: existing processors are not created again."""
    client.build("input")
    for kind, name, parent in (
        ("preProc", "bare", "input_0"),
        ("preProc", "own", "input_0"),
        ("gammatone", "g", "own"),
    ):
        client.tree.add(kind, name, parent, {"fb_nChannels": 8} if kind == "gammatone" else {})
    assert client.build("innerhaircell", fb_nChannels=8).dependencies == ["input_0", "own", "g", "innerhaircell_0"]
    assert client.build("time").name == "bare"


@pytest.mark.parametrize(
    "values",
    [{}, {"fb_nChannels": 7}, {"fb_cfHz": [200, 1000]}, {"fb_nERBs": 3.0, "fb_highFreqHz": 5000.0}, {"fb_nGamma": 2}],
)
def test_reported_parameters_mean_the_processor_that_they_describe(client: Client, values: dict[str, Any]) -> None:
    client.build("filterbank", fb_type="drnl")
    name = client.build("filterbank", **values).name
    assert client.build("ratemap", **client.state()[name][2]).dependencies[2] == name == "filterbank_1"
    if not values:
        assert client.build("ratemap", fb_nChannels=31).dependencies[2] == "filterbank_2"


def test_after_modify_parameter(client: Client) -> None:
    client.build("ild")
    client.tree.modify("time_0", "pp_bRemoveDC", "1")
    assert client.build("ild").reused == ["input_0"]
    assert client.build("ild", pp_bRemoveDC=True).created == []


def test_zeros_are_literal(client: Client) -> None:
    client.build("filterbank", pp_coefPreEmphasis=0.0, pp_refSPLdB=0.0, in_doNormalize=False)
    assert client.state()["time_0"][2]["pp_refSPLdB"] == 0.0
    assert client.state()["input_0"][2]["in_doNormalize"] is False


def test_the_one_input(client: Client) -> None:
    assert client.build("time", nFramesPerBlock=4410, bufferSize_s_port=0.5, rm_decaySec=0.1).unused == ["rm_decaySec"]
    values = {"nFramesPerBlock": 4410, "bufferSize_s_port": 0.5, "bufferSize_s_getSignal": 1.0}
    assert client.tree.input_values == values
    result = client.build("time", nFramesPerBlock=2205, bufferSize_s_port=2.0, connect="left/Audio")
    assert (result.created, result.unused) == ([], ["nFramesPerBlock", "bufferSize_s_port", "connect"])
    refused = client.refused("in_normalizeValue 2147483647, which modifyParameter", "time", in_normalizeValue=1)
    assert refused.ex == "::rosAFE::e_existsAlready"
    client.tree.modify("input_0", "in_normalizeValue", "1")
    assert client.build("time").created == client.build("time", in_normalizeValue=1).created == []


def test_an_input_that_another_client_creates_meanwhile_is_used(client: Client) -> None:
    """The sound may arrive for both, or the own wait may have ended without sound."""
    late = Feed(RATE, 441)

    def sound_for_both(new: NewProcessor, create: Callable[[Source], Processor | None]) -> None:
        client.tree.add_input("mine", Feed(RATE, 441), 441, 1.0, 1.0)
        assert create(late) is None

    result = client.builder.request({"representation": "time"}, sound_for_both)
    assert (result.dependencies, result.created, late.stopped) == (["mine", "time_0"], ["time_0"], True)
    client.tree.stop()

    def sound_for_the_other(new: NewProcessor, create: Callable[[Source], Processor | None]) -> None:
        client.tree.add_input("other", Feed(RATE, 441), 441, 1.0, 1.0)

    result = client.builder.request({"representation": "time"}, sound_for_the_other)
    assert result.dependencies == ["other", "time_0"]


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ({"fb_nChannels": 5000}, "fb_nChannels: expected a number from 0 to 1024, got 5000"),
        ({"fb_lowFreqHz": 9000.0}, "fb_lowFreqHz: expected less than fb_highFreqHz"),
        ({"pi_rangeHz": [400.0, 80.0]}, "pi_rangeHz: expected ascending numbers, got [400.0, 80.0]"),
        ({"nFramesPerBlock": 0}, "nFramesPerBlock: expected a number from 1 to 10000000, got 0"),
    ],
)
def test_values_impossible_at_any_sample_rate_are_rejected_first(
    client: Client, values: dict[str, Any], what: str
) -> None:
    refused = client.refused("", "ild", **values)
    assert refused.ex == "::rosAFE::e_badNewValue" and what in refused.detail["what"]
    assert client.feeds == []


def test_values_impossible_at_this_sample_rate_leave_no_processor(client: Client) -> None:
    client.refused("below half the sample rate", "ild", fb_highFreqHz=30000.0)
    client.refused("ild_wSizeSec: expected at least one sample", "ild", ild_wSizeSec=1e-9)
    assert [feed.stopped for feed in client.feeds] == [True, True]
    client.build("time")
    client.refused("below half the sample rate", "ild", fb_highFreqHz=30000.0, pp_bRemoveDC=True)


def test_processors_with_children_of_others_are_not_unused(client: Client) -> None:
    created = client.build("ild").created
    client.tree.add("gammatone", "mine", "time_0")
    assert client.builder.remove_unused([*created, "unknown"]) == ["ild_0", "innerhaircell_0", "filterbank_0"]
    assert list(client.state()) == ["input_0", "time_0", "mine"]
    assert client.builder.remove_unused(["input_0", "time_0", "mine"]) == ["mine", "time_0", "input_0"]


def test_a_plugin_that_fails_with_its_first_block(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its request fails with the reason. Another request waits until it is known which processors stay."""
    monkeypatch.setattr(tree_builder, "BUILTIN", BUILTIN - {"ild"})
    client.build("time")
    begun, release = threading.Event(), threading.Event()

    def process(self: Any, *_: Any) -> Any:
        begun.set()
        release.wait()
        raise OSError("no weights")

    monkeypatch.setattr(STAGES["ild"], "process", process)
    monkeypatch.setattr(tree_builder, "BEGIN_BLOCKS", 1e9)
    others: list[RequestResult] = []

    def steps(number: int) -> None:
        if number == 0:
            with pytest.raises(ComponentError, match=r"'ild_0': ild_0 \(ild\) failed: OSError: no weights") as error:
                client.build("ild")
            assert error.value.ex == "::rosAFE::e_noSuchProcessor"
        else:
            wait_for(lambda: "ild_0" in client.state())
            client.feeds[0].put(count=1)
            assert begun.wait(10)
            release.set()
            others.append(client.build("innerhaircell"))

    run_together(2, steps)
    assert others[0].created == ["filterbank_0", "innerhaircell_0"]
    assert list(client.state()) == others[0].dependencies


def test_a_long_window_costs_nothing() -> None:
    """The node creates or rejects it."""
    tracemalloc.start()
    try:
        tree_planner.parse_request(KINDS["ild"], {"ild_wSizeSec": 60.0})
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()
