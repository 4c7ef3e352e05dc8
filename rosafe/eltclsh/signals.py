"""The command `signal`, and scripts that run when a signal comes, also while Tcl is busy."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections import deque
from tkinter import TclError

from rosafe.eltclsh import library
from rosafe.eltclsh.interpreter import Interpreter

_NAMES = {number.name.removeprefix("SIG"): number for number in signal.Signals}


class Signals:
    """Which script belongs to which signal.

    Python runs handlers in its main thread, and not as long as that is inside Tcl. So the number of the signal goes
    through a pipe (`signal.set_wakeup_fd`) to a thread, which asks Tcl to call us at the next place that is safe.
    """

    def __init__(self, interpreter: Interpreter) -> None:
        self._interpreter = interpreter
        self._actions: dict[int, str] = {}
        self._arrived: deque[int] = deque()
        self._abandon = False
        self._running: threading.Thread | None = None

    def command(self, name: str, action: str | None = None) -> str | tuple[str, ...]:
        """signal names | signal NAME ?script|-ignore|-default|-block|-unblock?; the value is what held before."""
        if name == "names" and action is None:
            return tuple(_NAMES)
        number = self._number(name)
        before = self._actions.get(number, "-default")
        match action:
            case None:
                pass
            case "-default" | "-ignore":
                signal.signal(number, signal.SIG_DFL if action == "-default" else signal.SIG_IGN)
                self._actions[number] = action
            case "-block" | "-unblock":
                how = signal.SIG_BLOCK if action == "-block" else signal.SIG_UNBLOCK
                return tuple(_name(held) for held in signal.pthread_sigmask(how, [number]))
            case script:
                self._listen()
                signal.signal(number, lambda *_: None)  # the pipe tells; but Python must have a handler
                # Reading from a server or a terminal ends with Ctrl-C, and goes on after any other signal.
                signal.siginterrupt(number, number == signal.SIGINT)
                self._actions[number] = script
        return before

    @staticmethod
    def _number(name: str) -> int:
        known = _NAMES.get(name.upper().removeprefix("SIG"))
        if known is None and name.isascii() and name.isdigit() and 0 < int(name) < signal.NSIG:
            return int(name)
        if known is None:
            raise TclError(f'unknown signal "{name}": see signal names')
        return known

    def abandon(self) -> None:
        """For a script of ours: what was running ends with an error that nothing catches."""
        self._abandon = True

    def _listen(self) -> None:
        if self._running is not None:
            return
        self._procedure = library.AsyncProc(self._run_scripts)  # must live as long as Tcl knows it
        handler = library.tcl.Tcl_AsyncCreate(self._procedure, None)
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        self._running = threading.Thread(target=self._forward, args=(reader, handler), daemon=True)
        # Signals are for the main thread, which they are to wake from what it waits for.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        self._running.start()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _forward(self, reader: int, handler: int) -> None:
        while numbers := os.read(reader, 64):
            self._arrived.extend(numbers)
            library.tcl.Tcl_AsyncMark(handler)

    def _run_scripts(self, _data: int, _interp: int, code: int) -> int:
        """Called by Tcl between two of its instructions, or while it waits for events."""
        address = self._interpreter.address
        state = library.tcl.Tcl_SaveInterpState(address, code)
        while self._arrived:
            script = self._actions.get(self._arrived.popleft(), "-default")
            if script in ("-default", "-ignore"):
                continue
            result = library.tcl.Tcl_EvalEx(address, script.encode(), -1, library.EVAL_GLOBAL)
            if result != library.OK:
                library.tcl.Tcl_BackgroundException(address, result)
        code = int(library.tcl.Tcl_RestoreInterpState(address, state))
        if self._abandon:
            self._abandon = False
            told = library.tcl.Tcl_NewStringObj(b"interrupted", -1)
            library.tcl.Tcl_CancelEval(address, told, None, library.CANCEL_UNWIND)
        return code


def _name(number: int) -> str:
    with contextlib.suppress(ValueError):  # real-time signals have none
        return signal.Signals(number).name.removeprefix("SIG")
    return str(number)
