"""The binary format for MATLAB and Octave, which decode it quickly: numbers as in memory, with one-byte tags.

docs/genomixd.md describes the format, `matlab/+genomix/+wire/decode.m` reads it. The reader needs no interface table,
because every value has a tag with its type.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from rosafe.declarations.idl import element
from rosafe.declarations.signals import LEVELS
from rosafe.interface import ComponentSpec

STRUCTURE, SEQUENCE, END = b"{", b"[", b"."
NUMBER, TEXT, NUMBERS, SIGNAL, ERROR = b"d", b"s", b"D", b"S", b"!"


def text(value: str) -> bytes:
    """Return a text: its length, and its characters as UTF-8."""
    # An unpaired surrogate has no UTF-8 and is escaped, as in exdetail.
    raw = value.encode("utf-8", "backslashreplace")
    return struct.pack("<I", len(raw)) + raw


def member(name: str) -> bytes:
    """Return the beginning of a structure's member; its value follows."""
    return TEXT + text(name)


def number(value: float | None) -> bytes:
    """Return a tagged number; None becomes NaN."""
    return NUMBER + struct.pack("<d", float("nan") if value is None else _float(value))


def _float(value: float) -> float:
    """Return a number as float; one that is too large, such as from a component's JSON, becomes infinite."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _numbers(values: Any) -> bytes:
    array = np.asarray(values)
    return b"".join((NUMBERS, struct.pack("<I", array.size), array.astype("<f8").tobytes()))


# --- values of IDL types ----------------------------------------------------------------------------------------


def pieces(component: ComponentSpec, idl: str, value: Any) -> Iterator[bytes]:
    """Yield the bytes of `value`, of IDL type `idl`, as in messages with arrays."""
    if idl in LEVELS:
        yield from _signal(LEVELS[idl], value)
    elif of := element(idl):
        if not of.startswith("::") and of != "string":
            yield _numbers(value)
            return
        yield SEQUENCE
        for item in value:
            yield from pieces(component, of, item)
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
    """Yield the bytes of a structure with the given (name, IDL type) members."""
    yield STRUCTURE
    for name, kind in members:
        yield member(name)
        yield from pieces(component, kind, value[name])
    yield END


def _signal(levels: tuple[str, ...], value: Any) -> Iterator[bytes]:
    """Yield a signal as one array, channel by channel; if its parts differ in length, as nested structures."""
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


# --- values without a type --------------------------------------------------------------------------------------


def plain(value: Any) -> bytes:
    """Return the bytes of a small value of dicts, lists, strings, numbers, booleans and None."""
    if isinstance(value, Mapping):
        return STRUCTURE + b"".join(member(str(name)) + plain(v) for name, v in value.items()) + END
    if isinstance(value, (list, tuple)):
        if value and all(isinstance(v, (int, float)) for v in value):
            return _numbers(np.array([_float(v) for v in value], "<f8"))
        return SEQUENCE + b"".join(map(plain, value)) + END
    return TEXT + text(value) if isinstance(value, str) else number(value)


def error(body: Mapping[str, Any]) -> bytes:
    """Return the bytes of an error's body."""
    return ERROR + plain(body)
