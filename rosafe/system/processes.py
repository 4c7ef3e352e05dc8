"""Child processes that always end with this process."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping
from typing import IO

END_SECONDS = 2.0  # from SIGTERM to SIGKILL
_WITH_PARENT = ("sh", "-c", '[ "$PPID" = "$0" ] && exec "$@"')  # do nothing if the parent died before setpriv


class Child:
    """A running command in its own session; its output is stored in unnamed files.

    When the thread that started it dies, the kernel sends it the signal `orphaned`, such as KILL.
    """

    def __init__(self, command: list[str], env: Mapping[str, str], orphaned: str) -> None:
        self.command = command
        self._out: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  # open as long as this object exists
        self._err: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        self.process = subprocess.Popen(
            ["setpriv", "--pdeathsig", orphaned, "--", *_WITH_PARENT, str(os.getpid()), *command],
            env=dict(env),
            stdin=subprocess.DEVNULL,
            stdout=self._out,
            stderr=self._err,
            start_new_session=True,  # Ctrl-C in the terminal reaches only this process, which then ends the child
        )

    @property
    def out(self) -> str:
        """Output on stdout so far."""
        return _content(self._out)

    @property
    def err(self) -> str:
        """Output on stderr so far."""
        return _content(self._err)

    def has_ended(self) -> bool:
        """Return whether the process has ended."""
        return self.process.poll() is not None


class ProcessGroup:
    """All children of this process. Use it in the main thread only, because the kernel watches the starting thread.

    If this process is killed, the kernel sends the children `orphaned`: KILL, or TERM if they have children to end.
    """

    def __init__(self, env: Mapping[str, str], orphaned: str = "KILL") -> None:
        self.env = env
        self._orphaned = orphaned
        self._all: list[Child] = []

    def start(self, *command: str) -> Child:
        """Start a command."""
        child = Child(list(command), self.env, self._orphaned)
        self._all.append(child)
        return child

    def close(self, seconds: float = END_SECONDS) -> None:
        """Send SIGTERM to all children, and SIGKILL to those that are still running after `seconds`."""
        for child in self._all:
            _signal_group(child, signal.SIGTERM)
        deadline = time.monotonic() + seconds
        for child in self._all:
            try:
                child.process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                _signal_group(child, signal.SIGKILL)
                child.process.wait()
        self._all.clear()


def _content(file: IO[bytes]) -> str:
    return os.pread(file.fileno(), 1_000_000, 0).decode("utf-8", "replace")


def _signal_group(child: Child, number: int) -> None:
    if not child.has_ended():  # otherwise, its process id may have been reused
        os.killpg(child.process.pid, number)
