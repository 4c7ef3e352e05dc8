"""Values as bytes that MATLAB and Octave unpack quickly: numbers as they are in memory, under one-byte tags.

docs/genomixd.md describes the form, `matlab/+genomix/+wire/decode.m` reads it. The reader needs no interface table:
everything says what it is.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from rosafe.declarations.signals import LEVELS
from rosafe.interface import ComponentSpec

STRUCTURE, SEQUENCE, END = b"{", b"[", b"."
NUMBER, TEXT, NUMBERS, SIGNAL, ERROR = b"d", b"s", b"D", b"S", b"!"


def text(value: str) -> bytes:
    """Length and UTF-8."""
    # Half a surrogate pair has no UTF-8; it is told as an escape, as in exdetail.
    raw = value.encode("utf-8", "backslashreplace")
    return struct.pack("<I", len(raw)) + raw


def member(name: str) -> bytes:
    """What begins a member of a structure; its value follows."""
    return TEXT + text(name)


def number(value: float | None) -> bytes:
    """A tagged number; what is not there is NaN."""
    return NUMBER + struct.pack("<d", float("nan") if value is None else _float(value))


def _float(value: float) -> float:
    """A number that a component wrote as text may be larger than any float."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _numbers(values: Any) -> bytes:
    array = np.asarray(values)
    return b"".join((NUMBERS, struct.pack("<I", array.size), array.astype("<f8").tobytes()))


# --- values of IDL types ----------------------------------------------------------------------------------------


def pieces(component: ComponentSpec, idl: str, value: Any) -> Iterator[bytes]:
    """The bytes of `value`, as `rosafe.component.serialization.decode` gives it, of IDL type `idl`."""
    if idl in LEVELS:
        yield from _signal(LEVELS[idl], value)
    elif idl.startswith("sequence<"):
        element = idl[len("sequence<") : -1]
        if not element.startswith("::") and element != "string":
            yield _numbers(value)
            return
        yield SEQUENCE
        for item in value:
            yield from pieces(component, element, item)
        yield END
    elif idl.startswith("::"):
        yield from structure(component, component.members(idl), value)
    elif idl == "string":
        yield TEXT + text(value)
    else:
        yield number(value)


def structure(
    component: ComponentSpec, members: Sequence[tuple[str, str]], value: Mapping[str, Any]
) -> Iterator[bytes]:
    """The bytes of a structure with the given (name, IDL type) members."""
    yield STRUCTURE
    for name, kind in members:
        yield member(name)
        yield from pieces(component, kind, value[name])
    yield END


def _signal(levels: tuple[str, ...], value: Any) -> Iterator[bytes]:
    """A signal in one block, the samples of a channel together; level by level where its parts differ in length."""
    shape = _shape(value, len(levels))
    if shape is None:
        yield STRUCTURE + member(levels[0]) + SEQUENCE
        for part in value:
            yield from _signal(levels[1:], part)
        yield END + END
        return
    yield SIGNAL + struct.pack("<I", len(levels))
    for level, size in zip(levels, shape, strict=True):
        yield text(level) + struct.pack("<I", size)
    for row in _rows(value, len(levels)):
        yield np.asarray(row).astype("<f8").tobytes()


def _shape(value: Any, levels: int) -> tuple[int, ...] | None:
    """How many parts each level has; None where they are not alike."""
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


# --- values without a type --------------------------------------------------------------------------------------


def plain(value: Any) -> bytes:
    """The bytes of a small value made of dicts, lists, strings, numbers, booleans and None."""
    if isinstance(value, Mapping):
        return STRUCTURE + b"".join(member(str(name)) + plain(v) for name, v in value.items()) + END
    if isinstance(value, (list, tuple)):
        if value and all(isinstance(v, (int, float)) for v in value):
            return _numbers(np.array([_float(v) for v in value], "<f8"))
        return SEQUENCE + b"".join(map(plain, value)) + END
    return TEXT + text(value) if isinstance(value, str) else number(value)


def error(body: Mapping[str, Any]) -> bytes:
    """The bytes of an error's body."""
    return ERROR + plain(body)
