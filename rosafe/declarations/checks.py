"""Checks of declarations: types and names of the fields of Representation, Part, Parameter and Derived.

A check takes a value and returns the reason why it is invalid, or an empty string.
"""

from __future__ import annotations

import keyword
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from rosafe.declarations.idl import SCALARS, element
from rosafe.declarations.text import short_repr

MAX_NAME = 64  # characters
MAX_TEXT = 1000  # characters of a description
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
# Names of fields that the classes of ROS messages use themselves
_MESSAGE_MEMBERS = frozenset({"self", "serialize", "deserialize", "serialize_numpy", "deserialize_numpy"})

Check = Callable[[Any], str]


def bad_name(value: Any) -> str:
    """Check a name that is used in all interfaces."""
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        return f"expected a name (an ASCII letter, then letters, digits and _), got {short_repr(value)}"
    if len(value) > MAX_NAME:
        return f"expected a name of at most {MAX_NAME} characters, got {len(value)}"
    if keyword.iskeyword(value) or value in _MESSAGE_MEMBERS:
        return f"expected a name that is free, got {value!r}, which Python or ROS messages use"
    return ""


def bad_optional_name(value: Any) -> str:
    """Check a name that may be empty."""
    return "" if value == "" else bad_name(value)


def bad_text(value: Any) -> str:
    """Check one line of text."""
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        return f"expected one line of text, got {short_repr(value)}"
    return "" if len(value) <= MAX_TEXT else f"expected at most {MAX_TEXT} characters, got {len(value)}"


def bad_optional_text(value: Any) -> str:
    """Check one line of text that may be empty."""
    return "" if isinstance(value, str) and not value else bad_text(value)


def bad_string(value: Any) -> str:
    """Check for a string."""
    return "" if isinstance(value, str) else f"expected a string, got {short_repr(value)}"


def bad_flag(value: Any) -> str:
    """Check for a boolean."""
    return "" if isinstance(value, bool) else f"expected True or False, got {short_repr(value)}"


def bad_count(value: Any) -> str:
    """Check for a whole number that is not negative."""
    return "" if type(value) is int and value >= 0 else f"expected a count, got {short_repr(value)}"


def bad_type(value: Any) -> str:
    """Check the IDL type of a parameter."""
    if isinstance(value, str) and (element(value) or value) in SCALARS:
        return ""
    return f"expected one of {', '.join(SCALARS)} or sequence<one of them>, got {short_repr(value)}"


def each(check: Check) -> Check:
    """Return a check of all elements of a tuple."""
    return lambda values: next(filter(None, map(check, values)), "")


def field_problems(owner: Any, checks: Mapping[str, Check]) -> Iterator[str]:
    """Yield a line for each field of `owner` that its check finds invalid."""
    for field, check in checks.items():
        if problem := check(getattr(owner, field)):
            yield f"{field}: {problem}"


def is_number(value: Any) -> bool:
    """Return whether `value` is a finite number, and not a boolean."""
    try:
        return not isinstance(value, (bool, str, bytes)) and math.isfinite(value)
    except (TypeError, ValueError, OverflowError):
        return False


def tuple_problems(owner: Any, fields: Iterable[str], of: type, elements: str) -> Iterator[str]:
    """Convert `fields` of the frozen `owner` from lists to tuples; yield a line for each that is neither."""
    for field in fields:
        values = getattr(owner, field)
        if isinstance(values, (tuple, list)) and all(isinstance(value, of) for value in values):
            object.__setattr__(owner, field, tuple(values))
        else:
            yield f"{field}: expected a tuple of {elements}, got {short_repr(values)}"


def duplicate(names: Iterable[str]) -> str:
    """Return the first of `names` that occurs more than once; empty if all are different."""
    return next((name for name, count in Counter(names).items() if count > 1), "")
