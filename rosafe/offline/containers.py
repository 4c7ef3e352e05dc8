"""Read HDF5 files and Zarr folders in a child process, so that a damaged file cannot crash or block this one."""

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
from pathlib import Path
from typing import Any

import numpy as np

from rosafe.offline.isolated import MAX_TEXT, blocks
from rosafe.offline.memory import LESS, refuse_over_available
from rosafe.offline.result_metadata import is_scalar, new_array, parse_metadata, restored

STALL = 10  # seconds without output of the child process, after which the file counts as damaged
START = 60  # seconds that the child process may take to start
_PROGRAM = os.path.abspath(Path(__file__).with_name("isolated.py"))
_PIPE = 2**20  # bytes of the buffer between the processes

Arrays = dict[str, tuple[np.ndarray, dict[str, Any]]]  # with the attributes of each


class _ChildEnded(Exception):
    """The child process has ended before its output was complete."""


def read_container(kind: str, path: Path, which: str) -> tuple[dict[str, Any], Arrays]:
    """Return the attributes and arrays of a file, as `rosafe.offline.isolated` sends them.

    Raises
    ------
    ValueError
        The file is damaged or not allowed, or the child process has sent nothing for `STALL` seconds.
    OSError
        The child process cannot be started.
    """
    modules = [os.path.abspath(folder) for folder in sys.path if folder]
    request = {"path": os.path.abspath(path), "kind": kind, "arrays": which, "modules": modules}
    command = [_python(), "-I", "-S", "-W", "ignore", _PROGRAM, json.dumps(request)]
    alone = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"}  # no plugins of HDF5
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd="/",
        env={**os.environ, **alone},
    ) as child:
        try:
            return _take(child)
        finally:
            child.kill()


def _python() -> str:
    """Return the path of the interpreter, also if Python is embedded in another program; OSError if none is found."""
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    folders = (sys.exec_prefix, sys.base_exec_prefix)
    for path in (sys.executable, *(os.path.join(folder, "bin", version) for folder in folders), shutil.which(version)):
        if path and re.fullmatch(r"python[0-9.]*[a-z]*", os.path.basename(path)) and os.access(path, os.X_OK):
            return path
    raise OSError(errno.ENOENT, f"found no program {version}, which is needed to read it; install it")


def _take(child: subprocess.Popen[bytes]) -> tuple[dict[str, Any], Arrays]:
    pipe = _Pipe(child)
    try:
        pipe.read(1, START)
    except (_ChildEnded, TimeoutError):
        raise OSError(errno.ENOEXEC, f"{_python()} cannot be started to read it: {pipe.end()}") from None
    try:
        head = json.loads(pipe.read(int.from_bytes(pipe.read(8), "little")))
        arrays = head["arrays"]
        refuse_over_available(sum(math.prod(one["shape"], start=8.0) for one in arrays), "its arrays", LESS)
        return head["attributes"], {one["name"]: (pipe.array(one), one["attributes"]) for one in arrays}
    except _ChildEnded:
        raise ValueError(pipe.end()) from None
    except TimeoutError:
        raise ValueError(f"nothing could be read for {STALL} s") from None


class _Pipe:
    """Standard output of a child process."""

    def __init__(self, child: subprocess.Popen[bytes]) -> None:
        assert child.stdout
        self._child = child
        self._descriptor = child.stdout.fileno()
        with contextlib.suppress(OSError):  # more than the system allows to one user
            fcntl.fcntl(self._descriptor, fcntl.F_SETPIPE_SZ, _PIPE)
        self._poll = select.poll()
        self._poll.register(self._descriptor, select.POLLIN)

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

    def array(self, described: dict[str, Any]) -> np.ndarray:
        """Return the next array."""
        shape, block, dtype = tuple(described["shape"]), tuple(described["block"]), np.dtype(described["dtype"])
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


def read_h5(path: Path, arrays: bool = True) -> dict[str, Any]:
    """Return the contents of an .h5; without `arrays`, only the metadata. ValueError if it is damaged."""
    attributes, found = read_container("h5", path, "all" if arrays else "none")
    return {**_numbers(found), **parse_metadata(attributes)}


def read_zarr(path: Path, arrays: bool = True) -> dict[str, Any]:
    """As `read_h5`, for a .zarr."""
    attributes, found = read_container("zarr", path, "all" if arrays else "none")
    return {**_numbers(found), **parse_metadata(attributes)}


def _numbers(arrays: Arrays) -> dict[str, Any]:
    return {name: value if value.ndim else float(value) for name, (value, _) in arrays.items()}


def read_mat73(path: Path, arrays: bool = True) -> dict[str, Any]:
    """As `read_h5`, for a version 7.3 .mat."""
    _, found = read_container("mat", path, "all" if arrays else "texts")
    texts = {name: _text(name, *one) for name, one in found.items() if one[1].get("MATLAB_class") == "char"}
    about = parse_metadata({**texts, **{name: one[0] for name, one in found.items() if is_scalar(name)}})
    axes = about.get("axes", {})
    result: dict[str, Any] = {}
    for name in found.keys() - about.keys():
        data, attributes = found[name]
        if "MATLAB_empty" in attributes:
            result[name] = _empty(name, data)
        else:
            result[name] = restored(np.ascontiguousarray(data.T), axes.get(name))
    return {**result, **about}


def _text(name: str, data: np.ndarray, attributes: dict[str, Any]) -> str:
    if "MATLAB_empty" in attributes:
        return ""
    if data.dtype.kind != "u":
        raise ValueError(f"{name}: expected the codes of characters")
    return data.astype("<u2").tobytes().decode("utf-16-le")


def _empty(name: str, shape: np.ndarray) -> np.ndarray:
    if not (0 < shape.size <= 32 and shape.dtype.kind == "u" and not shape.all()):
        raise ValueError(f"{name}: expected the shape of an empty array")
    return new_array(tuple(shape.ravel().tolist()), np.dtype(np.float64))
