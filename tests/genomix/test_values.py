"""Arguments of clients: completed from the interface table, converted, or refused in words that help."""

from __future__ import annotations

import json
import tkinter
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe import interface
from rosafe.client.values import complete, parse_input, tcl_list
from rosafe.declarations.idl import element
from rosafe.interface import BASS, REQUIRED, ROSAFE, ComponentError, Service

GAMMATONE = ROSAFE.service("GammatoneProc")
INPUT = ROSAFE.service("InputProc")
PRE = ROSAFE.service("PreProc")


def refusal(service: Service, given: Any) -> str:
    with pytest.raises(ComponentError) as caught:
        complete(service, given)
    assert caught.value.ex == "::genom::serialization"
    return str(caught.value.detail["what"])


@pytest.mark.parametrize("service", [s for _, s in interface.all_services()], ids=lambda s: s.name)
def test_nothing_given_is_all_defaults_or_a_refusal_that_names_the_first_missing(service: Service) -> None:
    required = [p.name for p in service.parameters if p.default is REQUIRED]
    if required:
        assert f"{required[0]} is missing" in refusal(service, {})
    else:
        free = {p.name for p in service.parameters if p.follows_rate}
        values = complete(service, {})
        assert {name for name, value in values.items() if value != value} == free  # not a number: not given
        assert list(values) == [p.name for p in service.parameters]
        assert all(value == service.parameter(name).default for name, value in values.items() if name not in free)
        assert str(complete(service, [])) == str(values)


def test_partial_arguments_in_any_order_are_completed() -> None:
    values = complete(GAMMATONE, {"fb_nChannels": 16, "name": "left"})
    assert list(values) == [p.name for p in GAMMATONE.parameters]
    assert (values["name"], values["upperDepName"], values["fb_nChannels"]) == ("left", "preProc", 16)


def test_positions() -> None:
    assert complete(INPUT, ["in", 4410])["nFramesPerBlock"] == 4410
    assert "5 arguments are too many; InputProc takes name (string)" in refusal(INPUT, [1, 2, 3, 4, 5])


def test_aliases_of_the_guide() -> None:
    assert complete(PRE, {"pp_refSPLdBS": 90})["pp_refSPLdB"] == 90
    assert complete(ROSAFE.service("removeProcessor"), {"nameProc": "x"}) == {"name": "x"}
    assert "given twice" in refusal(PRE, {"pp_refSPLdBS": 90, "pp_refSPLdB": 90})


def test_words_stay_as_they_are() -> None:
    assert complete(PRE, {"pp_middleEarModel": "jespen"})["pp_middleEarModel"] == "jespen"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", True),
        ("0", False),
        ("true", True),
        ("False", False),
        ("yes", True),
        ("no", False),
        ("T", True),
        ("F", False),
    ],
)
def test_booleans_as_text(text: str, value: bool) -> None:
    assert complete(PRE, {"pp_bRemoveDC": text})["pp_bRemoveDC"] is value
    assert complete(PRE, {"pp_bRemoveDC": int(value)})["pp_bRemoveDC"] is value


@pytest.mark.parametrize(("text", "value"), [("20E-3", 0.02), (" 5 ", 5.0), ("-.5", -0.5), (7, 7.0)])
def test_numbers_as_text(text: Any, value: float) -> None:
    assert complete(PRE, {"pp_cutoffHzDC": text})["pp_cutoffHzDC"] == value


def test_whole_numbers_keep_all_their_digits() -> None:
    assert complete(INPUT, {"nFramesPerBlock": "4294967295"})["nFramesPerBlock"] == 2**32 - 1
    assert complete(INPUT, {"nFramesPerBlock": 12000.0})["nFramesPerBlock"] == 12000


@pytest.mark.parametrize(
    "given",
    [[100, 200.5], ["100", "200.5"], {"0": 100, "1": 200.5}, {"1": 200.5, "0": "100"}],
)
def test_sequences(given: Any) -> None:
    assert complete(GAMMATONE, {"fb_cfHz": given})["fb_cfHz"] == [100.0, 200.5]


@pytest.mark.parametrize("given", [[], {}, 0, [0], "", "0", None])
def test_what_means_no_list(given: Any) -> None:
    assert complete(GAMMATONE, {"fb_cfHz": given})["fb_cfHz"] == []


def test_a_single_number_is_a_list_of_one() -> None:
    assert complete(GAMMATONE, {"fb_cfHz": 440})["fb_cfHz"] == [440.0]
    assert complete(GAMMATONE, {"fb_cfHz": "440"})["fb_cfHz"] == [440.0]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"fb_nERB": 1}, "unknown parameter 'fb_nERB'; GammatoneProc takes name (string)"),
        ({"fb_nERBs": "many"}, "fb_nERBs: 'many' is not a finite number (fb_nERBs is a double; more than 0 to 100)"),
        ({"fb_nERBs": None}, "fb_nERBs is a double"),
        ({"fb_nERBs": [1]}, "fb_nERBs is a double"),
        ({"fb_nERBs": {"a": 1}}, "fb_nERBs is a double"),
        ({"fb_nERBs": float("nan")}, "fb_nERBs: nan is not a finite number"),
        ({"fb_nERBs": "1_0"}, "fb_nERBs is a double"),
        ({"fb_nGamma": 1.5}, "fb_nGamma: 1.5 is not a whole number"),
        ({"fb_nGamma": -1}, "fb_nGamma: -1 is not in the range of unsigned long"),
        ({"fb_nGamma": 10**400}, "fb_nGamma"),
        ({"name": 5}, "name: 5 is not a string (name is a string)"),
        ({"name": "x" * 5000}, "name"),
        ({"fb_cfHz": {"0": 1, "2": 2}}, "the keys of a sequence"),
        ({"fb_cfHz": [[1]]}, "fb_cfHz"),
        ({"fb_cfHz": ["a"]}, "fb_cfHz is a sequence<double>"),
        ({"fb_cfHz": [100.0] * 2000}, "too many values, at most 1024"),
        (5, "input is neither an object nor an array"),
        ("text", "input is neither an object nor an array"),
        (None, "input is neither an object nor an array"),
    ],
)
def test_refusals_name_the_argument_and_say_what_is_allowed(given: Any, told: str) -> None:
    assert told in refusal(GAMMATONE, given)


def test_ranges_are_for_the_component_to_judge() -> None:
    assert complete(GAMMATONE, {"fb_nERBs": -3})["fb_nERBs"] == -3
    assert complete(BASS.service("Acquire"), {"nFramesPerChunk": 0})["nFramesPerChunk"] == 0


@pytest.mark.parametrize("text", ["{", "{'a':1}", "[1,", "nul", "[" * 100_000, "1" * 5000, '{"a":1}}'])
def test_what_is_not_json_is_refused(text: str) -> None:
    with pytest.raises(ComponentError, match="input is not JSON"):
        parse_input(text)


def test_no_input_is_no_arguments() -> None:
    assert parse_input("") == parse_input("  ") == {}


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=10,
)


@settings(deadline=None)
@given(st.data())
def test_whatever_comes_is_of_the_right_types_or_refused(data: st.DataObject) -> None:
    _, service = data.draw(st.sampled_from(list(interface.all_services())))
    names = [p.name for p in service.parameters] or ["none"]
    given = data.draw(st.dictionaries(st.sampled_from(names), values, max_size=3) | values)
    try:
        completed = complete(service, parse_input(json.dumps(given)))
    except ComponentError as problem:
        assert problem.ex == "::genom::serialization"
        assert problem.detail["what"]
        return
    kinds = {"string": str, "boolean": bool, "double": float}
    for parameter in service.parameters:
        value = completed[parameter.name]
        if of := element(parameter.idl):
            assert all(type(item) is kinds[of] for item in value)
        elif parameter.name in (given if isinstance(given, dict) else ()):
            assert type(value) is kinds.get(parameter.idl, int)


@settings(deadline=None)
@given(st.text(alphabet='ab {}"\\$[ ', max_size=12))
def test_tcl_lists_are_split_as_tcl_does(text: str) -> None:
    """Or not at all: quotes, backslashes and unbalanced braces."""
    words = tcl_list(text)
    try:
        expected = list(tkinter.Tcl().splitlist(text))
    except tkinter.TclError:
        assert words is None
    else:
        assert words is None or words == expected
        assert words is not None or any(mark in text for mark in '"\\{}')
