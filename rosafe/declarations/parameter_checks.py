"""Checks of the declaration of a parameter: its names, type, limits and choices."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rosafe.declarations.checks import (
    bad_count,
    bad_flag,
    bad_name,
    bad_optional_text,
    bad_type,
    duplicate,
    each,
    field_problems,
    is_number,
    tuple_problems,
)
from rosafe.declarations.idl import element
from rosafe.declarations.text import short_repr


def _bad_spellings(value: Any) -> str:
    if isinstance(value, Mapping) and all(isinstance(word, str) for pair in value.items() for word in pair):
        return ""
    return f"expected a mapping of strings to strings, got {short_repr(value)}"


_FIELDS = {
    "name": bad_name,
    **dict.fromkeys(("doc", "fallback", "unit"), bad_optional_text),
    **dict.fromkeys(("open_minimum", "zero_is_default", "follows_rate", "ascending"), bad_flag),
    **dict.fromkeys(("least", "most", "longest"), bad_count),
    "spellings": _bad_spellings,
}


def declaration_problems(parameter: Any) -> Iterator[str]:
    """Yield the reasons why `parameter` is invalid, except for its default. Lists in it become tuples."""
    yield from field_problems(parameter, _FIELDS)
    if not hasattr(parameter, "members") and (problem := bad_type(parameter.idl)):
        yield f"type: {problem}"
    scalar = element(parameter.idl) or parameter.idl
    yield from _limit_problems(parameter, numeric=scalar not in ("string", "boolean"))
    yield from tuple_problems(parameter, ("choices", "aliases", "former"), str, "strings")
    yield from field_problems(parameter, {"choices": each(bad_optional_text), "aliases": each(bad_name)})
    choices, fallback = parameter.choices, parameter.fallback
    if choices and scalar != "string":
        yield f"choices: expected none for the type {parameter.idl}; only strings can have choices"
    if word := duplicate(choices):
        yield f"choices: {short_repr(word)} occurs twice"
    if choices and fallback and fallback not in choices:
        yield f"fallback: expected one of the choices, got {short_repr(fallback)}"


def _limit_problems(parameter: Any, numeric: bool) -> Iterator[str]:
    low, high = parameter.minimum, parameter.maximum
    for name, limit in (("minimum", low), ("maximum", high)):
        if limit is not None and not (numeric and is_number(limit)):
            yield f"{name}: expected {'a finite number or ' if numeric else ''}None, got {short_repr(limit)}"
    if low is not None and high is not None and low > high:
        yield f"minimum: {low} is above the maximum, {high}"
    if parameter.least > parameter.most:
        yield f"least: {parameter.least} is above most, {parameter.most}"
