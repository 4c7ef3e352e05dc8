"""The history of input lines: the list of readline, the file in the format of the original, and el::history."""

from __future__ import annotations

import errno
import os
import re
import readline
from pathlib import Path
from tkinter import TclError

from rosafe.system.input import read_regular
from rosafe.system.output import OutputError, write_whole

_HEADER = "_HiStOrY_V2_"  # of libedit, which the original uses; characters except graphic ASCII are written as \ooo
_MAX_BYTES = 2**22
_SUBCOMMANDS = ("add", "change", "event", "file", "save", "size", "clear")


def decode(text: str) -> list[str]:
    """Return the entries of a history file in the format of libedit, or with one plain line per entry."""
    lines = text.splitlines()
    if lines[:1] != [_HEADER]:
        return lines
    return [
        re.sub(rb"\\([0-7]{3})", lambda m: bytes([int(m[1], 8) & 0xFF]), line.encode())
        .decode("utf-8", "replace")
        .rstrip("\n")
        for line in lines[1:]
    ]


def encode(entries: list[str]) -> str:
    """Return the text of a history file with these entries."""
    lines = ["".join(c if "!" <= c <= "~" and c != "\\" else _octal(c) for c in entry) for entry in entries]
    return "\n".join([_HEADER, *lines, ""])


def _octal(character: str) -> str:
    return "".join(f"\\{byte:03o}" for byte in character.encode("utf-8", "replace"))


class LineHistory:
    """The lines that the arrow keys recall, and their file."""

    def __init__(self, path: Path) -> None:
        self.path: Path | None = _absolute(str(path))
        self.size = 800
        self._load()

    def _load(self) -> None:
        if self.path is not None and self.path.is_file():
            self.replace(decode(read_regular(self.path, _MAX_BYTES).decode("utf-8", "replace")))

    @property
    def entries(self) -> list[str]:
        """All lines, oldest first."""
        count = readline.get_current_history_length()
        return [str(readline.get_history_item(index)) for index in range(1, count + 1)]

    def replace(self, entries: list[str]) -> None:
        """Replace all entries by these, or by the newest of them if there are too many."""
        readline.clear_history()
        for entry in entries[max(0, len(entries) - self.size) :]:
            readline.add_history(entry)

    def add(self, entry: str) -> None:
        """Append a line, and remove the oldest one if there are too many."""
        readline.add_history(entry)
        while readline.get_current_history_length() > self.size:
            readline.remove_history_item(0)

    def save(self) -> None:
        """Write the complete file, readable by its owner only, or raise OSError and keep the old one."""
        if self.path is None:
            return
        try:
            write_whole(self.path, encode(self.entries).encode(), 0o600)
        except OutputError as error:
            # Without an error of the system (EIO), or if another process is writing the file, the text has the reason.
            reason = str(error) if error.errno in (errno.EIO, errno.EAGAIN) else os.strerror(error.errno)
            raise OSError(error.errno, reason, str(self.path)) from error

    def command(self, subcommand: str = "", *arguments: str) -> str:
        """Implement el::history add|change|event|file|save|size|clear as described in the manual of the original."""
        limits = {"add": (1, 1), "change": (1, 2), "event": (0, 1), "file": (0, 1), "size": (0, 1)}
        if subcommand not in _SUBCOMMANDS:
            raise TclError(f'bad subcommand "{subcommand}": must be {", ".join(_SUBCOMMANDS[:-1])}, or clear')
        minimum, maximum = limits.get(subcommand, (0, 0))
        if not minimum <= len(arguments) <= maximum:
            raise TclError(f"wrong # args: el::history {subcommand} takes {minimum} to {maximum} arguments")
        match subcommand:
            case "add":
                self.add(arguments[0])
            case "change":
                readline.replace_history_item(self._index(arguments[1] if arguments[1:] else "0"), arguments[0])
            case "event":
                return self.entries[self._index(arguments[0] if arguments else "-1")]
            case "file" if not arguments:
                return "" if self.path is None else str(self.path)
            case "file":
                self.path = _absolute(arguments[0]) if arguments[0] else None
                self._load()
            case "save":
                self.save()
            case "size" if arguments:
                self.size = max(0, _integer(arguments[0]))
                self.replace(self.entries)
            case "size":
                return str(self.size)
            case "clear":
                readline.clear_history()
        return ""

    def _index(self, event: str) -> int:
        """Return the index of an event: events count from 1, 0 is the current one, -1 the previous one."""
        number, count = _integer(event), readline.get_current_history_length()
        index = number - 1 if number > 0 else count - 1 + number
        if not 0 <= index < count:
            raise TclError(f'no event "{event}" in the history')
        return index


def _absolute(path: str) -> Path:
    return Path(os.path.abspath(os.path.expanduser(path)))


def _integer(text: str) -> int:
    if not re.fullmatch(r"\s*[-+]?\d{1,9}\s*", text):
        raise TclError(f'expected integer but got "{text}"')
    return int(text)
