"""Words in messages: which names there are, and which one was perhaps meant."""

from __future__ import annotations

import difflib
from collections.abc import Collection

MANY_NAMES = 20  # in one line
LONG_NAME = 80  # characters of a name, in a line and for a comparison


def join_names(names: Collection[str]) -> str:
    """`names` for a message of one line, not too long: ``a, b, c``, or ``none``."""
    first = [name[:LONG_NAME] for name in list(names)[:MANY_NAMES]]
    more = len(names) - len(first)
    return (", ".join(first) or "none") + (f" and {more} more" if more else "")


def closest_matches(word: str, known: Collection[str]) -> str:
    """The one of the `known` words (at least one) that `word` resembles most, in whatever case."""
    by_lower = {one.lower(): one for one in reversed(list(known))}
    lower = word[:LONG_NAME].lower()
    return by_lower[difflib.get_close_matches(lower, by_lower, 1, 0.0)[0]]


def did_you_mean(word: str, known: Collection[str]) -> str:
    """A hint for the end of a message, ``; did you mean ...?``, where one of the `known` words resembles `word`."""
    lower = word[:LONG_NAME].lower()
    by_lower = {one.lower(): one for one in known}
    close = difflib.get_close_matches(lower, by_lower, 1, 0.75)
    return f"; did you mean {by_lower[close[0]]}?" if close else ""
