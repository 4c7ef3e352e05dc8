"""A Tcl interpreter like that of tclsh, with commands that are Python functions and report errors to Tcl."""

from __future__ import annotations

import _tkinter
import contextlib
import ctypes
import inspect
import os
import sys
import tkinter
from collections.abc import Callable
from ctypes import c_char_p, c_int, c_void_p
from pathlib import Path
from typing import Any

LIBRARY = Path(__file__).resolve().parent
_CODE = LIBRARY.parents[2]
# The folder of the Tcl package genomix, in a checkout or relative to lib/python3/dist-packages of an installation.
PACKAGES = [str(path) for path in (_CODE / "tcl", _CODE.parents[1] / "tcltk") if (path / "genomix").is_dir()]

# C functions of the Tcl library of tkinter that tkinter does not provide: exit, and signals while Tcl is busy. Their
# callbacks must not use the interpreter of tkinter: it stores the Python thread state in a variable that such a call
# would clear. They evaluate scripts with `Tcl_EvalEx`. Commands of `createcommand` may use both.
EVAL_GLOBAL = 0x20000
CANCEL_UNWIND = 0x100000
OK = 0

AsyncProc = ctypes.CFUNCTYPE(c_int, c_void_p, c_void_p, c_int)

_FUNCTIONS = {  # result and arguments
    "Tcl_AsyncCreate": (c_void_p, [AsyncProc, c_void_p]),
    "Tcl_AsyncMark": (None, [c_void_p]),
    "Tcl_BackgroundException": (None, [c_void_p, c_int]),
    "Tcl_CancelEval": (c_int, [c_void_p, c_void_p, c_void_p, c_int]),
    "Tcl_EvalEx": (c_int, [c_void_p, c_char_p, c_int, c_int]),
    "Tcl_Exit": (None, [c_int]),
    "Tcl_FindExecutable": (None, [c_char_p]),
    "Tcl_NewStringObj": (c_void_p, [c_char_p, c_int]),
    "Tcl_RestoreInterpState": (c_int, [c_void_p, c_void_p]),
    "Tcl_SaveInterpState": (c_void_p, [c_void_p, c_int]),
}

library = ctypes.CDLL(_tkinter.__file__)  # also finds the symbols of libtcl
for _name, (_result, _arguments) in _FUNCTIONS.items():
    _function = getattr(library, _name)
    _function.restype, _function.argtypes = _result, _arguments


class Interpreter:
    """A Tcl interpreter. `tk` is the object of tkinter; its results are texts."""

    def __init__(self) -> None:
        self.tk: Any = tkinter.Tcl().tk
        self.tk.wantobjects(False)
        self.address = self.tk.interpaddr()
        # `exec [info nameofexecutable] script` must run this program and not Python.
        library.Tcl_FindExecutable(os.fsencode(os.path.abspath(sys.argv[0])))
        self.tk.eval("unset -nocomplain ::_tkinter_skip_tk_init; namespace eval ::el::python {}")
        # Python exceptions would be Tcl errors without a message, so the functions return code, result and error code.
        self.tk.eval(
            "proc ::el::Invoke {command args} {lassign [::el::python::$command {*}$args] code result errorcode\n"
            "return -code $code -errorcode $errorcode $result}"
        )

    def create_command(self, name: str, function: Callable[..., Any]) -> None:
        """Create the Tcl command `name`; exceptions of `function` become Tcl errors with message and error code."""
        signature = inspect.signature(function)

        def run(*arguments: str) -> tuple[int, Any, Any]:
            try:
                signature.bind(*arguments)
            except TypeError:
                message = f'wrong # args: should be "{" ".join([name, *map(_usage, signature.parameters.values())])}"'
                return 1, message, ("TCL", "WRONGARGS")
            try:
                return 0, function(*arguments), "NONE"
            except tkinter.TclError as error:
                return 1, str(error) or f"{name} failed", ("ELTCLSH", name)
            except OSError as error:
                reason = error.strerror or str(error)
                message = f"{error.filename}: {reason}" if error.filename else reason
                return 1, message, ("POSIX", str(error.errno), reason)
            except Exception as error:  # otherwise, it would be lost in Tcl
                return 1, f"{name}: {type(error).__name__}: {error}", ("PYTHON", type(error).__name__)

        tail = name.replace("::", "_")
        self.tk.createcommand(f"::el::python::{tail}", run)
        self.tk.call("interp", "alias", "", f"::{name}", "", "::el::Invoke", tail)

    def elements(self, *words: str) -> list[str]:
        """Return the elements of the result of a command; empty if the command fails."""
        try:
            return list(self.tk.splitlist(self.tk.call(*words)))
        except tkinter.TclError:
            return []

    def split(self, text: str) -> list[str]:
        """Return the elements of a Tcl list; empty if the text is not a list."""
        return self.elements("lrange", text, "0", "end")

    def variable(self, name: str) -> str | None:
        """Return the value of a global variable, or None."""
        try:
            return str(self.tk.globalgetvar(name))
        except tkinter.TclError:
            return None

    def print_line(self, text: str, channel: str = "stdout") -> None:
        """Print a line, also if a script has replaced `puts`."""
        with contextlib.suppress(tkinter.TclError):  # the channel is closed
            self.tk.call("chan", "puts", channel, text)
            self.tk.call("chan", "flush", channel)


def _usage(parameter: inspect.Parameter) -> str:
    if parameter.kind is parameter.VAR_POSITIONAL:
        return "?arg ...?"
    return parameter.name if parameter.default is parameter.empty else f"?{parameter.name}?"
