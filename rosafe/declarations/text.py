"""Texts in messages: values and lists of names of limited length, and suggestions for misspelt names."""

from __future__ import annotations

import difflib
from collections.abc import Collection
from typing import Any

MANY_NAMES = 20  # in one line
LONG_NAME = 80  # characters of a name, in a line and for a comparison


def short_repr(value: Any) -> str:
    """Return `value` for a message of one line. It never raises, even if the `repr` of `value` does."""
    try:
        text = repr(value)
    except Exception:
        text = f"an object of type {type(value).__name__}"
    text = " ".join(text.split())
    return text if len(text) <= 80 else text[:77] + "..."


def join_names(names: Collection[str]) -> str:
    """Return `names` for a message of one line and of limited length: ``a, b, c``, or ``none``."""
    first = [name[:LONG_NAME] for name in list(names)[:MANY_NAMES]]
    more = len(names) - len(first)
    return (", ".join(first) or "none") + (f" and {more} more" if more else "")


def closest_match(word: str, known: Collection[str], cutoff: float = 0.0) -> str:
    """Return the `known` word most similar to `word`, in any case; empty if all similarities are below `cutoff`."""
    by_lower = {one.lower(): one for one in reversed(list(known))}
    close = difflib.get_close_matches(word[:LONG_NAME].lower(), by_lower, 1, cutoff)
    return by_lower[close[0]] if close else ""


def did_you_mean(word: str, known: Collection[str]) -> str:
    """Return a hint for the end of a message, ``; did you mean ...?``; empty if no `known` word is similar."""
    close = closest_match(word, known, 0.75)
    return f"; did you mean {close}?" if close else ""


def bytes_text(count: float) -> str:
    """Return a size as ``12 bytes`` or ``3.4 MB``."""
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count:.0f} bytes"
