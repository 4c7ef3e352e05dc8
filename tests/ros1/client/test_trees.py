"""Requests for trees create, reuse and remove processors of an in-process tree that other clients change."""

from __future__ import annotations

import asyncio
import tracemalloc
from collections.abc import Mapping
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe import interface
from rosafe.dsp.stage import Stage
from rosafe.interface import KINDS, ROSAFE, ComponentError
from rosafe.representations import BUILTIN, STAGES
from rosafe.ros1.client.values import partial
from rosafe.tree import tree_builder
from rosafe.tree import tree_planner as request
from tests.ros1.client.model import RATE, Model

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
    "rm_scaling": ["power", "magnitude"],
    "cc_wname": ["hann", "hamming"],
}
_ALWAYS: dict[str, st.SearchStrategy[Any]] = {}
PARAMETERS = st.fixed_dictionaries(_ALWAYS, optional={name: st.sampled_from(values) for name, values in VALUES.items()})
REQUESTS = st.tuples(st.sampled_from(REPRESENTATIONS), PARAMETERS)
CHANGES = st.tuples(st.integers(0, 10**6), st.sampled_from(["remove", "stop", *VALUES]))


def build(model: Model, representation: str, **parameters: Any) -> dict[str, Any]:
    """The answer to one request."""
    return asyncio.run(tree_builder.build(model, {"representation": representation, **parameters}))


def find(model: Model, representation: str, **parameters: Any) -> dict[str, Any]:
    """Return the matching processors that exist."""
    return asyncio.run(tree_builder.find(model, {"representation": representation, **parameters}))


def in_force(kind: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the description of a processor with these parameters."""
    return stage(kind, parameters).parameters


def stage(kind: str, parameters: Mapping[str, Any]) -> Stage:
    """Return a stage of this kind with its ancestors."""
    own = {p.name: parameters[p.name] for p in KINDS[kind].parameters if p.name in parameters}
    parent = KINDS[kind].parent
    return STAGES[kind](stage(parent, parameters).output_format if parent else RATE, **own)


def check(
    model: Model, before: Mapping[str, Any], requested: tuple[str, Mapping[str, Any]], response: dict[str, Any]
) -> None:
    """The tree is as requested, and only missing processors were created."""
    representation, parameters = requested
    names, state = response["dependencies"], model.state()
    assert names == list(model.line(response["name"]))[::-1]
    assert [state[name][0] for name in names] == [
        k.kind for k in request.ancestor_kinds(request.kind_of(representation))
    ]
    for name in names:
        kind, _, values = state[name]
        assert values == in_force(kind, parameters), name
    assert response["created"] == [name for name in names if name not in before]
    assert response["reused"] == [name for name in names if name in before]
    assert {name: state[name] for name in before} == before and set(state) == {*before, *names}
    for name in response["created"]:
        kind, parent, values = state[name]
        twins = [other for other, known in before.items() if known == (kind, parent, values)]
        assert not twins, f"{name} is {twins} once more"


def disturb(model: Model, number: int, what: str) -> None:
    """Changes by other clients: remove or change one processor, or all."""
    names = [name for name, processor in model.processors.items() if processor.parent]
    if what == "stop":
        model.processors.clear()
    elif names and what == "remove":
        model._removeProcessor("", {"name": names[number % len(names)]})
    for name in names:
        if what in VALUES and what in (p.name for p in KINDS[model.processors[name].kind].parameters):
            model.processors[name].stage.configure(**{what: VALUES[what][number % len(VALUES[what])]})
            return


@settings(max_examples=50)
@given(st.lists(st.one_of(REQUESTS, CHANGES), max_size=8))
def test_any_sequence_of_requests_and_changes(acts: list[tuple[Any, Any]]) -> None:
    model = Model()
    for act in acts:
        if isinstance(act[0], int):
            disturb(model, *act)
            continue
        before = model.state()
        response = build(model, act[0], **act[1])
        check(model, before, act, response)
        again = build(model, act[0], **act[1])
        assert (again["dependencies"], again["created"]) == (response["dependencies"], [])


@settings(max_examples=40)
@given(st.lists(REQUESTS, min_size=2, max_size=5))
def test_independent_clients(requested: list[tuple[str, dict[str, Any]]]) -> None:
    """Concurrent requests without a lock: each gets its processors, and there are no duplicates."""
    model = Model()

    async def all_at_once() -> list[dict[str, Any]]:
        return await asyncio.gather(*(tree_builder.build(model, {"representation": r, **p}) for r, p in requested))

    answers = asyncio.run(all_at_once())
    for (representation, parameters), response in zip(requested, answers, strict=True):
        assert [model.processors[name].kind for name in response["dependencies"]] == [
            k.kind for k in request.ancestor_kinds(request.kind_of(representation))
        ]
        for name in response["dependencies"]:
            processor = model.processors[name]
            assert processor.stage.parameters == in_force(processor.kind, parameters)
    for name, one in model.state().items():
        assert [other for other, state in model.state().items() if state == one] == [name]


@settings(max_examples=40)
@given(REQUESTS, REQUESTS, st.integers(0, 20), st.booleans(), st.integers(1, 10))
def test_a_failed_request_leaves_no_processor(
    first: tuple[str, dict[str, Any]], requested: tuple[str, dict[str, Any]], at: int, cancelled: bool, again: int
) -> None:
    """Rejected and cancelled requests, also if the cleanup is cancelled again."""
    model = Model()
    build(model, first[0], **first[1])
    before, number = model.state(), len(model.calls) + at
    error = ComponentError("::genom::syserr", code=12)

    async def go() -> dict[str, Any]:
        task = asyncio.create_task(tree_builder.build(model, {"representation": requested[0], **requested[1]}))
        if cancelled:
            model.cancel[number] = model.cancel[number + again] = task
        else:
            model.fail[number] = error
        try:
            return await task
        finally:
            await asyncio.gather(*(a for a in model.answers if not a.done()), return_exceptions=True)

    try:
        asyncio.run(go())
    except (ComponentError, asyncio.CancelledError) as problem:
        assert isinstance(problem, asyncio.CancelledError) if cancelled else problem is error
        assert model.state() == before
    else:
        assert len(model.calls) <= number + 1


# --- one by one -------------------------------------------------------------------------------------------------


def test_names_are_those_of_the_original_client() -> None:
    model = Model()
    response = build(model, "ild")
    chain = ["input_0", "time_0", "filterbank_0", "innerhaircell_0", "ild_0"]
    assert response["dependencies"] == response["created"] == chain
    assert (response["name"], response["port"], response["topic"]) == ("ild_0", "ildPort", "/rosAFE/ildPort/ild_0")
    assert response["reused"] == response["unused"] == []
    assert build(model, "ratemap")["created"] == ["ratemap_0"]
    assert build(model, "crosscorrelation", cc_maxDelaySec=0.002)["created"] == ["crosscorrelation_0"]
    response = build(model, "input")
    assert (response["dependencies"], response["port"], response["topic"]) == (
        ["input_0"],
        "inputProcPort",
        "/rosAFE/inputProcPort",
    )


@pytest.mark.parametrize("word", REPRESENTATIONS)
def test_existing_processors_are_reused_and_found(word: str) -> None:
    """Also if the effective values of the processor differ from the requested ones."""
    model = Model()
    with pytest.raises(ComponentError, match="missing: InputProc") as missing:
        find(model, word)
    assert missing.value.ex == "::rosAFE::e_noSuchProcessor" and not model.processors
    response = build(model, word)
    again = {**response, "created": [], "reused": response["created"]}
    assert build(model, word) == find(model, word) == again
    calls = model.calls[:]
    if word not in ("input", "time"):
        with pytest.raises(ComponentError, match="missing: GammatoneProc"):
            find(model, word, fb_nChannels=7)
        assert model.calls == [*calls, "getProcessors"]
    with pytest.raises(ComponentError, match="which modifyParameter changes for all"):
        find(model, word, in_doNormalize=False)


def test_every_name_of_a_representation() -> None:
    for kind in KINDS.values():
        for name in (kind.kind, kind.word, kind.word.upper()):
            assert request.kind_of(name) is kind


def test_a_number_is_not_reused_after_a_removal() -> None:
    """The original counted the processors and chose a name that existed."""
    model = Model()
    for hop in (0.01, 0.02, 0.03):
        build(model, "ild", ild_hSizeSec=hop)
    model._removeProcessor("", {"name": "ild_0"})
    assert build(model, "ild", ild_hSizeSec=0.04)["name"] == "ild_3"
    assert build(model, "ild", ild_hSizeSec=0.01)["name"] == "ild_4"


def test_names_in_use_by_other_clients() -> None:
    free = request.free_name
    ild = KINDS["ild"]
    assert free(ild, ["ild", "ild_x", "ild_-1", "child_7", "ild_7a"]) == "ild_0"
    assert free(ild, ["ild_5", "ild_007"]) == "ild_8"
    assert free(ild, ["ild_999999999", "ild_1000000000"]) == "ild_1000000001"
    assert free(ild, ["ild_" + "9" * 4000]) == "ild_0"


def test_the_tree_of_a_user_is_used() -> None:
    """Also if a shorter chain matches as well: existing processors are not created again."""
    model = Model()
    build(model, "input")
    steps: list[tuple[str, dict[str, Any]]] = [
        ("PreProc", {"name": "bare", "upperDepName": "input_0"}),
        ("PreProc", {"name": "preProc", "upperDepName": "input_0"}),
        ("GammatoneProc", {"name": "gammatone", "upperDepName": "preProc", "fb_nChannels": 8}),
    ]
    for service, values in steps:
        defaults = {p.name: p.default for p in ROSAFE.service(service).parameters}
        asyncio.run(model.outputs(service, {**defaults, **values}))
    response = build(model, "innerhaircell", fb_nChannels=8)
    assert response["dependencies"] == ["input_0", "preProc", "gammatone", "innerhaircell_0"]
    assert build(model, "time")["name"] == "bare"


@pytest.mark.parametrize(
    "values",
    [{}, {"fb_nChannels": 7}, {"fb_cfHz": [200, 1000]}, {"fb_nERBs": 3.0, "fb_highFreqHz": 5000.0}, {"fb_nGamma": 2}],
)
def test_a_structure_of_getparameters_means_the_processor_that_it_describes(values: dict[str, Any]) -> None:
    model = Model()
    build(model, "filterbank", fb_type="drnl")
    build(model, "filterbank", **values)
    name, processor = [(n, p) for n, p in model.processors.items() if p.kind == "gammatone"][1]
    response = {"name": name, **processor.stage.parameters}
    assert response["name"] == "filterbank_1"
    structures: tuple[dict[str, Any], ...] = ({"filterbank": response}, {"gammatone": [response]})
    for structure in structures:
        requested = partial({"representation": "ratemap", **structure})
        assert asyncio.run(tree_builder.build(model, requested))["dependencies"][2] == "filterbank_1"
    if not values:
        assert build(model, "ratemap", fb_nChannels=31)["dependencies"][2] == "filterbank_2"


def test_after_modify_parameter() -> None:
    model = Model()
    build(model, "ild")
    model._modifyParameter("", {"nameProc": "time_0", "nameParam": "pp_bRemoveDC", "newValue": "1"})
    assert build(model, "ild")["reused"] == ["input_0"]
    assert build(model, "ild", pp_bRemoveDC=True)["created"] == []


def test_zeros_are_literal_and_other_input_parameters_are_set_before_it_has_children() -> None:
    model = Model()
    build(model, "filterbank", pp_coefPreEmphasis=0.0, pp_refSPLdB=0.0, in_doNormalize=False)
    made = [call for call in model.calls if not call.startswith("get")]
    assert made == [
        "connect_port",
        "InputProc",
        "modifyParameter",
        "PreProc",
        "GammatoneProc",
    ]
    assert model.state()["time_0"][2]["pp_refSPLdB"] == 0.0
    assert model.state()["input_0"][2]["in_doNormalize"] is False


def test_the_one_input() -> None:
    model = Model()
    assert build(model, "time", nFramesPerBlock=4410, rm_decaySec=0.1)["unused"] == ["rm_decaySec"]
    response = build(model, "time", nFramesPerBlock=2205, bufferSize_s_port=2.0, connect="left/Audio")
    assert response["created"] == []
    assert response["unused"] == ["nFramesPerBlock", "bufferSize_s_port", "connect"]
    with pytest.raises(ComponentError, match="in_normalizeValue 2147483647, which modifyParameter") as refused:
        build(model, "time", in_normalizeValue=1)
    assert refused.value.ex == "::rosAFE::e_existsAlready"
    model._modifyParameter("", {"nameProc": "input_0", "nameParam": "in_normalizeValue", "newValue": "1"})
    assert build(model, "time")["created"] == build(model, "time", in_normalizeValue=1)["created"] == []


def test_the_sound() -> None:
    for named, there, requested in (
        ("", "", "bass/Audio"),
        ("", "left/Audio", "left/Audio"),
        ("x/y", "left/Audio", "x/y"),
    ):
        model = Model()
        model.connected = there
        build(model, "input", **({"connect": named} if named else {}))
        assert model.connected == requested
    silent = Model(audio=False)
    with pytest.raises(ComponentError) as refused:
        build(silent, "ild")
    assert refused.value.ex == "::rosAFE::e_noData" and not silent.processors


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ({"fb_nChannels": 5000}, "fb_nChannels: expected a number from 0 to 1024, got 5000"),
        ({"fb_lowFreqHz": 9000.0}, "fb_lowFreqHz: expected less than fb_highFreqHz"),
        ({"fb_nERBs": 0.001}, "fb_nERBs: expected a distance that gives at most"),
        ({"fb_highFreqHz": 0.0}, "fb_highFreqHz: expected a number above 0, at most 1000000, got 0"),
        ({"ihc_method": "hilbrt"}, "ihc_method: expected one of none, halfwave"),
        ({"ild_wSizeSec": 61.0}, "ild_wSizeSec: expected a number above 0, at most 60, got 61"),
        ({"fb_lowFreqHz": 600.0, "fb_highFreqHz": 500.0}, "fb_lowFreqHz: expected less than fb_highFreqHz"),
        ({"rm_decaySec": -1.0}, "rm_decaySec: expected a number above 0, at most 3600, got -1"),
        ({"pi_rangeHz": [400.0, 80.0]}, "pi_rangeHz: expected ascending numbers, got [400.0, 80.0]"),
        ({"ams_lowFreqHz": 500.0, "ams_highFreqHz": 5.0}, "ams_highFreqHz: expected more than ams_lowFreqHz (500 Hz)"),
        ({"nFramesPerBlock": 0}, "nFramesPerBlock: expected a number from 1 to 10000000, got 0"),
        ({"bufferSize_s_port": 1e9}, "bufferSize_s_port"),
    ],
)
def test_values_impossible_at_any_sample_rate_are_rejected_without_a_call(values: dict[str, Any], what: str) -> None:
    model = Model()
    with pytest.raises(ComponentError) as refused:
        build(model, "ild", **values)
    assert refused.value.ex == "::rosAFE::e_badNewValue"
    assert what in refused.value.detail["what"]
    assert model.calls == []


def test_values_impossible_at_this_sample_rate_leave_no_processor() -> None:
    model = Model()
    for values, what in (
        ({"fb_highFreqHz": 30000.0}, "below half the sample rate"),
        ({"ild_wSizeSec": 1e-9}, "ild_wSizeSec: expected at least one sample"),
    ):
        with pytest.raises(ComponentError, match=what):
            build(model, "ild", **values)
        assert len(model.calls) > 3 and not model.processors
    build(model, "time")
    before = model.state()
    with pytest.raises(ComponentError, match="below half the sample rate"):
        build(model, "ild", fb_highFreqHz=30000.0, pp_bRemoveDC=True)
    assert model.state() == before


def test_processors_that_other_clients_use_remain() -> None:
    model = Model()

    async def go() -> None:
        failing = asyncio.create_task(tree_builder.build(model, {"representation": "ild", "fb_highFreqHz": 30000.0}))
        while "time_0" not in model.processors:
            await asyncio.sleep(0)
        defaults = {p.name: p.default for p in ROSAFE.service("GammatoneProc").parameters}
        model._make("GammatoneProc", {**defaults, "name": "mine", "upperDepName": "time_0"})
        with pytest.raises(ComponentError, match="half the sample rate"):
            await failing

    asyncio.run(go())
    assert list(model.processors) == ["input_0", "time_0", "mine"]


def test_a_plugin_that_fails_before_it_is_listed_is_created_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tree_builder, "BUILTIN", BUILTIN - {"ild"})
    reason = "there is no processor 'ild_0': ild_0 (ild) failed: plugin ild: process: OSError"

    class Failing(Model):
        def _IldProc(self, service: str, values: Mapping[str, Any]) -> dict[str, Any]:
            self._make(service, values)
            del self.processors[values["name"]]
            return {}

        def _getDependencies(self, _: str, values: Mapping[str, Any]) -> dict[str, Any]:
            if values["nameProc"] not in self.processors:
                raise ROSAFE.error("e_noSuchProcessor", reason)
            return {}

    model = Failing()
    with pytest.raises(ComponentError, match="OSError") as caught:
        build(model, "ild")
    assert reason in str(caught.value)
    assert model.calls.count("IldProc") == 1 and not model.processors


def test_words_that_the_guide_misspells() -> None:
    model = Model()
    assert build(model, "time", pp_middleEarModel="jespen")["created"] == ["input_0", "time_0"]
    assert build(model, "time")["created"] == []


def test_a_long_window_costs_nothing() -> None:
    """The node creates or rejects it."""
    tracemalloc.start()
    try:
        request.parse_request(KINDS["ild"], {"ild_wSizeSec": 60.0})
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


# --- arguments --------------------------------------------------------------------------------------------------


def test_arguments_by_name_and_structure() -> None:
    requested: dict[str, Any] = {"representation": "ild", "fb_nChannels": 16, "fb_cfHz": [100.0, 200.0]}
    for form in (
        requested,
        ["ild", {"fb_nChannels": "16", "fb_cfHz": {"0": 100, "1": "200"}}],
        {"representation": "ild", "gammatone": {"name": "x", "fb_nChannels": 16}, "fb_cfHz": [100, 200]},
        {"representation": "ild", "filterbank": [{"fb_nChannels": 16, "fb_cfHz": [100, 200]}], "ild": [], "ihc": {}},
        {**requested, "fb_nERBs": None, "connect": None},
    ):
        assert partial(form) == requested, form
    for bare in (["ild"], ["ild", {}], ["ild", []], ["ild", ""], ["ild", None]):
        assert partial(bare) == {"representation": "ild"}, bare
    assert partial({"representation": "IHC", "pp_refSPLdBS": 90}) == {"representation": "IHC", "pp_refSPLdB": 90.0}


def test_the_table_has_every_parameter_of_a_chain_once() -> None:
    names = [p.name for p in interface.REQUEST.parameters]
    inputs = [p.name for p in ROSAFE.service("InputProc").parameters if p.name != "name"]
    own = list(dict.fromkeys(p.name for kind in KINDS.values() for p in kind.parameters))
    assert names == ["representation", "connect", *inputs, *own]
    assert len({*names}) == len(names)
    assert interface.REQUEST.parameter("representation").choices == tuple(REPRESENTATIONS)


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({}, "representation is missing; one of input, time"),
        ([], "representation is missing"),
        ([{}], "representation is missing"),
        ("ild", "expected an object or an array"),
        (
            ["ild", {"fb_nERB": 1}],
            "request: expected a known parameter, got 'fb_nERB'; request takes representation, connect",
        ),
        (["ild", {"name": "x"}], "expected a known parameter, got 'name'"),
        (["ild", {"fb_nChannels": [1]}], "fb_nChannels"),
        (["ild", {"fb_nChannels": float("nan")}], "fb_nChannels"),
        (["ild", {"fb_nChannels": 1, "gammatone": {"fb_nChannels": 1}}], "fb_nChannels: expected one value, got two"),
        (["ild", {"gammatone": [{}, {}]}], "gammatone: expected an object"),
        (["ild", {"gammatone": 1}], "gammatone: expected an object"),
        ([7], "representation"),
        (["spikes"], "representation: expected one of input, time, filterbank"),
        (["ild", "fb_nChannels", 16], "expected the parameters in one object after representation, got 'fb_nChannels'"),
        (["ild", 16], "in one object after representation, got '16'"),
    ],
)
def test_arguments_that_are_rejected(given: Any, what: str) -> None:
    with pytest.raises(ComponentError, match=what) as refused:
        partial(given)
    assert refused.value.ex == "::genom::serialization"


_NAMES = st.sampled_from(
    ["representation", "gammatone", "ihc", "name", *(p.name for p in interface.REQUEST.parameters)]
)
_SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=4),
    st.sampled_from([*REPRESENTATIONS, "1e3", "0x1", "nan", 0, 1, 16, 1e-300, 1e400]),
)
_JSON = st.recursive(
    _SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.one_of(_NAMES, st.text(max_size=2)), inner, max_size=4)
    ),
    max_leaves=8,
)


@settings(max_examples=40)
@given(st.one_of(_JSON, st.dictionaries(_NAMES, _SCALARS).map(lambda form: {**form, "representation": "ild"})))
def test_any_input_is_accepted_or_rejected(form: Any) -> None:
    try:
        values = partial(form)
        parsed = request.parse_request(request.kind_of(values.pop("representation")), values)
    except ComponentError as refused:
        assert refused.ex in ("::genom::serialization", "::rosAFE::e_badNewValue")
        assert refused.detail["what"]
    else:
        assert parsed.kinds[0] == "input"
