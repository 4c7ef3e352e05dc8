"""Decoder of the packed format, in which genomixd sends large values (docs/genomixd.md, "Packed answers").

Numbers are as in JSON: whole numbers are int. Signals are lists of float, and NaN and infinities keep their values.
"""

from __future__ import annotations

import struct
import sys
from array import array
from typing import Any

from genomix.event import GenoMError, error_of


def decode(data: bytes) -> Any:
    """Return the value of an answer. Raises the GenoMError that it contains, or ``::genom::mwerr``."""
    try:
        reader = _Reader(data)
        failed = data[:1] == b"!"
        reader.at += failed
        value = reader.value()
    except (struct.error, IndexError, KeyError, UnicodeDecodeError, ValueError):
        raise GenoMError("::genom::mwerr", what="the answer of genomixd is damaged") from None
    if failed:
        raise error_of(value)
    return value


class _Reader:
    """Reads values in their order."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def value(self) -> Any:
        tag = self.data[self.at : self.at + 1]
        self.at += 1
        if tag == b"d":
            return _whole(self._floats(1))[0]
        if tag == b"s":
            return self._text()
        if tag == b"D":
            return _whole(self._floats(self._count()))
        if tag == b"[":
            return self._sequence()
        if tag == b"{":
            return self._structure()
        if tag == b"S":
            levels = [(self._text(), self._count()) for _ in range(self._count())]
            return self._signal(levels)
        raise KeyError(tag)

    def _count(self) -> int:
        (count,) = struct.unpack_from("<I", self.data, self.at)
        self.at += 4
        return int(count)

    def _bytes(self, size: int) -> bytes:
        start, self.at = self.at, self.at + size
        if self.at > len(self.data):
            raise IndexError(size)
        return self.data[start : self.at]

    def _text(self) -> str:
        return self._bytes(self._count()).decode()

    def _floats(self, count: int) -> list[float]:
        numbers = array("d", self._bytes(8 * count))
        if sys.byteorder == "big":
            numbers.byteswap()
        return numbers.tolist()

    def _sequence(self) -> list[Any]:
        values = []
        while self.data[self.at] != ord("."):
            values.append(self.value())
        self.at += 1
        return values

    def _structure(self) -> dict[str, Any]:
        members = {}
        while self.data[self.at] != ord("."):
            name = self.value()
            members[name] = self.value()
        self.at += 1
        return members

    def _signal(self, levels: list[tuple[str, int]]) -> dict[str, Any]:
        (name, count), inner = levels[0], levels[1:]
        if not inner:
            return {name: self._floats(count)}
        return {name: [self._signal(inner) for _ in range(count)]}


def _whole(numbers: list[float]) -> list[Any]:
    """Return int instead of float if all numbers are whole."""
    return list(map(int, numbers)) if all(map(float.is_integer, numbers)) else list(numbers)
