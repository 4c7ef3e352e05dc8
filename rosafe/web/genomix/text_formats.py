"""Values as text: every IDL type in JSON or Tcl syntax, in short pieces, so that large results can be streamed.

A number is written with the fewest digits that represent it exactly, and a boolean as 0 or 1. Infinities and NaN are
null, but NaN is NaN in Tcl. In JSON a sequence is an array, and a structure an object in the order of its declaration.
In Tcl both are dicts; the keys of a sequence are its indexes: ``{0 input 1 preProc}``.
"""

from __future__ import annotations

import functools
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from rosafe.declarations.idl import element
from rosafe.declarations.signals import LEVELS
from rosafe.interface import ComponentSpec

STEP = 1024  # numbers formatted at a time: about 0.3 ms, during which the GIL is held

_PLAIN_WORD = re.compile(r"[\w.:/+,=@%!?*|~^&<>()'-]+", re.ASCII)
_BRACEABLE = re.compile(r"[^{}\\\r\n]*")  # no line ends, because an event is one line
_TCL_ESCAPES = {
    **{ord(mark): "\\" + mark for mark in ' ;"$[]{}\\'},
    **{ord(mark): f"\\{name}" for mark, name in zip("\t\n\r\f\v", "tnrfv", strict=True)},
}


def tcl_word(text: str) -> str:
    """Return `text` as one element of a Tcl list, without any substitution."""
    if _PLAIN_WORD.fullmatch(text):
        return text
    if _BRACEABLE.fullmatch(text):
        return f"{{{text}}}"
    return text.translate(_TCL_ESCAPES)


class Syntax:
    """The syntax of scalars, sequences and structures in one output language; this class writes JSON."""

    name = "json"
    media_type = "application/json"

    def string(self, text: str) -> str:
        return json.dumps(text, ensure_ascii=False)

    def numbers(self, start: int, words: list[str]) -> str:
        return ("," if start else "") + ",".join(words)

    def open(self, kind: str) -> str:
        return "[" if kind == "sequence" else "{"

    def close(self, kind: str) -> str:
        return "]" if kind == "sequence" else "}"

    def key(self, index: int, name: str) -> str:
        return ("," if index else "") + json.dumps(name) + ":"

    def item(self, index: int) -> str:
        return "," if index else ""

    def not_finite(self, value: float) -> str:
        return "null"


class _TclSyntax(Syntax):
    """The syntax of Tcl dicts; every nested value is one braced word."""

    name = "tcl"
    media_type = "text/plain"

    def string(self, text: str) -> str:
        return tcl_word(text)

    def numbers(self, start: int, words: list[str]) -> str:
        pairs = [""] * (2 * len(words))
        pairs[0::2] = _indexes(start, len(words))
        pairs[1::2] = words
        return (" " if start else "") + " ".join(pairs)

    def open(self, kind: str) -> str:
        return "{"

    def close(self, kind: str) -> str:
        return "}"

    def key(self, index: int, name: str) -> str:
        return (" " if index else "") + tcl_word(name) + " "

    def item(self, index: int) -> str:
        return f"{' ' if index else ''}{index} "

    def not_finite(self, value: float) -> str:
        return "NaN" if math.isnan(value) else "null"


@functools.lru_cache(maxsize=256)
def _indexes(start: int, count: int) -> list[str]:
    return list(map(str, range(start, start + count)))


JSON = Syntax()
TCL = _TclSyntax()
SYNTAXES = {syntax.name: syntax for syntax in (JSON, TCL)}


# --- values of IDL types ----------------------------------------------------------------------------------------


def pieces(syntax: Syntax, component: ComponentSpec, idl: str, value: Any) -> Iterator[str]:
    """Yield the text of `value`, of IDL type `idl`, as in messages with arrays."""
    if idl in LEVELS:
        yield from _signal(syntax, LEVELS[idl], value)
    elif of := element(idl):
        yield syntax.open("sequence")
        yield from _elements(syntax, component, of, value)
        yield syntax.close("sequence")
    elif idl.startswith("::"):
        yield from structure(syntax, component, component.members(idl), value)
    else:
        yield _scalar(syntax, idl, value)


def structure(
    syntax: Syntax, component: ComponentSpec, members: Sequence[tuple[str, str]], value: Mapping[str, Any]
) -> Iterator[str]:
    """Yield the text of a structure with the given (name, IDL type) members."""
    yield syntax.open("struct")
    for index, (name, kind) in enumerate(members):
        yield syntax.key(index, name)
        yield from pieces(syntax, component, kind, value[name])
    yield syntax.close("struct")


def _elements(syntax: Syntax, component: ComponentSpec, idl: str, values: Any) -> Iterator[str]:
    if isinstance(values, np.ndarray):
        yield from _array(syntax, values)
        return
    for index, value in enumerate(values):
        yield syntax.item(index)
        yield from pieces(syntax, component, idl, value)


def _scalar(syntax: Syntax, idl: str, value: Any) -> str:
    if idl == "string":
        return syntax.string(value)
    if idl == "boolean":
        return "1" if value else "0"
    if idl in ("double", "float") and not math.isfinite(value):
        return syntax.not_finite(value)
    return f"{value:.9g}" if idl == "float" else repr(value)


def _signal(syntax: Syntax, levels: tuple[str, ...], value: Any) -> Iterator[str]:
    yield syntax.open("struct") + syntax.key(0, levels[0]) + syntax.open("sequence")
    if len(levels) == 1:
        yield from _array(syntax, np.asarray(value))
    else:
        for index, part in enumerate(value):
            yield syntax.item(index)
            yield from _signal(syntax, levels[1:], part)
    yield syntax.close("sequence") + syntax.close("struct")


def _array(syntax: Syntax, values: np.ndarray) -> Iterator[str]:
    for start in range(0, len(values), STEP):
        part = values[start : start + STEP]
        numbers = part.tolist()
        words = list(map(repr, numbers))
        if part.dtype.kind == "f":
            for k in np.flatnonzero(~np.isfinite(part)):
                words[k] = syntax.not_finite(numbers[k])
        yield syntax.numbers(start, words)


# --- values without a type --------------------------------------------------------------------------------------


def plain(syntax: Syntax, value: Any) -> str:
    """Return the text of a small value of dicts, lists, strings, numbers, booleans and None."""
    if isinstance(value, Mapping):
        members = (syntax.key(i, str(name)) + plain(syntax, v) for i, (name, v) in enumerate(value.items()))
        return syntax.open("struct") + "".join(members) + syntax.close("struct")
    if isinstance(value, (list, tuple)):
        items = (syntax.item(i) + plain(syntax, v) for i, v in enumerate(value))
        return syntax.open("sequence") + "".join(items) + syntax.close("sequence")
    if isinstance(value, str):
        return syntax.string(value)
    if value is None:
        return "null"
    return _scalar(syntax, {bool: "boolean", float: "double"}.get(type(value), ""), value)
