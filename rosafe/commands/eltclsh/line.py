"""Line editing in the terminal while Tcl processes its events, and the history of the lines."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import re
import readline
import termios
from collections.abc import Callable, Iterator
from pathlib import Path
from tkinter import TclError

from rosafe.commands.eltclsh.interpreter import Interpreter
from rosafe.system.input import read_regular
from rosafe.system.output import OutputError, write_whole

_Handler = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
_rl = ctypes.CDLL(readline.__file__)  # also finds the symbols of GNU readline
_rl.rl_callback_handler_install.argtypes = [ctypes.c_char_p, _Handler]
_rl.rl_callback_handler_install.restype = None
_libc = ctypes.CDLL(None)
_libc.free.argtypes = [ctypes.c_void_p]

DELIMITERS = ' \t\n"{}[]$;()'
_STDIN = 0
_HEADER = "_HiStOrY_V2_"  # of libedit, which the original uses; characters except graphic ASCII are written as \ooo
_MAX_BYTES = 2**22
_SUBCOMMANDS = ("add", "change", "event", "file", "save", "size", "clear")


class LineCancelled(Exception):
    """The input line was cancelled (Ctrl-C)."""


class LineReader:
    """Reads lines with GNU readline; `complete(before, word)` returns the completions of the word before the cursor."""

    def __init__(self, interpreter: Interpreter, complete: Callable[[str, str], list[str]]) -> None:
        self._interpreter = interpreter
        self._complete = complete
        self._matches: list[str] = []
        self._ended = self._cancelled = self._active = False
        self._line: str | None = None
        self._prompt = ""
        self._handler = _Handler(self._receive)
        readline.set_completer(self._match)
        readline.set_completer_delims(DELIMITERS)
        readline.parse_and_bind("tab: complete")
        readline.parse_and_bind("set show-all-if-ambiguous on")
        interpreter.create_command("el::Readable", lambda: _rl.rl_callback_read_char() and "")

    def read(self, prompt: str) -> str | None:
        """Return the next line without its end, or None at the end of the input. Raise LineCancelled after Ctrl-C.

        An event script may read a line while another one is being typed; the outer line is continued afterwards.
        """
        outer = (self._prompt, readline.get_line_buffer()) if self._active else None
        if outer:
            self._remove()
            self._interpreter.print_line("")
        if "stdin" not in self._interpreter.elements("chan", "names"):  # a script has closed it
            return None
        self._ended = self._cancelled = False
        self._prompt = prompt
        try:
            self._install()
            while not (self._ended or self._cancelled):
                self._interpreter.tk.dooneevent(0)
            line, cancelled = self._line, self._cancelled
        finally:
            self._remove()
            if outer:
                self._ended = self._cancelled = False
                self._prompt = outer[0]
                self._install()
                readline.insert_text(outer[1])
                readline.redisplay()
        if cancelled:
            raise LineCancelled
        return line

    def _install(self) -> None:
        self._active = True
        _rl.rl_callback_handler_install(self._prompt.encode("utf-8", "replace"), self._handler)
        self._before = self._interpreter.tk.call("chan", "event", "stdin", "readable")
        self._interpreter.tk.call("chan", "event", "stdin", "readable", "::el::Readable")

    def _remove(self) -> None:
        self._active = False
        _rl.rl_callback_handler_remove()
        with contextlib.suppress(TclError):  # a script has closed stdin
            self._interpreter.tk.call("chan", "event", "stdin", "readable", self._before)

    def _receive(self, text: int | None) -> None:
        """Receive a line from readline, or None at the end of the input."""
        self._line = None
        if text:
            self._line = ctypes.string_at(text).decode("utf-8", "replace")
            _libc.free(text)
        self._ended = True
        _rl.rl_callback_handler_remove()  # immediately, otherwise readline shows another prompt

    def cancel_line(self) -> bool:
        """Cancel the line that is being typed; return False if there is none."""
        self._cancelled = self._active
        return self._active

    def redisplay(self) -> None:
        """Show the line again, in a new line, after other output."""
        if self._active:
            _rl.rl_on_new_line()
            _rl.rl_redisplay()

    def resized(self) -> None:
        """Adapt to a new size of the terminal."""
        _rl.rl_resize_terminal()

    def close(self) -> None:
        """Restore the terminal."""
        if self._active:
            self._remove()

    def key(self, prompt: str = "", signals: bool = True) -> str:
        """Read one key without echo; without `signals`, Ctrl-C is a key too. Raise TclError at the end of the input."""
        tk = self._interpreter.tk
        before = tk.call("chan", "event", "stdin", "readable")
        with _single_keys(signals):
            tk.call("chan", "puts", "-nonewline", "stdout", prompt)  # printed when input is read
            tk.eval("chan flush stdout; set ::el::key 0; chan event stdin readable {set ::el::key 1}")
            try:
                while tk.eval("set ::el::key") == "0":
                    tk.dooneevent(0)
                pressed = os.read(_STDIN, 1)
                while pressed and not _is_character(pressed):
                    pressed += os.read(_STDIN, 1)
            finally:
                tk.call("chan", "event", "stdin", "readable", before)
        if not pressed:
            raise TclError("no input")
        return pressed.decode("utf-8", "replace")

    def _match(self, word: str, index: int) -> str | None:
        if index == 0:
            for name, setting in (("el::queryItems", "query-items"), ("el::maxCols", "display-width")):
                value = self._interpreter.variable(name)
                if value is not None and value.isdigit():
                    readline.parse_and_bind(f"set completion-{setting} {value}")
            self._matches = self._complete(readline.get_line_buffer()[: readline.get_begidx()], word)
        return self._matches[index] if index < len(self._matches) else None


@contextlib.contextmanager
def _single_keys(signals: bool) -> Iterator[None]:
    before = termios.tcgetattr(_STDIN)
    mode = termios.tcgetattr(_STDIN)
    mode[3] &= ~(termios.ICANON | termios.ECHO | (0 if signals else termios.ISIG))
    mode[6][termios.VMIN], mode[6][termios.VTIME] = 1, 0
    termios.tcsetattr(_STDIN, termios.TCSADRAIN, mode)
    try:
        yield
    finally:
        termios.tcsetattr(_STDIN, termios.TCSADRAIN, before)


def _is_character(raw: bytes) -> bool:
    """Return whether these bytes are a complete UTF-8 character, or cannot become one."""
    if raw[0] < 0xC0:
        return True
    return len(raw) >= (2 if raw[0] < 0xE0 else 3 if raw[0] < 0xF0 else 4)


# --- the history: the list of readline, the file in the format of the original, and el::history -----------------------


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
