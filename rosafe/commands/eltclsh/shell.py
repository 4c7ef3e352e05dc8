"""The programs eltclsh and elwish: run a script or the prompt, with the command line of tclsh."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from tkinter import TclError
from typing import NoReturn

from rosafe.commands.eltclsh.complete import parse
from rosafe.commands.eltclsh.interpreter import LIBRARY, PACKAGES, Interpreter, library
from rosafe.commands.eltclsh.prompt import Prompt
from rosafe.commands.eltclsh.signals import Signals
from rosafe.system.version import VERSION

COMPATIBLE_VERSION = "1.20"  # of the original, for `package require eltclsh`
USAGE = """usage: {name} [-package NAME]... [SCRIPT [ARGUMENT]...]

A Tcl shell with line editing{tk}. Runs SCRIPT as tclsh does, or reads commands. `package require genomix` is available.
At the prompt: TAB completes, the arrow keys recall previous lines (~/.eltclhistory), Ctrl-D ends.
~/.{name}rc is run first.
example: {name} -package genomix script.tcl
"""


def main(tk: bool = False) -> NoReturn:
    """Run eltclsh, or with `tk` elwish, on the arguments of this process."""
    name = "elwish" if tk else "eltclsh"
    if sys.argv[1:] in (["-h"], ["--help"]):
        print(USAGE.format(name=name, tk=" and Tk" if tk else ""), end="")
        sys.exit(0)
    if sys.argv[1:] == ["--version"]:
        print(f"{name} {VERSION}")
        sys.exit(0)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # as in tclsh; the handler of Python would wait until Tcl returns
    Shell(name).run(tk)


class Shell:
    """An interpreter with the commands of eltclsh, and the start and end of the process."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.tcl = Interpreter()
        signals = Signals(self.tcl)
        self._prompt = Prompt(name, self.tcl, signals)
        self.tcl.create_command("el::Exit", self.exit)
        self.tcl.create_command("el::parse", parse)
        self.tcl.create_command("signal", signals.command)

    def run(self, tk: bool) -> NoReturn:
        """Run the script or the prompt, and exit with the command `exit`, which a script may have replaced."""
        script, encoding = self._set_arguments()
        try:
            self._initialise()
            if tk:
                self.tcl.tk.loadtk()
                self.tcl.tk.eval("wm withdraw .")
        except TclError as error:
            self.tcl.print_line(f"{self.name}: {error}", "stderr")
            self.exit("1")
        rc_file = os.path.expanduser(f"~/.{self.name}rc")
        if os.path.isfile(rc_file):
            self._source(rc_file)
        code = "0"
        if script is None:
            self._prompt.run()
        elif not self._source(script, encoding):
            code = "1"
        with contextlib.suppress(TclError):  # in case a script has replaced `exit`
            self.tcl.tk.call("exit", code)
        self.exit(code)

    def _source(self, script: str, encoding: str | None = None) -> bool:
        """Run a script; if it fails, print its stack trace and return False."""
        try:
            if encoding is None:
                self.tcl.tk.evalfile(script)
            else:
                self.tcl.tk.call("source", "-encoding", encoding, script)
        except TclError as error:
            trace = self.tcl.variable("errorInfo") or ""  # may be that of an earlier error if the file is not readable
            self.tcl.print_line(trace if trace.startswith(str(error)) else str(error), "stderr")
            return False
        return True

    def _set_arguments(self) -> tuple[str | None, str | None]:
        """Set argv, argc, argv0 and tcl_interactive; return the script to run and its encoding."""
        arguments, packages, encoding, script = sys.argv[1:], [], None, None
        while arguments[:1] == ["-package"] and len(arguments) > 1:
            packages += arguments[:2]
            arguments = arguments[2:]
        if arguments[:1] == ["-encoding"] and len(arguments) > 2 and not arguments[2].startswith("-"):
            encoding, arguments = arguments[1], arguments[2:]
        if arguments and not arguments[0].startswith("-"):
            script, *arguments = arguments
        self._set_argv(packages + arguments)
        self.tcl.tk.call("set", "argv0", script or sys.argv[0])
        self.tcl.tk.call("set", "tcl_interactive", str(int(script is None and os.isatty(0))))
        return script, encoding

    def _set_argv(self, arguments: list[str]) -> None:
        self.tcl.tk.call("set", "argv", tuple(arguments))
        self.tcl.tk.call("set", "argc", str(len(arguments)))

    def _initialise(self) -> None:
        """Load the packages and procedures of eltclsh, of ELTCLLIBPATH and of the option -package."""
        tk = self.tcl.tk
        library_dir = os.environ.get("ELTCL_LIBRARY", str(LIBRARY))
        tk.call("set", "eltcl_library", library_dir)
        tk.call("set", "eltcl_pkgPath", tuple(PACKAGES))
        tk.call("lappend", "auto_path", *PACKAGES, library_dir)
        try:
            tk.call("lappend", "auto_path", *tk.splitlist(os.environ.get("ELTCLLIBPATH", "")))
        except TclError as error:
            self.tcl.print_line(f"{self.name}: ELTCLLIBPATH: {error}", "stderr")
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
                self.tcl.print_line(f"{error}\ncannot load {name}", "stderr")
        self._set_argv(arguments)

    def exit(self, code: str) -> NoReturn:
        """Save the history and end the process as Tcl does, which flushes open files."""
        self._prompt.close()
        library.Tcl_Exit(int(code))
        raise SystemExit(int(code))
