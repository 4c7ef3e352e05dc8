"""The command `signal`, and scripts that run when a signal arrives, also while Tcl is busy."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections import deque
from tkinter import TclError

from rosafe.commands.eltclsh.interpreter import CANCEL_UNWIND, EVAL_GLOBAL, OK, AsyncProc, Interpreter, library

_NAMES = {number.name.removeprefix("SIG"): number for number in signal.Signals}


class Signals:
    """The scripts for signals.

    Python runs signal handlers in its main thread, but not while this thread is inside Tcl. Therefore the number of the
    signal is sent through a pipe (`signal.set_wakeup_fd`) to a thread, which asks Tcl to run `_run_scripts` when safe.
    """

    def __init__(self, interpreter: Interpreter) -> None:
        self._interpreter = interpreter
        self._actions: dict[int, str] = {}
        self._arrived: deque[int] = deque()
        self._cancel = False
        self._forwarder: threading.Thread | None = None

    def command(self, name: str, action: str | None = None) -> str | tuple[str, ...]:
        """Implement `signal names | signal NAME ?script|-ignore|-default|-block|-unblock?`; return the old action."""
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
                return tuple(_name(blocked) for blocked in signal.pthread_sigmask(how, [number]))
            case script:
                self._listen()
                signal.signal(number, lambda *_: None)  # the signal is read from the pipe, but Python needs a handler
                # Ctrl-C interrupts reading from a server or a terminal; other signals do not.
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

    def cancel(self) -> None:
        """End the running command, from a signal script, with an error that scripts cannot catch."""
        self._cancel = True

    def _listen(self) -> None:
        if self._forwarder is not None:
            return
        self._procedure = AsyncProc(self._run_scripts)  # Tcl holds no reference to it
        handler = library.Tcl_AsyncCreate(self._procedure, None)
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        self._forwarder = threading.Thread(target=self._forward, args=(reader, handler), daemon=True)
        # Signals must interrupt the main thread, so this thread blocks them.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        self._forwarder.start()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _forward(self, reader: int, handler: int) -> None:
        while numbers := os.read(reader, 64):
            self._arrived.extend(numbers)
            library.Tcl_AsyncMark(handler)

    def _run_scripts(self, _data: int, _interp: int, code: int) -> int:
        """Run the scripts of received signals. Called by Tcl between two instructions, or while it waits for events."""
        address = self._interpreter.address
        state = library.Tcl_SaveInterpState(address, code)
        while self._arrived:
            script = self._actions.get(self._arrived.popleft(), "-default")
            if script in ("-default", "-ignore"):
                continue
            result = library.Tcl_EvalEx(address, script.encode(), -1, EVAL_GLOBAL)
            if result != OK:
                library.Tcl_BackgroundException(address, result)
        code = int(library.Tcl_RestoreInterpState(address, state))
        if self._cancel:
            self._cancel = False
            message = library.Tcl_NewStringObj(b"interrupted", -1)
            library.Tcl_CancelEval(address, message, None, CANCEL_UNWIND)
        return code


def _name(number: int) -> str:
    with contextlib.suppress(ValueError):  # real-time signals have no name
        return signal.Signals(number).name.removeprefix("SIG")
    return str(number)
