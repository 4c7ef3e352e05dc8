"""Read HDF5 files in a child process, so that a damaged file cannot crash or block this one."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import math
import os
import re
import select
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rosafe.results.isolated import MAX_TEXT, blocks, check_size
from rosafe.results.result_metadata import new_array
from rosafe.system.input import open_regular
from rosafe.tree.sizes import refuse_over_available

STALL = 10  # seconds without output of the child process, after which the file counts as damaged
START = 60  # seconds that the child process may take to start
_PROGRAM = os.path.abspath(Path(__file__).with_name("isolated.py"))
_PIPE = 2**20  # bytes of the buffer between the processes


class _ChildEnded(Exception):
    """The child process has ended before its output was complete."""


@contextmanager
def open_hdf5(path: str | os.PathLike[str]) -> Iterator[Hdf5Content]:
    """Open an HDF5 file of any origin; only those numbers are read that are asked for.

    A child process reads it. References to other files (links, external storage, virtual datasets) and plugins of HDF5
    are refused.

    Raises
    ------
    ValueError
        The file is damaged or not allowed, or the child process has sent nothing for `STALL` seconds; also from each
        access to the content.
    OSError
        The file cannot be opened, or the child process cannot be started.
    """
    with contextlib.ExitStack() as closing:
        with open_regular(path) as file:  # its number must not be that of a standard stream, which may be closed here
            descriptor = fcntl.fcntl(file, fcntl.F_DUPFD_CLOEXEC, 3)
        closing.callback(os.close, descriptor)
        modules = [os.path.abspath(folder) for folder in sys.path if folder]
        request = json.dumps({"descriptor": descriptor, "modules": modules})
        alone = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"}  # no plugins of HDF5
        child = closing.enter_context(
            subprocess.Popen(
                [_python(), "-I", "-S", "-W", "ignore", _PROGRAM, request],
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                cwd="/",
                env={**os.environ, **alone},
                pass_fds=(descriptor,),
            )
        )
        closing.callback(child.kill)
        pipe = _Pipe(child)
        try:
            pipe.read(1, START)
        except (_ChildEnded, TimeoutError):
            raise OSError(errno.ENOEXEC, f"{_python()} cannot be started to read it: {pipe.end()}") from None
        try:
            length = int.from_bytes(pipe.read(8), "little")
            yield Hdf5Content(pipe, json.loads(pipe.read(length)))
        except _ChildEnded:
            raise ValueError(pipe.end()) from None
        except TimeoutError:
            raise ValueError(f"nothing could be read for {STALL} s") from None


class Hdf5Content(Mapping[str, "Hdf5Array"]):
    """The arrays of numbers of an open HDF5 file by name; ValueError for another object, and for references.

    Attributes
    ----------
    attrs : dict
        Attributes of the file that are numbers or texts; empty ones are missing.
    """

    def __init__(self, pipe: _Pipe, head: dict[str, Any]) -> None:
        self._pipe = pipe
        self._found = {one["name"]: one for one in head["arrays"]}
        self.attrs = head["attributes"]

    def __getitem__(self, name: str) -> Hdf5Array:
        found = self._found[name]
        if "problem" in found:
            raise ValueError(found["problem"])
        return Hdf5Array(self._pipe, found)

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)


class Hdf5Array:
    """An array of an open HDF5 file, of which ``array[()]`` reads all numbers and ``array[rows]`` ascending rows.

    Attributes
    ----------
    shape : tuple of int
    dtype : dtype
    attrs : dict
        As of `Hdf5Content`.
    """

    def __init__(self, pipe: _Pipe, described: dict[str, Any]) -> None:
        self._pipe = pipe
        self._name, self._block = described["name"], tuple(described["block"])
        self.shape = tuple(described["shape"])
        self.dtype = np.dtype(described["dtype"])
        self.attrs = described["attributes"]

    def __getitem__(self, rows: Sequence[int] | tuple[()]) -> np.ndarray:
        if rows == ():
            self._pipe.ask(self._name, None)
            return self._pipe.array(self.shape, self._block, self.dtype)
        self._pipe.ask(self._name, list(rows))
        shape = (len(rows), *self.shape[1:])
        return self._pipe.array(shape, shape, self.dtype)


def _python() -> str:
    """Return the path of the interpreter, also if Python is embedded in another program; OSError if none is found."""
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    folders = (sys.exec_prefix, sys.base_exec_prefix)
    for path in (sys.executable, *(os.path.join(folder, "bin", version) for folder in folders), shutil.which(version)):
        if path and re.fullmatch(r"python[0-9.]*[a-z]*", os.path.basename(path)) and os.access(path, os.X_OK):
            return path
    raise OSError(errno.ENOENT, f"found no program {version}, which is needed to read it; install it")


class _Pipe:
    """Standard output of a child process, and its standard input."""

    def __init__(self, child: subprocess.Popen[bytes]) -> None:
        assert child.stdout
        self._child = child
        self._descriptor = child.stdout.fileno()
        with contextlib.suppress(OSError):  # more than the system allows to one user
            fcntl.fcntl(self._descriptor, fcntl.F_SETPIPE_SZ, _PIPE)
        self._poll = select.poll()
        self._poll.register(self._descriptor, select.POLLIN)

    def ask(self, name: str, rows: list[int] | None) -> None:
        """Ask for the numbers of an array."""
        assert self._child.stdin
        try:
            self._child.stdin.write(json.dumps([name, rows]).encode() + b"\n")
        except BrokenPipeError:
            raise _ChildEnded from None

    def fill(self, buffer: memoryview, seconds: int | None = None) -> None:
        """Fill a buffer; `_ChildEnded`, or TimeoutError after `seconds` (default: `STALL`) without a byte."""
        while buffer:
            # in steps of 1 s: time during which both processes are stopped does not count
            if not any(self._poll.poll(1000) for _ in range(seconds or STALL)):
                raise TimeoutError
            count = os.readv(self._descriptor, [buffer])
            if not count:
                raise _ChildEnded
            buffer = buffer[count:]

    def read(self, count: int, seconds: int | None = None) -> bytearray:
        """Return the next `count` bytes."""
        content = bytearray(count)
        self.fill(memoryview(content), seconds)
        return content

    def array(self, shape: tuple[int, ...], block: tuple[int, ...], dtype: np.dtype[Any]) -> np.ndarray:
        """Return the next array, which is sent in blocks of the shape `block`."""
        array = new_array(shape, dtype)
        buffer = new_array((math.prod(block),), dtype)
        for slices in blocks(shape, block):
            part = array[slices]
            if part.flags.c_contiguous and part.ndim:
                self.fill(part.reshape(-1).view(np.uint8).data)
            else:
                self.fill(buffer[: part.size].view(np.uint8).data)
                array[slices] = buffer[: part.size].reshape(part.shape)
        return array

    def end(self) -> str:
        """Return the reason why the child process has ended."""
        try:
            _, text = self._child.communicate(timeout=1)
        except subprocess.TimeoutExpired:
            return f"it does not answer for {START} s"
        code = self._child.returncode
        if code < 0:
            return f"the library that reads it crashed ({signal.Signals(-code).name})"
        return (text.decode(errors="replace").splitlines() or ["it is cut off"])[-1][:MAX_TEXT]


def check_arrays(file_size: int, size: float) -> None:
    """Raise ValueError if arrays of `size` bytes are too large for a file, or for the memory."""
    check_size(size, file_size)
    refuse_over_available(size, "its arrays", "close other programs, or use a machine with more memory")
