"""Arguments of `request` and `find` by clients without types: every form that is accepted, and errors."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe import interface
from rosafe.interface import KINDS, ROSAFE, ComponentError
from rosafe.ros1.client.values import partial
from rosafe.tree import tree_planner

REPRESENTATIONS = [kind.word for kind in KINDS.values()]


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
        parsed = tree_planner.parse_request(tree_planner.kind_of(values.pop("representation")), values)
    except ComponentError as refused:
        assert refused.ex in ("::genom::serialization", "::rosAFE::e_badNewValue")
        assert refused.detail["what"]
    else:
        assert parsed.kinds[0] == "input"
