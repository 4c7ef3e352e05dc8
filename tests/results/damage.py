"""Damaged results: copies with seeded changes, read by a forked child process, which starts quickly."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rosafe.results import hdf5_reading, isolated


class Forked:
    """Replaces `subprocess.Popen` for `rosafe.results.isolated` without the start of an interpreter."""

    def __init__(self, args: list[str], **options: Any) -> None:
        self.args = args
        self.returncode = 0
        (read, write), (read_error, write_error), (asked, ask) = os.pipe(), os.pipe(), os.pipe()
        self._child = os.fork()
        if not self._child:
            for number, descriptor in enumerate((asked, write, write_error)):
                os.dup2(descriptor, number)
            for number in {*range(3, 200)} - {*options["pass_fds"]}:
                with contextlib.suppress(OSError):
                    os.close(number)
            sys.stdin = open(0)  # noqa: SIM115
            sys.argv = args[args.index(hdf5_reading._PROGRAM) :]
            status = 1
            try:
                isolated.main()
                status = 0
            except SystemExit as end:
                os.write(2, f"{end.code}\n".encode())
            finally:
                os._exit(status)
        os.close(write)
        os.close(write_error)
        os.close(asked)
        self.stdin = open(ask, "wb", buffering=0)  # noqa: SIM115
        self.stdout = open(read, "rb", buffering=0)  # noqa: SIM115
        self._error = open(read_error, "rb")  # noqa: SIM115

    def __enter__(self) -> Forked:
        return self

    def __exit__(self, *_: object) -> None:
        self._wait()
        self.stdin.close()
        self.stdout.close()
        self._error.close()

    def _wait(self) -> None:
        if self._child:
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self._child, 0)[1])
            self._child = 0

    def kill(self) -> None:
        if self._child:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._child, signal.SIGKILL)

    def communicate(self, timeout: float) -> tuple[bytes, bytes]:
        text = self._error.read()
        self._wait()
        return b"", text


@pytest.fixture
def forked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Child processes that read are forked."""
    monkeypatch.setattr(hdf5_reading, "subprocess", SimpleNamespace(**{**vars(subprocess), "Popen": Forked}))


def change(content: bytes, draw: random.Random) -> bytes:
    """Return a copy with one to four changes of bytes and lengths."""
    data = bytearray(content)
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        at, length = draw.randrange(max(1, len(data))), draw.choice((1, 2, 4, 8, 64))
        new = draw.choice((draw.randbytes(length), b"\0" * length, b"\xff" * length, b"", data[: 2 * length]))
        data[at : at + length] = new
    return bytes(data)


def damaged(good: Path, target: Path, seed: int) -> Path:
    """Create a changed copy of a file as `target`."""
    draw = random.Random(seed)
    if good.suffix == ".npz" and draw.random() < 0.7:  # with the right checksums
        with zipfile.ZipFile(good) as old, zipfile.ZipFile(target, "w", draw.choice((0, 8))) as new:
            changed_name = draw.choice(old.namelist())
            for name in old.namelist():
                content = old.read(name)
                new.writestr(name, change(content, draw) if name == changed_name else content)
    else:
        target.write_bytes(change(good.read_bytes(), draw))
    return target


VALUES: list[Any] = [None, True, -1, 0, 0.5, 1e308, 10**400, float("nan"), float("inf"), "", "x", "\ud800"]
VALUES += [[], [1, "a"], {}, [[]], {"ild": 5}, {"ild": [5]}, {"ild": ["channel"]}, {"ild": "time"}, {"ild": {"a": 1}}]
VALUES += [{"\x1b[31m": ["time"]}]
