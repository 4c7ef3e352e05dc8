"""Arguments of clients: completed from the interface table, converted, or rejected with a helpful message."""

from __future__ import annotations

import dataclasses
import json
import tkinter
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosafe import interface
from rosafe.declarations.idl import element
from rosafe.interface import BASS, REQUIRED, ROSAFE, ComponentError, Parameter, Service
from rosafe.ros1.client.values import complete, parse_input, tcl_list

SERVICES = [service for component in interface.COMPONENTS.values() for service in component.on_graph]
GAMMATONE = ROSAFE.service("GammatoneProc")
INPUT = ROSAFE.service("InputProc")
PRE = ROSAFE.service("PreProc")


def refusal(service: Service, given: Any) -> str:
    with pytest.raises(ComponentError) as caught:
        complete(service, given)
    assert caught.value.ex == "::genom::serialization"
    return str(caught.value.detail["what"])


@pytest.mark.parametrize("service", SERVICES, ids=lambda s: s.name)
def test_without_arguments_all_are_defaults_or_the_first_missing_one_is_named(service: Service) -> None:
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
    assert "InputProc: expected at most 4 arguments, got 5; InputProc takes name (string)" in refusal(
        INPUT, [1, 2, 3, 4, 5]
    )


def test_only_parameters_of_other_components_are_checked_by_the_client() -> None:
    """The component checks its own parameters; a component without declarations gets only values that it can take."""
    speed = Parameter("speed", "string", REQUIRED, "", choices=("::arm::SLOW",), spellings={"SLOW": "::arm::SLOW"})
    of_three = Parameter("joints", "sequence<double>", REQUIRED, "", least=3, most=3)
    for checked in (True, False):
        parameters = tuple(dataclasses.replace(p, checked_by_client=checked) for p in (speed, of_three))
        service = Service("Move", "", parameters)
        if checked:
            assert complete(service, ["SLOW", [1, 2, 3]]) == {"speed": "::arm::SLOW", "joints": [1.0, 2.0, 3.0]}
            assert "'FAST'" in refusal(service, ["FAST", [1, 2, 3]])
            assert "joints" in refusal(service, ["SLOW", [1, 2]])
        else:
            assert complete(service, ["FAST", [1, 2]]) == {"speed": "FAST", "joints": [1.0, 2.0]}


def test_aliases_of_the_guide() -> None:
    assert complete(PRE, {"pp_refSPLdBS": 90})["pp_refSPLdB"] == 90
    assert complete(ROSAFE.service("removeProcessor"), {"nameProc": "x"}) == {"name": "x"}
    assert "pp_refSPLdB: expected one value, got two" in refusal(PRE, {"pp_refSPLdBS": 90, "pp_refSPLdB": 90})


def test_words_stay_as_they_are() -> None:
    assert complete(PRE, {"pp_middleEarModel": "jespen"})["pp_middleEarModel"] == "jespen"


VALUES: tuple[tuple[Service, str, Any, list[Any]], ...] = (
    (PRE, "pp_bRemoveDC", True, ["1", "true", "yes", "T", 1]),
    (PRE, "pp_bRemoveDC", False, ["0", "False", "no", 0]),
    (PRE, "pp_cutoffHzDC", 20.0, ["20", "2E1", " 20. ", 20]),
    (INPUT, "nFramesPerBlock", 2**32 - 1, ["4294967295", 4294967295.0]),
    (GAMMATONE, "fb_cfHz", [0.5, 200.0], [["0.5", "200"], [0.5, 200], {"1": 200, "0": ".5"}]),
    (GAMMATONE, "fb_cfHz", [], [[], {}, 0, [0], "", "0", None]),
    (GAMMATONE, "fb_cfHz", [440.0], [440, "440"]),
)


@pytest.mark.parametrize(("service", "name", "value", "given"), VALUES)
def test_values_of_clients(service: Service, name: str, value: Any, given: list[Any]) -> None:
    for one in given:
        got = complete(service, {name: one})[name]
        assert got == value and isinstance(got, bool) is isinstance(value, bool), one


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"fb_nERB": 1}, "GammatoneProc: expected a known parameter, got 'fb_nERB'; GammatoneProc takes name (string)"),
        (
            {"fb_nERBs": "many"},
            "fb_nERBs: expected a finite number, got 'many' (fb_nERBs is a double; above 0, at most 100)",
        ),
        ({"fb_nERBs": None}, "fb_nERBs is a double"),
        ({"fb_nERBs": [1]}, "fb_nERBs is a double"),
        ({"fb_nERBs": {"a": 1}}, "fb_nERBs is a double"),
        ({"fb_nERBs": float("nan")}, "fb_nERBs: expected a finite number, got nan"),
        ({"fb_nERBs": "1_0"}, "fb_nERBs is a double"),
        ({"fb_nGamma": 1.5}, "fb_nGamma: expected a whole number, got 1.5"),
        ({"fb_nGamma": -1}, "fb_nGamma: expected a number in the range of unsigned long, got -1"),
        ({"fb_nGamma": 10**400}, "fb_nGamma"),
        ({"name": 5}, "name: expected a string, got 5 (name is a string)"),
        ({"name": "x" * 5000}, "name"),
        ({"fb_cfHz": {"0": 1, "2": 2}}, "expected the indexes from 0 on"),
        ({"fb_cfHz": [[1]]}, "fb_cfHz"),
        ({"fb_cfHz": ["a"]}, "fb_cfHz is a sequence<double>"),
        ({"fb_cfHz": [100.0] * 2000}, "fb_cfHz: expected at most 1024 values, got more"),
        (5, "input: expected an object or an array"),
        ("text", "input: expected an object or an array"),
        (None, "input: expected an object or an array"),
    ],
)
def test_errors_name_the_argument_and_the_allowed_values(given: Any, reason: str) -> None:
    assert reason in refusal(GAMMATONE, given)


def test_ranges_are_checked_by_the_component() -> None:
    assert complete(GAMMATONE, {"fb_nERBs": -3})["fb_nERBs"] == -3
    assert complete(BASS.service("Acquire"), {"nFramesPerChunk": 0})["nFramesPerChunk"] == 0


@pytest.mark.parametrize("text", ["{", "{'a':1}", "[1,", "nul", "[" * 100_000, "1" * 5000, '{"a":1}}'])
def test_invalid_json_is_rejected(text: str) -> None:
    with pytest.raises(ComponentError, match="input: expected JSON"):
        parse_input(text)


def test_an_empty_input_has_no_arguments() -> None:
    assert parse_input("") == parse_input("  ") == {}


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=10,
)


@settings(max_examples=25, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_any_input_gets_the_right_types_or_is_rejected(data: st.DataObject) -> None:
    service = data.draw(st.sampled_from(SERVICES))
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


@settings(derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(st.text(alphabet='ab {}"\\$[ ', max_size=12))
def test_tcl_lists_are_split_as_tcl_does(text: str) -> None:
    """Lists with quotes, backslashes or unbalanced braces are not split."""
    words = tcl_list(text)
    try:
        expected = list(tkinter.Tcl().splitlist(text))
    except tkinter.TclError:
        assert words is None
    else:
        assert words is None or words == expected
        assert words is not None or any(mark in text for mark in '"\\{}')
