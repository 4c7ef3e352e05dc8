"""A Tcl interpreter as tclsh has it, and commands in it that are Python functions whose errors arrive in Tcl."""

from __future__ import annotations

import contextlib
import inspect
import os
import sys
import tkinter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rosafe.eltclsh.library import tcl as library

LIBRARY = Path(__file__).resolve().parent
_CODE = LIBRARY.parents[1]
# The folder of the Tcl package genomix, seen from a checkout, and from lib/python3/dist-packages of an install prefix.
PACKAGES = [str(place) for place in (_CODE / "tcl", _CODE.parents[1] / "tcltk") if (place / "genomix").is_dir()]


class Interpreter:
    """Tcl. `tk` is tkinter's own object; values that come from it are texts."""

    def __init__(self) -> None:
        self.tk: Any = tkinter.Tcl().tk
        self.tk.wantobjects(False)
        self.address = self.tk.interpaddr()
        # For `exec [info nameofexecutable] script`, which otherwise would give the script to Python.
        library.Tcl_FindExecutable(os.fsencode(os.path.abspath(sys.argv[0])))
        self.tk.eval("unset -nocomplain ::_tkinter_skip_tk_init; namespace eval ::el::python {}")
        # Python's own commands cannot fail in Tcl's sense: they would arrive as errors without a text.
        self.tk.eval(
            "proc ::el::Invoke {command args} {lassign [::el::python::$command {*}$args] code result errorcode\n"
            "return -code $code -errorcode $errorcode $result}"
        )

    def command(self, name: str, function: Callable[..., Any]) -> None:
        """Make `function` the Tcl command `name`; what it raises becomes a Tcl error with a text and an error code."""

        signature = inspect.signature(function)

        def run(*arguments: str) -> tuple[int, Any, Any]:
            try:
                signature.bind(*arguments)
            except TypeError:
                told = f'wrong # args: should be "{" ".join([name, *map(_usage, signature.parameters.values())])}"'
                return 1, told, ("TCL", "WRONGARGS")
            try:
                return 0, function(*arguments), "NONE"
            except tkinter.TclError as error:
                return 1, str(error) or f"{name} failed", ("ELTCLSH", name)
            except OSError as error:
                told = error.strerror or str(error)
                return 1, f"{error.filename}: {told}" if error.filename else told, ("POSIX", str(error.errno), told)
            except Exception as error:  # it must not get lost on its way through Tcl
                return 1, f"{name}: {type(error).__name__}: {error}", ("PYTHON", type(error).__name__)

        tail = name.replace("::", "_")
        self.tk.createcommand(f"::el::python::{tail}", run)
        self.tk.call("interp", "alias", "", f"::{name}", "", "::el::Invoke", tail)

    def elements(self, *words: str) -> list[str]:
        """The elements of a command's result, none where it fails."""
        try:
            return list(self.tk.splitlist(self.tk.call(*words)))
        except tkinter.TclError:
            return []

    def split(self, text: str) -> list[str]:
        """The elements of a Tcl list, none where the text is no list."""
        return self.elements("lrange", text, "0", "end")

    def variable(self, name: str) -> str | None:
        """The value of a global variable, None where there is none."""
        try:
            return str(self.tk.globalgetvar(name))
        except tkinter.TclError:
            return None

    def say(self, text: str, channel: str = "stdout") -> None:
        """Write a line, whatever a script has made of `puts`."""
        with contextlib.suppress(tkinter.TclError):  # the channel is closed: there is nobody to tell
            self.tk.call("chan", "puts", channel, text)
            self.tk.call("chan", "flush", channel)


def _usage(parameter: inspect.Parameter) -> str:
    if parameter.kind is parameter.VAR_POSITIONAL:
        return "?arg ...?"
    return parameter.name if parameter.default is parameter.empty else f"?{parameter.name}?"
