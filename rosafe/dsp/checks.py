"""Checks of parameter values: each returns the value as its Python type or raises ValueError naming the parameter."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

Check = Callable[[str, Any], Any]

MAX_SAMPLES = 2**31 - 1  # longest window, hop or lag: more cannot be meant, nor held in memory


def _refusal(name: str, value: Any, wanted: str) -> ValueError:
    shown = repr(value)
    return ValueError(f"{name}: {shown if len(shown) <= 80 else shown[:77] + '...'} is not {wanted}")


def number(name: str, value: Any) -> float:
    """A finite number."""
    try:
        result = math.nan if isinstance(value, (str, bytes)) else float(value)
    except (TypeError, ValueError, OverflowError):
        result = math.nan
    if not math.isfinite(result):
        raise _refusal(name, value, "a finite number")
    return result


def positive(name: str, value: Any) -> float:
    """A finite number above 0."""
    result = number(name, value)
    if result <= 0:
        raise _refusal(name, value, "more than 0")
    return result


def not_negative(name: str, value: Any) -> float:
    """A finite number from 0 up."""
    result = number(name, value)
    if result < 0:
        raise _refusal(name, value, "at least 0")
    return result


def within(low: float, high: float) -> Check:
    """A check for a number from `low` to `high`, both included."""

    def check(name: str, value: Any) -> float:
        result = number(name, value)
        if not low <= result <= high:
            raise _refusal(name, value, f"from {low:.12g} to {high:.12g}")
        return result

    return check


def whole(low: int, high: int) -> Check:
    """A check for a whole number from `low` to `high`, both included."""

    def check(name: str, value: Any) -> int:
        number(name, value)
        result = int(value)
        if result != value or not low <= result <= high:
            raise _refusal(name, value, f"a whole number from {low} to {high}")
        return result

    return check


def flag(name: str, value: Any) -> bool:
    """True, False, 0 or 1."""
    if number(name, value) not in (0, 1):
        raise _refusal(name, value, "a boolean")
    return bool(value)


def word(*choices: str, **aliases: str) -> Check:
    """A check for one of `choices`; `aliases` maps other spellings to them."""

    def check(name: str, value: Any) -> str:
        if isinstance(value, str):
            value = aliases.get(value, value)
            if value in choices:
                return value
        raise _refusal(name, value, "one of " + ", ".join(choices))

    return check


def round_half_away(value: float) -> int:
    """`value` >= 0 rounded as C's and MATLAB's ``round`` do: 220.5 is 221 (Python's ``round`` says 220)."""
    below = math.floor(value)
    return below + (value - below >= 0.5)


def sample_count(name: str, samples: float) -> int:
    """`samples` rounded half away from zero; ValueError naming `name` if that is below 1 or absurdly many."""
    if samples > MAX_SAMPLES:
        raise ValueError(f"{name}: too long, {samples:.6g} samples")
    count = round_half_away(samples)
    if count < 1:
        raise ValueError(f"{name}: too short for this sample rate")
    return count
