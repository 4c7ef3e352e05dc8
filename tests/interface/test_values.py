"""Checks of values from Python, from the texts of modifyParameter, and from ROS requests without defaults."""

from __future__ import annotations

import dataclasses
import itertools
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosafe.interface import BASS, MAX_SEQUENCE, REQUIRED, ROSAFE, Parameter, format_value, ros_type
from rosafe.representations import STAGES

BOOLEAN = Parameter("flag", "boolean", False, "")
UNSIGNED = Parameter("count", "unsigned long", 1, "")
LARGE = Parameter("large", "unsigned long long", 1, "", 1, 2**64 - 1)
SIGNED = Parameter("offset", "long", 0, "")
NUMBER = Parameter("number", "double", 1.0, "", 0.0, 10.0, open_minimum=True)
LIST = Parameter("list", "sequence<double>", (), "", 0.0, 100.0, open_minimum=True)
WORD = Parameter("word", "string", "hann", "", choices=("hann", "triang"), fallback="hann", spellings={"han": "hann"})
WORDS = Parameter("words", "sequence<string>", ("a",), "", choices=("a", "b"), least=1, most=4)


def test_a_client_that_fills_in_defaults_marks_those_of_the_sample_rate_by_nan() -> None:
    service = ROSAFE.service("GammatoneProc")
    request = SimpleNamespace(**{p.name: math.nan if p.follows_rate else p.default for p in service.parameters})
    free = {p.name for p in service.parameters if p.follows_rate}
    assert "fb_highFreqHz" in free
    assert service.from_ros(request, literal=True).keys() == {p.name for p in service.parameters} - free
    request.fb_highFreqHz = 5000.0
    assert service.from_ros(request, literal=True)["fb_highFreqHz"] == 5000.0


@pytest.mark.parametrize(
    ("parameter", "value", "expected"),
    [
        (BOOLEAN, 1, True),
        (BOOLEAN, 0.0, False),
        (BOOLEAN, np.True_, True),
        (BOOLEAN, np.int8(0), False),
        (UNSIGNED, 5.0, 5),
        (UNSIGNED, np.uint64(7), 7),
        (UNSIGNED, np.array(7), 7),
        (LARGE, 2**64 - 1, 2**64 - 1),  # not rounded through a float
        (SIGNED, -(2**31), -(2**31)),
        (NUMBER, 10, 10.0),
        (NUMBER, np.float32(0.5), 0.5),
        (NUMBER, 5e-324, 5e-324),
        (LIST, None, []),
        (LIST, [], []),
        (LIST, 0, []),
        (LIST, [0], []),
        (LIST, (0.0,), []),
        (LIST, np.zeros(1), []),
        (LIST, np.zeros(1, int), []),
        (LIST, np.array(0), []),
        (LIST, 5, [5.0]),
        (LIST, np.float64(5), [5.0]),
        (LIST, (3, 1.5), [3.0, 1.5]),
        (LIST, np.array([3, 1]), [3.0, 1.0]),
        (LIST, range(1, 4), [1.0, 2.0, 3.0]),
        (LIST, (x for x in (1, 2)), [1.0, 2.0]),
        (WORD, "triang", "triang"),
        (WORD, np.str_("hann"), "hann"),
        (WORD, "han", "hann"),
        (WORDS, "b", ["b"]),
        (WORDS, ("b", "a", "b"), ["b", "a", "b"]),
    ],
)
def test_values_from_python(parameter: Parameter, value: Any, expected: Any) -> None:
    got = parameter.check(value)
    assert got == expected
    python_types = {"boolean": bool, "double": float, "sequence<double>": list, "sequence<string>": list, "string": str}
    assert isinstance(got, python_types.get(parameter.idl, int))


@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        (BOOLEAN, math.nan),
        (BOOLEAN, np.array([True])),
        (UNSIGNED, 0.5),
        (UNSIGNED, -1),
        (UNSIGNED, 2**32),
        (UNSIGNED, True),
        (UNSIGNED, 10**400),
        (LARGE, float(2**64)),
        (LARGE, 0),
        (NUMBER, 0.0),
        (NUMBER, -0.0),
        (NUMBER, 1 + 0j),
        (NUMBER, np.array([1.0])),
        (LIST, [0, 0]),
        (LIST, [0.0, 5.0]),
        (LIST, np.ones((2, 2))),
        (LIST, itertools.repeat(1.0)),  # infinite
        (LIST, np.ones(MAX_SEQUENCE + 1)),
        (WORD, "x\0"),
        (WORD, "anything"),
        (WORD, ""),
        (WORDS, []),
        (WORDS, ["a", "c"]),
        (WORDS, ["a"] * 5),
    ],
)
def test_values_that_are_rejected(parameter: Parameter, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{parameter.name}: ") as raised:
        parameter.check(value)
    assert len(str(raised.value)) < 200


@given(st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.complex_numbers(), st.text(), st.binary()))
def test_a_checked_value_passes_again_or_the_error_names_the_parameter(value: Any) -> None:
    for parameter in (BOOLEAN, UNSIGNED, LARGE, SIGNED, NUMBER, LIST, WORD):
        for given_value in (value, [value], [value, 1.0]):
            try:
                checked = parameter.check(given_value)
            except ValueError as problem:
                assert str(problem).startswith(f"{parameter.name}: ")
            else:
                assert parameter.check(checked) == checked


@given(st.integers(-(2**70), 2**70))
def test_whole_numbers_are_exact_or_rejected(value: int) -> None:
    for parameter, low, high in ((UNSIGNED, 0, 2**32 - 1), (LARGE, 1, 2**64 - 1), (SIGNED, -(2**31), 2**31 - 1)):
        if low <= value <= high:
            assert parameter.check(value) == parameter.read(f" {value} ") == value
            continue
        with pytest.raises(ValueError, match=parameter.name):
            parameter.check(value)
        with pytest.raises(ValueError, match=parameter.name):
            parameter.read(f" {value} ")


@given(st.lists(st.floats(1e-300, 100.0), min_size=2, max_size=20), st.sampled_from([" ", ",", ", ", ";", "\n"]))
def test_lists_in_texts(values: list[float], between: str) -> None:
    text = between.join(map(repr, values))
    for shape in ("{}", "[{}]", "{{{}}}", "({})", " {} "):
        assert LIST.read(shape.format(text)) == values


@pytest.mark.parametrize(
    ("parameter", "texts"),
    [
        (BOOLEAN, {"0": False, "1": True, "true": True, "false": False, " true\n": True}),
        (UNSIGNED, {"5": 5, "+5": 5, "007": 7, " 12 ": 12, "-0": 0}),
        (NUMBER, {"5": 5.0, "5.": 5.0, ".5": 0.5, "20E-3": 0.02, "+1e1": 10.0, " 1 ": 1.0}),
        (LIST, {"": [], "{}": [], "0": [], "{0}": [], "5": [5.0], "1 2": [1.0, 2.0]}),
        (WORD, {"triang": "triang", " triang ": "triang", "han": "hann"}),
        (WORDS, {"a": ["a"], "{b, a}": ["b", "a"], "[a b]": ["a", "b"]}),
    ],
)
def test_texts(parameter: Parameter, texts: dict[str, Any]) -> None:
    for text, expected in texts.items():
        assert parameter.read(text) == expected


@pytest.mark.parametrize(
    ("parameter", "texts"),
    [
        (BOOLEAN, ["2", "10", "TRUE", "True", "1.0", "yes", "", "01", "-0"]),
        (UNSIGNED, ["5.0", "1e3", "", "-1", "4294967296", "0x5", "1_0", "5 5", "+-5", "9" * 10_000]),
        (NUMBER, ["", "inf", "nan", "-inf", "0x10", "1,5", "12abc", "1_0", "e", ".", "1e999", "infinity", "5 5"]),
        *((parameter, ["\N{ARABIC-INDIC DIGIT FIVE}"]) for parameter in (UNSIGNED, NUMBER)),
        (LIST, ["1 x", "nan", "1e999 1", "1 0", "0x1", "1 " * (MAX_SEQUENCE + 1)]),
        (WORD, ["Triang", "", "hann hann"]),
        (WORDS, ["", "c", "a c"]),
    ],
)
def test_texts_that_are_rejected(parameter: Parameter, texts: list[str]) -> None:
    for text in texts:
        with pytest.raises(ValueError, match=f"^{parameter.name}: ") as raised:
            parameter.read(text)
        assert len(str(raised.value)) < 200


@pytest.mark.parametrize(
    ("least", "given", "why"),
    [
        (1, [0], "taus: expected a number above 0, at most 9, got 0"),
        (1, 0, "taus: expected a number above 0, at most 9, got 0"),
        (1, [], "taus: expected at least 1 value, got none"),
        (2, [3], "taus: expected at least 2 values, got 1"),
    ],
)
def test_a_zero_stands_for_an_empty_list_only_if_the_list_may_be_empty(least: int, given: Any, why: str) -> None:
    taus = Parameter("taus", "sequence<double>", (1.0, 2.0), "", 0.0, 9.0, open_minimum=True, least=least)
    with pytest.raises(ValueError, match=f"^{why}$"):
        taus.check(given)
    assert dataclasses.replace(taus, least=0, default=()).check([0]) == []


def test_unknown_choices_become_the_fallback() -> None:
    assert [WORD.resolve_choice(word) for word in ("triang", "Hann", "", "hann ")] == ["triang", "hann", "hann", "hann"]
    assert WORDS.resolve_choice("x") == "x"  # it has no fallback
    for text in ("x" * 4097, "nul\0"):  # rejected by `check`
        assert WORD.resolve_choice(text) == text
    for kind, word in (("PreProc", "jespen"), ("GammatoneProc", "string"), ("IhcProc", "meddis")):
        enumerated = next(p for p in ROSAFE.service(kind).parameters if p.choices)
        assert enumerated.check(enumerated.resolve_choice(word)) == enumerated.default


@given(st.one_of(st.booleans(), st.integers(0, 2**32 - 1), st.floats(allow_nan=False, allow_infinity=False)))
def test_texts_read_back_as_the_value(value: Any) -> None:
    parameter = {bool: BOOLEAN, int: UNSIGNED, float: Parameter("any", "double", 1.0, "")}[type(value)]
    assert parameter.read(format_value(value)) == value
    numbers = Parameter("list", "sequence<double>", (), "")
    assert numbers.read(format_value([1.5, float(value)])) == [1.5, float(value)]


def requests() -> list[Any]:
    return [(c, s) for c in (ROSAFE, BASS) for s in c.services if s.parameters]


@pytest.mark.parametrize(("component", "service"), requests(), ids=lambda x: x.name)
def test_an_empty_ros_request_means_the_defaults(component: Any, service: Any) -> None:
    """Exceptions are booleans, parameters without a default, and parameters for which zero is a value."""
    empty = {"bool": False, "string": "", "float64[]": []}
    request = SimpleNamespace(**{p.name: empty.get(ros_type(p.idl), 0) for p in service.parameters})
    values = service.from_ros(request)
    assert list(values) == [p.name for p in service.parameters if not p.follows_rate]
    for parameter in map(service.parameter, values):
        value = values[parameter.name]
        if parameter.idl == "boolean":
            assert value is False
        elif parameter.default is REQUIRED or not parameter.zero_is_default:
            assert value == getattr(request, parameter.name)
        else:
            assert value == parameter.default
    if all(parameter.default is not REQUIRED for parameter in service.parameters):
        assert service.check(values) == service.check(service.check(values))


def test_explicit_values_of_a_ros_request_are_kept() -> None:
    service = ROSAFE.service("PreProc")
    request = SimpleNamespace(**{p.name: p.default for p in service.parameters})
    request.pp_bRemoveDC, request.pp_refSPLdB, request.pp_cutoffHzDC, request.name = True, -3.0, math.nan, "x"
    values = service.from_ros(request)
    assert (values["pp_bRemoveDC"], values["pp_refSPLdB"], values["name"]) == (True, -3.0, "x")
    with pytest.raises(ValueError, match=r"^pp_cutoffHzDC: expected a finite number, got nan"):
        service.check(values)
    list_service = ROSAFE.service("GammatoneProc")
    request = SimpleNamespace(**{p.name: p.default for p in list_service.parameters})
    for cf, expected in (((), []), ((0.0,), []), (np.array([]), []), (np.array([500.0, 100.0]), [500.0, 100.0])):
        request.fb_cfHz = cf
        assert list_service.check(list_service.from_ros(request))["fb_cfHz"] == expected


def test_names_and_their_aliases() -> None:
    assert ROSAFE.service("getSignal").name == "getSignals"
    assert ROSAFE.service("PreProc").parameter("pp_refSPLdBS").name == "pp_refSPLdB"
    assert ROSAFE.service("removeProcessor").parameter("nameProc").name == "name"
    assert ROSAFE.port("ratemapProcPort").name == "ratemapPort"
    for lookup in (ROSAFE.service, ROSAFE.port, ROSAFE.service("Stop").parameter):
        with pytest.raises(KeyError):
            lookup("none")


def test_the_range_text_of_a_choice_that_may_be_empty() -> None:
    (model,) = [p for p in STAGES["adaptation"].REPRESENTATION.parameters if p.name == "adpt_model"]
    assert model.range_text == "one of adt_dau, adt_puschel, adt_breebaart, adt_vandorpschuitman, or empty"
    assert model.check("") == ""
    with pytest.raises(ValueError, match=r"expected one of adt_dau, .*, or empty, got 'dau'"):
        model.check("dau")
