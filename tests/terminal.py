"""A pseudoterminal: a test types on it and reads the output of a program."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import termios
import time
from pathlib import Path
from types import TracebackType

import pytest

from tests import harness

_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]|\x1b[=>]|\x07|\r")


class Terminal:
    """A program on a separate terminal; the test is skipped without pseudoterminals, as in a bare chroot."""

    def __init__(self, command: list[str], env: dict[str, str], cwd: Path | None = None, columns: int = 200) -> None:
        try:
            self._master, slave = pty.openpty()
        except OSError as problem:
            pytest.skip(f"no pseudoterminal available: {problem}")
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 50, columns, 0, 0))
        # setsid -c: the pty is the controlling terminal, so that Ctrl-C is a signal
        self._process = subprocess.Popen(
            ["setpriv", "--pdeathsig", "KILL", "--", "setsid", "-c", *command],
            env={**env, "TERM": "xterm", "INPUTRC": "/dev/null"},
            cwd=cwd,
            stdin=slave,
            stdout=slave,
            stderr=slave,
        )
        os.close(slave)
        self._raw = b""
        self._seen = 0

    @property
    def sent(self) -> str:
        """The output of the program so far, unchanged."""
        return self._raw.decode("utf-8", "replace")

    @property
    def shown(self) -> str:
        """The output so far without escape sequences."""
        return _ESCAPES.sub("", self.sent)

    def expect(self, text: str, timeout: float = harness.PATIENCE) -> str:
        """Wait for `text` after the previously expected text; return the output up to its end."""
        end = time.monotonic() + timeout
        while True:
            at = self.shown.find(text, self._seen)
            if at >= 0:
                found = self.shown[self._seen : at + len(text)]
                self._seen = at + len(text)
                return found
            if not self._read(end):
                raise AssertionError(f"no {text!r} in {self.shown[self._seen :]!r}; before that: {self.shown!r}")

    def _read(self, end: float) -> bool:
        """Read more output; return False if there is none before `end`."""
        ready, _, _ = select.select([self._master], [], [], max(0.0, end - time.monotonic()))
        try:
            more = os.read(self._master, 65536) if ready else b""
        except OSError:  # EIO: the other side is closed
            more = b""
        self._raw += more
        return bool(more)

    def press(self, keys: str, until: str = "") -> str:
        """Press keys, and wait for the text `until`; return the output up to its end."""
        os.write(self._master, keys.encode())
        return self.expect(until)

    def run(self, command: str, prompt: str = "eltclsh > ") -> str:
        """Type a command and Enter; return its output up to the next prompt."""
        self.press(f"{command}\r", command.rpartition("\n")[2])
        self.expect("\n")
        return self.expect(prompt).removesuffix(prompt).rstrip("\n")

    def end(self, timeout: float = harness.PATIENCE) -> int:
        """Wait for the end and return the exit code; AssertionError if the program does not end."""
        limit = time.monotonic() + timeout
        while self._read(limit):
            continue
        harness.wait_for(lambda: self._process.poll() is not None, timeout, lambda: f"end of {self.shown!r}")
        return int(self._process.returncode)

    def __enter__(self) -> Terminal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        os.close(self._master)
        if error is not None:
            print(self.shown)
