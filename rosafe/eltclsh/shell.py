"""The programs eltclsh and elwish: a script or the prompt, with the same command line as tclsh."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from tkinter import TclError
from typing import TYPE_CHECKING, Any, NoReturn

from rosafe.eltclsh.interpreter import LIBRARY, PACKAGES, Interpreter
from rosafe.eltclsh.library import tcl as library
from rosafe.eltclsh.signals import Signals
from rosafe.eltclsh.words import parse
from rosafe.version import VERSION

if TYPE_CHECKING:  # readline is for terminals: scripts do without
    from rosafe.eltclsh.history import LineHistory
    from rosafe.eltclsh.line import LineReader

COMPATIBLE_VERSION = "1.20"  # of the original, for `package require eltclsh`
USAGE = """usage: {name} [-package NAME]... [SCRIPT [ARGUMENT]...]

A Tcl shell with line editing{tk}. Runs SCRIPT as tclsh does, or reads commands. {packages}
At the prompt: TAB completes, the arrow keys go through what was typed before (~/.eltclhistory), Ctrl-D ends.
~/.{name}rc is run first.
example: {name} -package genomix script.tcl
"""


def main(tk: bool = False) -> NoReturn:
    """Run eltclsh, or with `tk` elwish, on the arguments of this process."""
    name = "elwish" if tk else "eltclsh"
    if sys.argv[1:] in (["-h"], ["--help"]):
        told = USAGE.format(name=name, tk=" and Tk" if tk else "", packages="`package require genomix` works at once.")
        print(told, end="")
        sys.exit(0)
    if sys.argv[1:] == ["--version"]:
        print(f"{name} {VERSION}")
        sys.exit(0)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # as tclsh; Python's would wait for Tcl to return
    Shell(name).run(tk)


class Shell:
    """One interpreter with the commands of eltclsh, and the loop at its prompt."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.tcl = Interpreter()
        self.signals = Signals(self.tcl)
        self._reader: LineReader | None = None
        self._history: LineHistory | None = None
        self._pending = ""
        commands: dict[str, Callable[..., Any]] = {
            "el::Exit": self.exit,
            "el::gets": self.gets,
            "el::getc": self.getc,
            "el::Key": lambda prompt: self._editing()[0].key(prompt, signals=False),
            "el::Redisplay": self._redisplay,
            "el::Abandon": self._abandon,
            "el::history": lambda *arguments: self._editing()[1].command(*arguments),
            "el::parse": parse,
            "signal": self.signals.command,
            "interactive": self.interactive,
        }
        for command, function in commands.items():
            self.tcl.command(command, function)

    # --- the life of the process ---

    def run(self, tk: bool) -> NoReturn:
        """Do what the command line says, and exit through the command `exit`, which a script may have replaced."""
        script, encoding = self._set_arguments()
        code = 0
        try:
            self._initialise()
            if tk:
                self.tcl.tk.loadtk()
                self.tcl.tk.eval("wm withdraw .")
        except TclError as error:
            self.tcl.say(f"{self.name}: {error}", "stderr")
            self.exit("1")
        self._run_rc_file()
        if script is None:
            self.interactive()
        else:
            try:
                if encoding is None:
                    self.tcl.tk.evalfile(script)
                else:
                    self.tcl.tk.call("source", "-encoding", encoding, script)
            except TclError as error:
                self._print_error_info(error)
                code = 1
        with contextlib.suppress(TclError):  # whatever a script's own `exit` does, this is the end
            self.tcl.tk.call("exit", str(code))
        self.exit(str(code))

    def _set_arguments(self) -> tuple[str | None, str | None]:
        """Set argv, argc, argv0 and tcl_interactive; the script to run and its encoding."""
        arguments, packages, encoding, script = sys.argv[1:], [], None, None
        while arguments[:1] == ["-package"] and len(arguments) > 1:
            packages += arguments[:2]
            arguments = arguments[2:]
        if arguments[:1] == ["-encoding"] and len(arguments) > 2 and not arguments[2].startswith("-"):
            encoding, arguments = arguments[1], arguments[2:]
        if arguments and not arguments[0].startswith("-"):
            script, *arguments = arguments
        arguments = packages + arguments
        tk = self.tcl.tk
        tk.call("set", "argv0", script or sys.argv[0])
        tk.call("set", "argv", tuple(arguments))
        tk.call("set", "argc", str(len(arguments)))
        tk.call("set", "tcl_interactive", str(int(script is None and os.isatty(0))))
        return script, encoding

    def _initialise(self) -> None:
        """Packages and procedures: ours, those of ELTCLLIBPATH, and those that -package asks for."""
        tk = self.tcl.tk
        library_dir = os.environ.get("ELTCL_LIBRARY", str(LIBRARY))
        tk.call("set", "eltcl_library", library_dir)
        tk.call("set", "eltcl_pkgPath", tuple(PACKAGES))
        tk.call("lappend", "auto_path", *PACKAGES, library_dir)
        try:
            tk.call("lappend", "auto_path", *tk.splitlist(os.environ.get("ELTCLLIBPATH", "")))
        except TclError as error:
            self.tcl.say(f"{self.name}: ELTCLLIBPATH: {error}", "stderr")
        tk.call("set", "tcl_rcFileName", f"~/.{self.name}rc")
        tk.call("package", "provide", "eltclsh", COMPATIBLE_VERSION)
        tk.call("source", "-encoding", "utf-8", str(LIBRARY / "el.tcl"))
        arguments = list(tk.splitlist(tk.eval("set argv")))
        while "-package" in arguments[:-1]:
            at = arguments.index("-package")
            name = arguments[at + 1]
            del arguments[at : at + 2]
            try:
                tk.call("package", "require", name)
            except TclError as error:
                self.tcl.say(f"{error}\ncannot load {name}", "stderr")
        tk.call("set", "argv", tuple(arguments))
        tk.call("set", "argc", str(len(arguments)))

    def _run_rc_file(self) -> None:
        path = os.path.expanduser(f"~/.{self.name}rc")
        if not os.path.isfile(path):
            return
        try:
            self.tcl.tk.evalfile(path)
        except TclError as error:
            self._print_error_info(error)

    def _print_error_info(self, error: TclError) -> None:
        """errorInfo, unless it is that of another error: a file that cannot be read has none."""
        info = self.tcl.variable("errorInfo") or ""
        self.tcl.say(info if info.startswith(str(error)) else str(error), "stderr")

    def exit(self, code: str) -> NoReturn:
        """End the process as Tcl does: open files are flushed. The history is kept."""
        if self._reader is not None:
            self._reader.close()
        if self._history is not None:
            try:
                self._history.save()
            except OSError as error:
                self.tcl.say(f"{self.name}: the history is not saved: {error}", "stderr")
        library.Tcl_Exit(int(code))
        raise SystemExit(int(code))

    # --- the prompt ---

    def interactive(self) -> str:
        """Read and run commands until the end of the input: from a terminal with editing, else line by line."""
        if not os.isatty(0):
            self._run_stdin()
            return ""
        self._editing()
        tk = self.tcl.tk
        tk.eval("set ::tcl_interactive 1")
        if self.signals.command("INT") == "-default":
            self.signals.command("INT", "::el::interrupted")
        self.tcl.say(f"{self.name} {VERSION}, Tcl {tk.eval('info patchlevel')}")
        while (line := self._next_line()) is not None:
            # What was pasted comes as one piece with line ends.
            for part in line.split("\n"):
                self._pending += part + "\n"
                if tk.getboolean(tk.call("info", "complete", self._pending)):
                    command, self._pending = self._pending, ""
                    self._run_typed(command)
        self.tcl.say("")
        return ""

    def _next_line(self) -> str | None:
        from rosafe.eltclsh.line import LineCancelled

        reader, _ = self._editing()
        while True:
            with contextlib.suppress(TclError):  # closed by a script: nothing to flush
                self.tcl.tk.eval("chan flush stdout; chan flush stderr")
            try:
                return reader.read(self._prompt())
            except LineCancelled:
                self._pending = ""

    def _prompt(self) -> str:
        """That of the variable or procedure el::prompt1 (el::prompt2 within a command): a script, or just text."""
        name, default = ("el::prompt2", ": ") if self._pending else ("el::prompt1", f"{self.name} > ")
        tk = self.tcl.tk
        script = self.tcl.variable(name)
        if script is None and self.tcl.elements("info", "commands", f"::{name}"):
            script = name
        if script is None:
            return default
        try:
            first = tk.splitlist(script)[:1]
        except TclError:
            first = ()
        if not first or (len(self.tcl.elements("info", "commands", first[0])) != 1 and "[" not in script):
            return script
        try:
            return str(tk.call("uplevel", "#0", script))
        except TclError as error:
            self.tcl.say(f"{error}", "stderr")
            return default

    def _run_typed(self, command: str) -> None:
        if command.strip():
            self._editing()[1].add(command.rstrip("\n"))
        tk = self.tcl.tk
        tk.eval("set ::el::typed 1")
        try:
            self._evaluate(command, echo=True)
        finally:
            tk.eval("set ::el::typed 0")

    def _run_stdin(self) -> None:
        """As tclsh with a file or pipe: commands and what they read with `gets stdin` come from the same stream."""
        tk = self.tcl.tk
        command = ""
        while True:
            try:
                if tk.eval("chan gets stdin ::el::input") == "-1":
                    return
            except TclError:
                return
            command += tk.eval("set ::el::input") + "\n"
            if tk.getboolean(tk.call("info", "complete", command)):
                whole, command = command, ""
                self._evaluate(whole, echo=False)

    def _evaluate(self, command: str, echo: bool) -> None:
        tk = self.tcl.tk
        self.tcl.elements("::history", "add", command)  # for `!!` and the command `history`
        try:
            result = tk.eval(command) if tk.eval("info level") == "0" else tk.call("uplevel", "#0", command)
        except TclError as error:
            self.tcl.say(str(error), "stderr")
        else:
            if echo and result:
                self.tcl.say(result)

    # --- commands ---

    def gets(self, prompt: str) -> str:
        """el::gets: a line from the user, with editing; TclError at the end of the input or after Ctrl-C."""
        if not os.isatty(0):
            self.tcl.tk.call("chan", "puts", "-nonewline", "stdout", prompt)
            if self.tcl.tk.eval("chan flush stdout; chan gets stdin ::el::input") == "-1":
                raise TclError("no input")
            return str(self.tcl.tk.eval("set ::el::input"))
        from rosafe.eltclsh.line import LineCancelled

        reader, history = self._editing()
        kept = history.entries
        try:
            line = reader.read(prompt)
        except LineCancelled:
            raise TclError("interrupted") from None
        finally:
            history.replace(kept)
        if line is None:
            self.tcl.say("")
            raise TclError("no input")
        return line

    def getc(self) -> str:
        """el::getc: a key from the user, or a character of the input; TclError at its end."""
        if os.isatty(0):
            return self._editing()[0].key()
        character = self.tcl.tk.eval("chan read stdin 1")
        if not character:
            raise TclError("no input")
        return str(character)

    def _redisplay(self) -> str:
        if self._reader is not None:
            self._reader.redisplay()
        return ""

    def _abandon(self) -> str:
        """Give up the line that is being typed, or else the command that runs."""
        if self._reader is None or not self._reader.cancel_line():
            self.signals.abandon()
        return ""

    def _editing(self) -> tuple[LineReader, LineHistory]:
        """readline, once it is needed."""
        if self._reader is None or self._history is None:
            from rosafe.eltclsh.complete import Completer
            from rosafe.eltclsh.history import LineHistory
            from rosafe.eltclsh.line import LineReader

            completer = Completer(self.tcl)
            self._reader = LineReader(self.tcl, lambda before, word: completer.complete(self._pending + before, word))
            self._history = LineHistory(Path("~/.eltclhistory"))
            self.tcl.command("el::Resized", self._reader.resized)
            self.signals.command("WINCH", "::el::Resized")
        return self._reader, self._history
