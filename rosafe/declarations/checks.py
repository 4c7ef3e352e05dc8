"""Checks of declarations: types and names of the fields of Representation, Part, Parameter and Derived."""

from __future__ import annotations

import keyword
import math
import re
from collections.abc import Iterable
from typing import Any

MAX_NAME = 64  # characters
MAX_TEXT = 1000  # characters of a description
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
# Names of fields that the classes of ROS messages use themselves
_OF_MESSAGES = frozenset({"self", "serialize", "deserialize", "serialize_numpy", "deserialize_numpy"})


def short(value: Any) -> str:
    """`value` for a message of one line; never raises, whatever its repr does."""
    try:
        text = repr(value)
    except Exception:
        text = f"an object of type {type(value).__name__}"
    text = " ".join(text.split())
    return text if len(text) <= 80 else text[:77] + "..."


def bad_name(value: Any) -> str:
    """Why `value` cannot be a name in all interfaces; empty if it can."""
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        return f"expected a name (an ASCII letter, then letters, digits and _), got {short(value)}"
    if len(value) > MAX_NAME:
        return f"expected a name of at most {MAX_NAME} characters, got {len(value)}"
    if keyword.iskeyword(value) or value in _OF_MESSAGES:
        return f"expected a name that is free, got {value!r}, which Python or ROS messages use"
    return ""


def bad_text(value: Any, empty: bool = False) -> str:
    """Why `value` is not one line of text; empty if it is. `empty`: it may be empty."""
    if not isinstance(value, str) or not (value.strip() or (empty and not value)) or not value.isprintable():
        return f"expected one line of text, got {short(value)}"
    return "" if len(value) <= MAX_TEXT else f"expected at most {MAX_TEXT} characters, got {len(value)}"


def is_number(value: Any) -> bool:
    """Whether `value` is a finite number, and not a boolean."""
    try:
        return not isinstance(value, (bool, str, bytes)) and math.isfinite(value)
    except (TypeError, ValueError, OverflowError):
        return False


def as_tuple(owner: Any, field: str, of: type, what: str) -> str:
    """Make a tuple of the list or tuple `field` of the frozen `owner`; why that is not possible, or empty."""
    values = getattr(owner, field)
    if not isinstance(values, (tuple, list)) or not all(isinstance(value, of) for value in values):
        return f"{field}: expected a tuple of {what}, got {short(values)}"
    object.__setattr__(owner, field, tuple(values))
    return ""


def twice(names: Iterable[str]) -> str:
    """The first of `names` that occurs a second time; empty if all are different."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            return name
        seen.add(name)
    return ""
