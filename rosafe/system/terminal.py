"""Escape text for terminals: file names and texts from the network may contain escape sequences."""

from __future__ import annotations


def printable(text: object, keep: str = "") -> str:
    r"""Return `text` as one line that has no effect on a terminal except to be shown.

    Characters that are not printable are escaped as in Python (``\x1b``, ``\n``, ``\u202e``), except those in `keep`.
    Bytes of a file name that are not UTF-8 are escaped too (``\xff``).
    """
    line = str(text)
    if line.isprintable():
        return line
    return "".join(c if c.isprintable() or c in keep else _escaped(c) for c in line)


def _escaped(character: str) -> str:
    if "\udc80" <= character <= "\udcff":  # a byte that could not be decoded
        return f"\\x{ord(character) - 0xDC00:02x}"
    return repr(character)[1:-1]
