"""The formats of answers: every IDL type as JSON, Tcl or `packed`, in short pieces, so that results can be streamed.

In JSON and Tcl a number is written with the fewest digits that represent it exactly, and a boolean as 0 or 1.
Infinities and NaN are null, but NaN is NaN in Tcl. In JSON a sequence is an array, and a structure an object in the
order of its declaration. In Tcl both are dicts; the keys of a sequence are its indexes: ``{0 input 1 preProc}``.

`packed` is binary, for MATLAB and Octave, which decode it quickly: numbers as in memory, with one-byte tags.
docs/genomixd.md describes it, `matlab/+genomix/+wire/decode.m` reads it. The reader needs no interface table, because
every value has a tag with its type.
"""

from __future__ import annotations

import functools
import json
import math
import re
import struct
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
STRUCTURE, SEQUENCE, END = b"{", b"[", b"."  # tags of `packed`
NUMBER, TEXT, NUMBERS, SIGNAL, ERROR = b"d", b"s", b"D", b"S", b"!"


def utf8(text: str) -> bytes:
    """Encode a text. An unpaired surrogate, which a node may send, has no UTF-8 and is escaped, as in exdetail."""
    return text.encode("utf-8", "backslashreplace")


class Syntax:
    """The syntax of values in one format; this class writes JSON. Its pieces are texts, those of `packed` are bytes."""

    name = "json"
    content_type = "application/json; charset=utf-8"
    null: Any = "null"

    def document(self, pieces: Iterator[Any]) -> Iterator[bytes]:
        """Yield a complete document with one value."""
        return map(utf8, pieces)

    def error(self, body: Mapping[str, Any]) -> bytes:
        """Return the document of an error."""
        return self.plain_document(body)

    def plain_document(self, value: Any) -> bytes:
        """Return the document of a small value without a type."""
        return b"".join(self.document(iter((self.plain(value),))))

    # --- parts ---

    def join(self, pieces: Iterator[Any]) -> Any:
        return "".join(pieces)

    def string(self, text: str) -> Any:
        return json.dumps(text, ensure_ascii=False)

    def words(self, start: int, words: list[str]) -> str:
        return ("," if start else "") + ",".join(words)

    def open(self, kind: str) -> Any:
        return "[" if kind == "sequence" else "{"

    def close(self, kind: str) -> Any:
        return "]" if kind == "sequence" else "}"

    def key(self, index: int, name: str) -> Any:
        return ("," if index else "") + json.dumps(name) + ":"

    def item(self, index: int) -> Any:
        return "," if index else ""

    def not_finite(self, value: float) -> str:
        return "null"

    # --- values of IDL types, as in messages with arrays ---

    def pieces(self, component: ComponentSpec, idl: str, value: Any) -> Iterator[Any]:
        """Yield the pieces of `value`, of IDL type `idl`."""
        if idl in LEVELS:
            yield from self.signal(LEVELS[idl], value)
        elif of := element(idl):
            if of.startswith("::") or of == "string":
                yield self.open("sequence")
                for index, item in enumerate(value):
                    yield self.item(index)
                    yield from self.pieces(component, of, item)
                yield self.close("sequence")
            else:
                yield from self.numbers(of, value)
        elif idl.startswith("::"):
            yield from self.structure(component, component.members(idl), value)
        else:
            yield self.scalar(idl, value)

    def structure(
        self, component: ComponentSpec, members: Sequence[tuple[str, str]], value: Mapping[str, Any]
    ) -> Iterator[Any]:
        """Yield the pieces of a structure with the given (name, IDL type) members."""
        yield self.open("struct")
        for index, (name, kind) in enumerate(members):
            yield self.key(index, name)
            yield from self.pieces(component, kind, value[name])
        yield self.close("struct")

    def scalar(self, idl: str, value: Any) -> Any:
        if idl == "string":
            return self.string(value)
        if idl == "boolean":
            return "1" if value else "0"
        if idl in ("double", "float") and not math.isfinite(value):
            return self.not_finite(value)
        return f"{value:.9g}" if idl == "float" else repr(value)

    def numbers(self, idl: str, values: Any) -> Iterator[Any]:
        """Yield a sequence of numbers or booleans."""
        yield self.open("sequence")
        if isinstance(values, np.ndarray):
            yield from self._array(values)
        else:
            yield from (self.item(index) + self.scalar(idl, value) for index, value in enumerate(values))
        yield self.close("sequence")

    def signal(self, levels: tuple[str, ...], value: Any) -> Iterator[Any]:
        yield self.open("struct") + self.key(0, levels[0]) + self.open("sequence")
        if len(levels) == 1:
            yield from self._array(np.asarray(value))
        else:
            for index, part in enumerate(value):
                yield self.item(index)
                yield from self.signal(levels[1:], part)
        yield self.close("sequence") + self.close("struct")

    def _array(self, values: np.ndarray) -> Iterator[Any]:
        for start in range(0, len(values), STEP):
            part = values[start : start + STEP]
            numbers = part.tolist()
            words = list(map(repr, numbers))
            if part.dtype.kind == "f":
                for k in np.flatnonzero(~np.isfinite(part)):
                    words[k] = self.not_finite(numbers[k])
            yield self.words(start, words)

    # --- values without a type ---

    def plain(self, value: Any) -> Any:
        """Return a small value of dicts, lists, strings, numbers, booleans and None."""
        if isinstance(value, Mapping):
            members = (self.key(i, str(name)) + self.plain(v) for i, (name, v) in enumerate(value.items()))
            return self.open("struct") + self.join(members) + self.close("struct")
        if isinstance(value, (list, tuple)):
            return self.plain_sequence(value)
        if isinstance(value, str):
            return self.string(value)
        if value is None:
            return self.null
        return self.scalar({bool: "boolean", float: "double"}.get(type(value), ""), value)

    def plain_sequence(self, values: Sequence[Any]) -> Any:
        items = (self.item(i) + self.plain(v) for i, v in enumerate(values))
        return self.open("sequence") + self.join(items) + self.close("sequence")


# --- Tcl --------------------------------------------------------------------------------------------------------


def tcl_word(text: str) -> str:
    """Return `text` as one element of a Tcl list, without any substitution."""
    if _PLAIN_WORD.fullmatch(text):
        return text
    if _BRACEABLE.fullmatch(text):
        return f"{{{text}}}"
    return text.translate(_TCL_ESCAPES)


class _TclSyntax(Syntax):
    """The syntax of Tcl dicts; every nested value is one braced word."""

    name = "tcl"
    content_type = "text/plain; charset=utf-8"

    def document(self, pieces: Iterator[Any]) -> Iterator[bytes]:
        """Yield it without the outermost braces, which would make it a list of one element."""
        previous = next(pieces)[1:]
        for piece in pieces:
            yield utf8(previous)
            previous = piece
        yield utf8(previous[:-1])

    def string(self, text: str) -> str:
        return tcl_word(text)

    def words(self, start: int, words: list[str]) -> str:
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


# --- packed -----------------------------------------------------------------------------------------------------


def packed_text(text: str) -> bytes:
    """Return a text: its length, and its characters as UTF-8."""
    raw = utf8(text)
    return struct.pack("<I", len(raw)) + raw


class _PackedSyntax(Syntax):
    """The syntax of `packed`."""

    name = "packed"
    content_type = "application/octet-stream"
    null = NUMBER + struct.pack("<d", math.nan)

    def document(self, pieces: Iterator[Any]) -> Iterator[bytes]:
        return pieces

    def error(self, body: Mapping[str, Any]) -> bytes:
        return ERROR + self.plain_document(body)

    def join(self, pieces: Iterator[Any]) -> bytes:
        return b"".join(pieces)

    def string(self, text: str) -> bytes:
        return TEXT + packed_text(text)

    def open(self, kind: str) -> bytes:
        return SEQUENCE if kind == "sequence" else STRUCTURE

    def close(self, kind: str) -> bytes:
        return END

    def key(self, index: int, name: str) -> bytes:
        return self.string(name)

    def item(self, index: int) -> bytes:
        return b""

    def scalar(self, idl: str, value: Any) -> bytes:
        return self.string(value) if idl == "string" else NUMBER + struct.pack("<d", _float(value))

    def numbers(self, idl: str, values: Any) -> Iterator[bytes]:
        array = np.asarray(values)
        yield b"".join((NUMBERS, struct.pack("<I", array.size), array.astype("<f8").tobytes()))

    def signal(self, levels: tuple[str, ...], value: Any) -> Iterator[bytes]:
        """Yield a signal as one array, channel by channel; if its parts differ in length, as nested structures."""
        shape = _shape(value, len(levels))
        if shape is None:
            yield from super().signal(levels, value)
            return
        yield SIGNAL + struct.pack("<I", len(levels))
        for level, size in zip(levels, shape, strict=True):
            yield packed_text(level) + struct.pack("<I", size)
        for row in _rows(value, len(levels)):
            yield np.asarray(row).astype("<f8").tobytes()

    def plain_sequence(self, values: Sequence[Any]) -> bytes:
        if values and all(isinstance(v, (int, float)) for v in values):
            return self.join(self.numbers("double", [_float(v) for v in values]))
        return bytes(super().plain_sequence(values))


def _float(value: float) -> float:
    """Return a number as float; one that is too large, such as from a component's JSON, becomes infinite."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _shape(value: Any, levels: int) -> tuple[int, ...] | None:
    """Return the number of parts at each level; None if they differ in length."""
    if levels == 1:
        return (len(value),)
    shapes = {_shape(part, levels - 1) for part in value}
    if len(shapes) > 1 or None in shapes:
        return None
    inner = shapes.pop() if shapes else None
    return (len(value), *(inner or (0,) * (levels - 1)))


def _rows(value: Any, levels: int) -> Iterator[Any]:
    if levels == 1:
        yield value
        return
    for part in value:
        yield from _rows(part, levels - 1)


JSON, TCL, PACKED = Syntax(), _TclSyntax(), _PackedSyntax()
SYNTAXES: dict[str, Syntax] = {syntax.name: syntax for syntax in (JSON, TCL, PACKED)}
