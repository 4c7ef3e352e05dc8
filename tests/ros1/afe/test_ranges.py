"""All values of all requests in the interface table are rejected outside their range, by each interface."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import pytest

from rosafe.interface import CORE_REPRESENTATIONS, KINDS, ROSAFE, Parameter, Representation, Service
from tests.ros1.afe.session import Session, error_of
from tests.ros1.afe.test_requests import NAMES, snapshot

PARENTS = ("PreProc", "GammatoneProc", "IhcProc")
NUMBERS = ("double", "unsigned long", "unsigned long long")


def parents(kind: Representation) -> Iterator[Representation]:
    """Return the ancestors of `kind`, the input first."""
    if kind.parent:
        yield from parents(KINDS[kind.parent])
        yield KINDS[kind.parent]


def element(parameter: Parameter) -> str:
    """Return the IDL type of a parameter, or of the elements of a list."""
    return parameter.idl.removeprefix("sequence<").removesuffix(">")


def numeric(parameters: tuple[Parameter, ...]) -> Iterator[Parameter]:
    return (p for p in parameters if element(p) in NUMBERS)


def outside(parameter: Parameter) -> list[float]:
    """Return values of the parameter's type outside its range, with 0 if that is not allowed."""
    low, high = parameter.minimum, parameter.maximum
    assert low is not None, f"{parameter.name} has no range"
    if element(parameter) == "double":
        below = low if parameter.open_minimum else math.nextafter(low, -math.inf)
        above = [1e300, math.nextafter(high, math.inf)] if high is not None else []
        return [math.nan, math.inf, -math.inf, -1e300, below, *above]
    assert high is not None, f"{parameter.name} has no range"
    bits = 32 if element(parameter) == "unsigned long" else 64
    return [value for value in (low - 1, high + 1, 2**bits - 1) if 0 <= value < 2**bits and not low <= value <= high]


def in_request(parameter: Parameter) -> Iterator[Any]:
    """Return the values of `outside` for a request, in which zero is the default."""
    for value in outside(parameter):
        if value != 0:
            yield value if parameter.idl == element(parameter) else [100.0, value]


def some(values: Sequence[Any], number: int) -> Sequence[Any]:
    """Return a third of the values, which ones depends on `number`; tests/interface tries all of them."""
    return values[number % 3 :: 3] or values


def refused(response: Any, parameter: Parameter, value: Any) -> None:
    ex, detail = error_of(response)
    assert ex == "::rosAFE::e_badNewValue", (parameter.name, value)
    assert parameter.name in detail["what"], (parameter.name, value, detail)


@pytest.mark.parametrize("service", ROSAFE.activities, ids=lambda service: service.name)
def test_values_outside_are_rejected_by_service_and_action(afe: Session, service: Service) -> None:
    served = [kind for kind in KINDS.values() if kind.request == service.name]
    above = [kind for one in served for kind in parents(one)]
    afe.build(*(kind.request for kind in above if kind.parent), fb_nChannels=2)
    before = snapshot(afe)
    fresh = {"name": "fresh"}
    given: tuple[Parameter, Any] | None = None
    for number, parameter in enumerate(numeric(service.parameters)):
        for value in some(list(in_request(parameter)), number):
            refused(afe.call(service.name, **fresh, **{parameter.name: value}), parameter, value)
            given = parameter, value
    if given is not None:
        parameter, value = given
        goal = afe.goal(service.name, **fresh, **{parameter.name: value})
        refused(goal.result(), parameter, value)
    assert given or not list(numeric(service.parameters))
    assert snapshot(afe) == before


@pytest.mark.parametrize("kind", CORE_REPRESENTATIONS)
def test_values_outside_are_rejected_by_modify_parameter(afe: Session, kind: str) -> None:
    """In modifyParameter, zero is not the default."""
    afe.build(*(k.request for k in CORE_REPRESENTATIONS.values() if k.parent), fb_nChannels=2)
    before = snapshot(afe)
    for number, parameter in enumerate(numeric(CORE_REPRESENTATIONS[kind].parameters)):
        for value in some(outside(parameter), number):
            if value == 0 and parameter.idl != element(parameter):
                continue  # a list of one zero is the default
            response = afe.call(
                "modifyParameter", nameProc=NAMES[kind][0], nameParam=parameter.name, newValue=repr(value)
            )
            refused(response, parameter, value)
    assert snapshot(afe) == before


@pytest.mark.parametrize("kind", [kind for kind in CORE_REPRESENTATIONS if CORE_REPRESENTATIONS[kind].parent])
def test_unknown_choices_become_the_default(afe: Session, kind: str) -> None:
    afe.build(*PARENTS, fb_nChannels=2)
    numbers = itertools.count(1)
    for parameter in CORE_REPRESENTATIONS[kind].parameters:
        if not parameter.choices:
            continue
        for word, meant in [
            *((choice, choice) for choice in parameter.choices),
            *(
                (word, parameter.fallback)
                for word in some(("jespen", parameter.choices[0].upper(), "0", "ä b"), len(kind))
            ),
        ]:
            name = f"word{next(numbers)}"
            afe.ok(CORE_REPRESENTATIONS[kind].request, name=name, **{parameter.name: word})
            (given,) = [p for p in getattr(afe.ok("getParameters").parameters, kind) if p.name == name]
            assert getattr(given, parameter.name) == meant
            afe.ok("modifyParameter", nameProc=name, nameParam=parameter.name, newValue=parameter.choices[-1])
            afe.ok("modifyParameter", nameProc=name, nameParam=parameter.name, newValue=f" {word} ")
            (given,) = [p for p in getattr(afe.ok("getParameters").parameters, kind) if p.name == name]
            assert getattr(given, parameter.name) == meant
            afe.ok("removeProcessor", name=name)


def test_too_long_or_invalid_texts(afe: Session) -> None:
    afe.build("PreProc")
    before = snapshot(afe)
    for text in ("x" * 4097, "nul\0"):
        refused(afe.call("GammatoneProc", fb_type=text), ROSAFE.service("GammatoneProc").parameter("fb_type"), text)
    assert snapshot(afe) == before


def test_too_long_lists(afe: Session) -> None:
    afe.build("PreProc")
    for length in (1025, 100_000):
        ex, detail = afe.refused("GammatoneProc", fb_cfHz=[100.0] * length)
        assert ex == "::rosAFE::e_badNewValue" and "fb_cfHz" in detail["what"]
    assert afe.processors() == {"input": ["input"], "preProc": ["preProc"]}
