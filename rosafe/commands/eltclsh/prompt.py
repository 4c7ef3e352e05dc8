"""The prompt of eltclsh: reads and runs commands, with line editing on a terminal."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from tkinter import TclError
from typing import TYPE_CHECKING

from rosafe.commands.eltclsh.interpreter import Interpreter
from rosafe.commands.eltclsh.signals import Signals
from rosafe.system.version import VERSION

if TYPE_CHECKING:  # scripts do not need readline
    from rosafe.commands.eltclsh.line import LineHistory, LineReader


class Prompt:
    """The prompt of the shell `name`, and the commands that read from the user."""

    def __init__(self, name: str, tcl: Interpreter, signals: Signals) -> None:
        self._name, self._tcl, self._signals = name, tcl, signals
        self._reader: LineReader | None = None
        self._history: LineHistory | None = None
        self._pending = ""  # the first lines of an incomplete command
        tcl.create_command("interactive", self.run)
        tcl.create_command("el::gets", self.read_line)
        tcl.create_command("el::getc", self.read_key)
        tcl.create_command("el::history", lambda *arguments: self._editing()[1].command(*arguments))
        tcl.create_command("el::Key", lambda prompt: self._editing()[0].key(prompt, signals=False))
        tcl.create_command("el::Redisplay", self._redisplay)
        tcl.create_command("el::Cancel", self._cancel)

    def close(self) -> None:
        """Restore the terminal and save the history."""
        if self._reader is not None:
            self._reader.close()
        if self._history is not None:
            try:
                self._history.save()
            except OSError as error:
                self._tcl.print_line(f"{self._name}: the history is not saved: {error}", "stderr")

    def run(self) -> str:
        """Read and run commands until the end of the input; without a terminal, there is no line editing."""
        if not os.isatty(0):
            self._run_stdin()
            return ""
        self._editing()
        tk = self._tcl.tk
        tk.eval("set ::tcl_interactive 1")
        if self._signals.command("INT") == "-default":
            self._signals.command("INT", "::el::interrupted")
        self._tcl.print_line(f"{self._name} {VERSION}, Tcl {tk.eval('info patchlevel')}")
        while (line := self._next_line()) is not None:
            for part in line.split("\n"):  # pasted text is received as one line
                self._pending += part + "\n"
                if tk.getboolean(tk.call("info", "complete", self._pending)):
                    command, self._pending = self._pending, ""
                    self._run_typed(command)
        self._tcl.print_line("")
        return ""

    def _next_line(self) -> str | None:
        from rosafe.commands.eltclsh.line import LineCancelled

        reader, _ = self._editing()
        while True:
            with contextlib.suppress(TclError):  # a script has closed the channels
                self._tcl.tk.eval("chan flush stdout; chan flush stderr")
            try:
                return reader.read(self._prompt())
            except LineCancelled:
                self._pending = ""

    def _prompt(self) -> str:
        """Return the prompt: a text, or the result of a script, in el::prompt1 (el::prompt2 in incomplete commands)."""
        name, default = ("el::prompt2", ": ") if self._pending else ("el::prompt1", f"{self._name} > ")
        tk = self._tcl.tk
        script = self._tcl.variable(name)
        if script is None and self._tcl.elements("info", "commands", f"::{name}"):
            script = name
        if script is None:
            return default
        first = self._tcl.split(script)[:1]
        if not first or (len(self._tcl.elements("info", "commands", first[0])) != 1 and "[" not in script):
            return script
        try:
            return str(tk.call("uplevel", "#0", script))
        except TclError as error:
            self._tcl.print_line(f"{error}", "stderr")
            return default

    def _run_typed(self, command: str) -> None:
        if command.strip():
            self._editing()[1].add(command.rstrip("\n"))
        tk = self._tcl.tk
        tk.eval("set ::el::typed 1")
        try:
            self._evaluate(command, echo=True)
        finally:
            tk.eval("set ::el::typed 0")

    def _run_stdin(self) -> None:
        """Run commands as tclsh does with a file or pipe: `gets stdin` in a command reads from the same stream."""
        tk = self._tcl.tk
        command = ""
        with contextlib.suppress(TclError):  # a script has closed stdin
            while tk.eval("chan gets stdin ::el::input") != "-1":
                command += tk.eval("set ::el::input") + "\n"
                if tk.getboolean(tk.call("info", "complete", command)):
                    complete, command = command, ""
                    self._evaluate(complete, echo=False)

    def _evaluate(self, command: str, echo: bool) -> None:
        tk = self._tcl.tk
        self._tcl.elements("::history", "add", command)  # for `!!` and the command `history`
        try:
            result = tk.eval(command) if tk.eval("info level") == "0" else tk.call("uplevel", "#0", command)
        except TclError as error:
            self._tcl.print_line(str(error), "stderr")
        else:
            if echo and result:
                self._tcl.print_line(result)

    # --- commands ---

    def read_line(self, prompt: str) -> str:
        """Implement el::gets: read a line with editing; raise TclError at the end of the input or after Ctrl-C."""
        if not os.isatty(0):
            self._tcl.tk.call("chan", "puts", "-nonewline", "stdout", prompt)
            if self._tcl.tk.eval("chan flush stdout; chan gets stdin ::el::input") == "-1":
                raise TclError("no input")
            return str(self._tcl.tk.eval("set ::el::input"))
        from rosafe.commands.eltclsh.line import LineCancelled

        reader, history = self._editing()
        entries = history.entries
        try:
            line = reader.read(prompt)
        except LineCancelled:
            raise TclError("interrupted") from None
        finally:
            history.replace(entries)
        if line is None:
            self._tcl.print_line("")
            raise TclError("no input")
        return line

    def read_key(self) -> str:
        """Implement el::getc: read a key, or a character of the input; raise TclError at its end."""
        if os.isatty(0):
            return self._editing()[0].key()
        character = self._tcl.tk.eval("chan read stdin 1")
        if not character:
            raise TclError("no input")
        return str(character)

    def _redisplay(self) -> str:
        if self._reader is not None:
            self._reader.redisplay()
        return ""

    def _cancel(self) -> str:
        """Cancel the line that is being typed, or the running command."""
        if self._reader is None or not self._reader.cancel_line():
            self._signals.cancel()
        return ""

    def _editing(self) -> tuple[LineReader, LineHistory]:
        """Return reader and history; readline is loaded by the first call."""
        if self._reader is None or self._history is None:
            from rosafe.commands.eltclsh.complete import Completer
            from rosafe.commands.eltclsh.line import LineHistory, LineReader

            completer = Completer(self._tcl)
            self._reader = LineReader(self._tcl, lambda before, word: completer.complete(self._pending + before, word))
            self._history = LineHistory(Path("~/.eltclhistory"))
            self._tcl.create_command("el::Resized", self._reader.resized)
            self._signals.command("WINCH", "::el::Resized")
        return self._reader, self._history
