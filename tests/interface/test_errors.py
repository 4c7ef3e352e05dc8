"""The JSON text of exceptions on the wire, and the values that parameters reject."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosafe.interface import BASS, KINDS, MAX_SEQUENCE, MAX_STRING, ROSAFE, ComponentError, Parameter

OUT_OF_RANGE = r"expected a number (above|at least|at most|from|in the range of)"


def test_exdetail_without_members() -> None:
    assert ROSAFE.error("e_noData", "no audio has arrived").exdetail == (
        '{"ex":"::rosAFE::e_noData","what":"no audio has arrived"}'
    )
    assert BASS.error("e_hwparams").exdetail == '{"ex":"::bass::e_hwparams"}'


def test_exdetail_with_members() -> None:
    assert (
        ComponentError("::genom::interrupted", by="Stop").exdetail
        == '{"ex":"::genom::interrupted","detail":{"by":"Stop"}}'
    )
    assert ComponentError("::genom::syserr", code=17).exdetail == '{"ex":"::genom::syserr","detail":{"code":17}}'
    assert ComponentError("::genom::syserr", "it is busy", code=16).exdetail == (
        '{"ex":"::genom::syserr","detail":{"code":16},"what":"it is busy"}'
    )


def test_the_reason_occurs_once_and_has_a_limited_length() -> None:
    assert ROSAFE.error("e_badNewValue", "elsewhere", what="here").body == {
        "ex": "::rosAFE::e_badNewValue",
        "detail": {"what": "here"},
    }
    assert len(ROSAFE.error("e_noData", "x" * 10**6).exdetail) < 5000


@given(st.text())
def test_exdetail_is_valid_json_for_any_text(what: str) -> None:
    assert json.loads(ROSAFE.error("e_badNewValue", what=what).exdetail) == {
        "ex": "::rosAFE::e_badNewValue",
        "detail": {"what": what},
    }


def test_an_undeclared_exception_raises_key_error() -> None:
    with pytest.raises(KeyError):
        BASS.error("e_noData")


def parameters() -> list[Parameter]:
    return [p for kind in KINDS.values() for p in kind.parameters] + [
        p for component in (ROSAFE, BASS) for service in component.services for p in service.parameters
    ]


@pytest.mark.parametrize("parameter", parameters(), ids=lambda p: p.name)
def test_values_of_wrong_types_are_rejected(parameter: Parameter) -> None:
    wrong: list[Any] = [None, object(), {"a": 1}]
    if parameter.idl == "string":
        wrong += [1, b"bytes", "nul\0", "x" * (MAX_STRING + 1)]
    elif parameter.idl == "boolean":
        wrong += ["true", 2, -1, math.nan, "", 0.5]
    elif parameter.idl.startswith("sequence"):
        wrong = [object(), {"a": 1}, "1 2", [math.nan], [math.inf], ["x"], [1.0] * (MAX_SEQUENCE + 1), [[1.0]]]
    else:
        wrong += [math.nan, math.inf, -math.inf, "1", "", [1], 1e400]
    for value in wrong:
        with pytest.raises(ValueError, match=f"^{parameter.name}: "):
            parameter.check(value)


@pytest.mark.parametrize(
    "parameter", [p for p in parameters() if p.minimum is not None or p.maximum is not None], ids=lambda p: p.name
)
def test_values_out_of_range_are_rejected(parameter: Parameter) -> None:
    element = (lambda v: [v, v]) if parameter.idl.startswith("sequence") else (lambda v: v)
    whole = "long" in parameter.idl or "short" in parameter.idl
    low, high = parameter.minimum, parameter.maximum
    if high is not None:
        maximum = element(int(high) if whole else high)
        assert parameter.check(maximum) == maximum
        with pytest.raises(ValueError, match=OUT_OF_RANGE):
            parameter.check(element(int(high) + 1 if whole else math.nextafter(high, math.inf)))
    if low is not None:
        below = int(low) - 1 if whole else math.nextafter(low, -math.inf)
        with pytest.raises(ValueError, match=OUT_OF_RANGE):
            parameter.check(element(below))
        if parameter.open_minimum:
            with pytest.raises(ValueError, match=OUT_OF_RANGE):
                parameter.check(element(low))


@given(st.text(max_size=40))
def test_parse_only_raises_value_error_with_the_name(text: str) -> None:
    for kind in KINDS.values():
        for parameter in kind.parameters:
            try:
                parameter.parse(text)
            except ValueError as problem:
                assert str(problem).startswith(f"{parameter.name}: ")


def test_an_unpaired_surrogate_crosses_the_wire() -> None:
    text = ROSAFE.error("e_badNewValue", what="\udc80 ü").exdetail
    assert json.loads(text.encode().decode())["detail"]["what"] == "\udc80 ü"
