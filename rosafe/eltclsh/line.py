"""Lines that are edited in the terminal while Tcl serves its events."""

from __future__ import annotations

import contextlib
import ctypes
import os
import readline
import termios
from collections.abc import Callable, Iterator
from tkinter import TclError

from rosafe.eltclsh.interpreter import Interpreter

_Handler = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
_rl = ctypes.CDLL(readline.__file__)  # GNU readline itself is found through it
_rl.rl_callback_handler_install.argtypes = [ctypes.c_char_p, _Handler]
_rl.rl_callback_handler_install.restype = None
_libc = ctypes.CDLL(None)
_libc.free.argtypes = [ctypes.c_void_p]

DELIMITERS = ' \t\n"{}[]$;()'
_STDIN = 0


class LineCancelled(Exception):
    """The line that was being typed is not wanted any more (Ctrl-C)."""


class LineReader:
    """Reads lines with GNU readline; `complete(before, word)` gives what the word before the cursor can become."""

    def __init__(self, interpreter: Interpreter, complete: Callable[[str, str], list[str]]) -> None:
        self._interpreter = interpreter
        self._complete = complete
        self._matches: list[str] = []
        self._ended = self._abandoned = self._active = False
        self._line: str | None = None
        self._prompt = ""
        self._handler = _Handler(self._take)
        readline.set_completer(self._match)
        readline.set_completer_delims(DELIMITERS)
        readline.parse_and_bind("tab: complete")
        readline.parse_and_bind("set show-all-if-ambiguous on")
        interpreter.command("el::Readable", lambda: _rl.rl_callback_read_char() and "")

    def read(self, prompt: str) -> str | None:
        """The next line without its end, None at the end of the input. Raises Abandoned.

        A script that runs on an event may ask for a line while another one is being typed; that goes on afterwards.
        """
        outer = (self._prompt, readline.get_line_buffer()) if self._active else None
        if outer:
            self._remove()
            self._interpreter.say("")
        if "stdin" not in self._interpreter.elements("chan", "names"):  # a script has closed it
            return None
        self._ended = self._abandoned = False
        self._prompt = prompt
        try:
            self._install()
            while not (self._ended or self._abandoned):
                self._interpreter.tk.dooneevent(0)
            line, abandoned = self._line, self._abandoned
        finally:
            self._remove()
            if outer:
                self._ended = self._abandoned = False
                self._prompt = outer[0]
                self._install()
                readline.insert_text(outer[1])
                readline.redisplay()
        if abandoned:
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

    def _take(self, text: int | None) -> None:
        """Called by readline with what was typed, or with nothing at the end of the input."""
        self._line = None
        if text:
            self._line = ctypes.string_at(text).decode("utf-8", "replace")
            _libc.free(text)
        self._ended = True
        _rl.rl_callback_handler_remove()  # at once, or it shows the prompt for a next line

    def cancel_line(self) -> bool:
        """Give up the line that is being typed; False where there is none."""
        self._abandoned = self._active
        return self._active

    def redisplay(self) -> None:
        """Show the line again, on a line of its own, after something else was written."""
        if self._active:
            _rl.rl_on_new_line()
            _rl.rl_redisplay()

    def resized(self) -> None:
        """The terminal has another size."""
        _rl.rl_resize_terminal()

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._active:
            self._remove()

    def key(self, prompt: str = "", signals: bool = True) -> str:
        """One key, not shown; without `signals`, Ctrl-C is a key too. TclError at the end of the input."""
        tk = self._interpreter.tk
        before = tk.call("chan", "event", "stdin", "readable")
        with _single_keys(signals):
            tk.call("chan", "puts", "-nonewline", "stdout", prompt)  # now that it can be answered
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
    """Whether these bytes are a whole character, or can never become one."""
    if raw[0] < 0xC0:
        return True
    return len(raw) >= (2 if raw[0] < 0xE0 else 3 if raw[0] < 0xF0 else 4)
