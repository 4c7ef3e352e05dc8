"""C functions of the Tcl library of tkinter that tkinter does not provide: exit, and signals while Tcl is busy.

Callbacks of these functions must not use the interpreter of tkinter: it stores the Python thread state in a variable
that such a call would clear. They evaluate scripts with `Tcl_EvalEx`. Commands of `createcommand` may use both.
"""

from __future__ import annotations

import _tkinter
import ctypes
from ctypes import c_char_p, c_int, c_void_p

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

tcl = ctypes.CDLL(_tkinter.__file__)  # also finds the symbols of libtcl
for _name, (_result, _arguments) in _FUNCTIONS.items():
    _function = getattr(tcl, _name)
    _function.restype, _function.argtypes = _result, _arguments
