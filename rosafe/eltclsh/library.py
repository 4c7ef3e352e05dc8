"""C functions of the Tcl that tkinter brings, for what tkinter leaves out: a clean exit, and signals in a busy Tcl.

Callbacks from here must not use tkinter's interpreter (it keeps the Python thread state in a variable that such a call
would clear); they evaluate with `Tcl_EvalEx`. Commands made with `createcommand` may use either.
"""

from __future__ import annotations

import _tkinter
import ctypes

EVAL_GLOBAL = 0x20000
CANCEL_UNWIND = 0x100000
OK, ERROR = 0, 1

AsyncProc = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int)

tcl = ctypes.CDLL(_tkinter.__file__)  # libtcl is found through it

tcl.Tcl_AsyncCreate.argtypes = [AsyncProc, ctypes.c_void_p]
tcl.Tcl_AsyncCreate.restype = ctypes.c_void_p
tcl.Tcl_AsyncMark.argtypes = [ctypes.c_void_p]
tcl.Tcl_AsyncMark.restype = None
tcl.Tcl_BackgroundException.argtypes = [ctypes.c_void_p, ctypes.c_int]
tcl.Tcl_BackgroundException.restype = None
tcl.Tcl_CancelEval.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int]
tcl.Tcl_EvalEx.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_int]
tcl.Tcl_Exit.argtypes = [ctypes.c_int]
tcl.Tcl_Exit.restype = None
tcl.Tcl_FindExecutable.argtypes = [ctypes.c_char_p]
tcl.Tcl_FindExecutable.restype = None
tcl.Tcl_NewStringObj.argtypes = [ctypes.c_char_p, ctypes.c_int]
tcl.Tcl_NewStringObj.restype = ctypes.c_void_p
tcl.Tcl_RestoreInterpState.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
tcl.Tcl_SaveInterpState.argtypes = [ctypes.c_void_p, ctypes.c_int]
tcl.Tcl_SaveInterpState.restype = ctypes.c_void_p
