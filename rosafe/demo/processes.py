"""Child processes that never outlive this one, whatever ends it."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping
from types import TracebackType
from typing import IO

END_SECONDS = 2.0  # for a gentle end; nobody but this process has to do with the children
_WITH_PARENT = ("sh", "-c", '[ "$PPID" = "$0" ] && exec "$@"')  # against a death just before setpriv


class Child:
    """A running command with a session of its own; what it prints is kept in files that have no name.

    The kernel signals it when the thread that started it dies: `orphaned`, such as KILL.
    """

    def __init__(self, command: list[str], env: Mapping[str, str], orphaned: str) -> None:
        self.command = command
        self._out: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  # as long as the child is of interest
        self._err: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        self.process = subprocess.Popen(
            ["setpriv", "--pdeathsig", orphaned, "--", *_WITH_PARENT, str(os.getpid()), *command],
            env=dict(env),
            stdin=subprocess.DEVNULL,
            stdout=self._out,
            stderr=self._err,
            start_new_session=True,  # a Ctrl-C in the terminal is for this process alone, which then ends the child
        )

    @property
    def out(self) -> str:
        """What it has printed on stdout so far."""
        return os.pread(self._out.fileno(), 1_000_000, 0).decode("utf-8", "replace")

    @property
    def err(self) -> str:
        """What it has printed on stderr so far."""
        return os.pread(self._err.fileno(), 1_000_000, 0).decode("utf-8", "replace")

    def has_ended(self) -> bool:
        """Whether it is gone."""
        return self.process.poll() is not None


class ProcessGroup:
    """All children of this process, ended together. For the main thread only: the kernel watches that.

    Where this process is killed, they are, too; `orphaned` is TERM for those that have children of their own to end.
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
        """End all that still run: gently, and by force after so many seconds."""
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

    def __enter__(self) -> ProcessGroup:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _signal_group(child: Child, number: int) -> None:
    if not child.has_ended():  # its number may be another process's later
        os.killpg(child.process.pid, number)
