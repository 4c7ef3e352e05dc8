"""The lines that were typed: readline's list of them, their file in the original's format, and el::history."""

from __future__ import annotations

import os
import re
import readline
import tempfile
from pathlib import Path
from tkinter import TclError

_HEADER = "_HiStOrY_V2_"  # of libedit, which the original uses; everything but plain characters is \ooo there
_SUBCOMMANDS = ("add", "change", "event", "file", "save", "size", "clear")


def decode(text: str) -> list[str]:
    """The entries of a history file: libedit's, or one plain line for each."""
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
    """The text of a history file with these entries."""
    lines = ["".join(c if "!" <= c <= "~" and c != "\\" else _octal(c) for c in entry) for entry in entries]
    return "\n".join([_HEADER, *lines, ""])


def _octal(character: str) -> str:
    return "".join(f"\\{byte:03o}" for byte in character.encode("utf-8", "replace"))


class LineHistory:
    """What the arrow keys go through, and where it is kept."""

    def __init__(self, path: Path) -> None:
        self.path: Path | None = _absolute(str(path))
        self.size = 800
        self._load()

    def _load(self) -> None:
        if self.path is not None and self.path.is_file():
            self.replace(decode(self.path.read_text("utf-8", "replace")))

    @property
    def entries(self) -> list[str]:
        """All lines, the oldest first."""
        count = readline.get_current_history_length()
        return [str(readline.get_history_item(index)) for index in range(1, count + 1)]

    def replace(self, entries: list[str]) -> None:
        """Forget what is there and take these, or the newest of them."""
        readline.clear_history()
        for entry in entries[max(0, len(entries) - self.size) :]:
            readline.add_history(entry)

    def add(self, entry: str) -> None:
        """Append a line; the oldest one goes where there are too many."""
        readline.add_history(entry)
        while readline.get_current_history_length() > self.size:
            readline.remove_history_item(0)

    def save(self) -> None:
        """Write the file, as a whole or not at all. OSError where that cannot be."""
        if self.path is None:
            return
        name = ""
        try:
            handle, name = tempfile.mkstemp(prefix=f"{self.path.name}.", dir=self.path.parent)
            with os.fdopen(handle, "w", encoding="utf-8") as stream:
                stream.write(encode(self.entries))
            os.replace(name, self.path)
        except OSError as error:
            if name:
                os.unlink(name)
            raise OSError(error.errno, error.strerror, str(self.path)) from error

    def command(self, subcommand: str = "", *arguments: str) -> str:
        """el::history add|change|event|file|save|size|clear, as the original's manual describes it."""
        limits = {"add": (1, 1), "change": (1, 2), "event": (0, 1), "file": (0, 1), "size": (0, 1)}
        if subcommand not in _SUBCOMMANDS:
            raise TclError(f'bad subcommand "{subcommand}": must be {", ".join(_SUBCOMMANDS[:-1])}, or clear')
        least, most = limits.get(subcommand, (0, 0))
        if not least <= len(arguments) <= most:
            raise TclError(f"wrong # args: el::history {subcommand} takes {least} to {most} arguments")
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
        """Events count from 1; 0 is the current one, -1 the one before."""
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
