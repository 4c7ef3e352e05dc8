"""Kernels for another processor under qemu: tests/dsp/driver.c receives calls with their arrays and returns results."""

from __future__ import annotations

import ctypes
import functools
import platform
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from numpy.typing import NDArray

from rosafe.dsp import kernels
from rosafe.dsp.kernels import build, loader

INTEGER, REAL, ADDRESS, STRUCT = range(4)  # as in driver.c
MAX_PINNED = 100  # arrays of the stages in use


class Machine(NamedTuple):
    """Another processor."""

    compiler: str
    emulator: tuple[str, ...]
    kind: str
    level: int

    @property
    def missing_programs(self) -> list[str]:
        """Return the required programs that are not installed."""
        return [name for name in (self.compiler, self.emulator[0]) if shutil.which(name) is None]

    def library(self) -> Path:
        """Return its library; build it if necessary."""
        if self.kind == platform.machine():
            return build.libraries()[self.level]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(platform, "machine", lambda: self.kind)
            patch.setenv(build.COMPILER, self.compiler)
            return build.libraries(build.place() / "foreign")[self.level]


MACHINES = {
    "aarch64": Machine("aarch64-linux-gnu-gcc", ("qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"), "aarch64", 8),
    "nehalem": Machine("gcc", ("qemu-x86_64", "-cpu", "Nehalem"), "x86_64", 2),  # it has no AVX
}


_pinned: dict[int, kernels.PinnedArray] = {}  # by address


def pin(array: NDArray[Any]) -> kernels.PinnedArray:
    """Replace `kernels.PinnedArray.of`. The array is sent with each call that uses its address."""
    pinned = kernels.PinnedArray(array, array.ctypes.data)
    _pinned[pinned.address] = pinned
    if len(_pinned) > MAX_PINNED:
        del _pinned[next(iter(_pinned))]  # the oldest
    return pinned


class Foreign:
    """A library of kernels in another process, with the interface of `ctypes.CDLL`."""

    def __init__(self, machine: Machine) -> None:
        folder = Path(tempfile.mkdtemp(prefix="foreign-kernels."))
        try:
            driver, source = folder / "driver", Path(__file__).with_name("driver.c")
            subprocess.run([machine.compiler, "-O1", "-Wall", "-o", driver, source, "-ldl"], check=True)
            command = [*machine.emulator, str(driver), str(machine.library())]
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            self._arrays: list[NDArray[Any]] = []
            self.rosafe_processor_level()  # a response means that everything is loaded
        finally:
            shutil.rmtree(folder)

    def address(self, array: NDArray[Any]) -> int:
        """Replace `kernels._address`. The array is sent with the next call."""
        self._arrays.append(array)
        address: int = array.ctypes.data
        return address

    def __getattr__(self, name: str) -> Callable[..., int]:
        return functools.partial(self._call, name)

    def _call(self, name: str, *arguments: float | bytes | None) -> int:
        kinds = loader._ARGUMENTS.get(name, ())
        named = set(_addresses(kinds, arguments))
        own = [_span(pinned.array) for pinned in _pinned.values()]
        own = [(low, high) for low, high in own if any(low <= address <= high for address in named)]
        spans = _joined([*map(_span, self._arrays), *own])
        message = [struct.pack("q", len(spans))]
        for low, high in spans:
            message += [struct.pack("q", high - low), ctypes.string_at(low, high - low)]
        message.append(struct.pack("64sq", name.encode(), len(arguments)))
        for kind, value in zip(kinds, arguments, strict=True):
            message.append(_argument(kind, value, spans))
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(b"".join(message))
        self._process.stdin.flush()
        size = 8 + sum(high - low for low, high in spans)
        answer = self._process.stdout.read(size)
        assert len(answer) == size, f"{name} has died with status {self._process.wait()}"
        at = 8
        for low, high in spans:
            ctypes.memmove(low, answer[at : at + high - low], high - low)
            at += high - low
        self._arrays.clear()
        return int(struct.unpack_from("q", answer)[0])

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        assert self._process.wait() == 0
        self._process.stdout.close()


def _span(array: NDArray[Any]) -> tuple[int, int]:
    """Return the range of addresses of an array, as `byte_bounds`, which is in different places in numpy 1 and 2."""
    if array.size == 0:
        return array.ctypes.data, array.ctypes.data
    extents = [(size - 1) * stride for size, stride in zip(array.shape, array.strides, strict=True)]
    low = array.ctypes.data + sum(extent for extent in extents if extent < 0)
    return low, low + sum(map(abs, extents)) + array.itemsize


def _joined(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Merge overlapping and adjacent ranges of addresses, which are views of one array."""
    joined: list[tuple[int, int]] = []
    for low, high in sorted(spans):
        if joined and low <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(high, joined[-1][1]))
        else:
            joined.append((low, high))
    return joined


def _addresses(kinds: Sequence[Any], values: Sequence[Any]) -> Iterator[int]:
    for kind, value in zip(kinds, values, strict=True):
        if kind is ctypes.c_char_p:
            yield from _addresses(*_members(value))
        elif kind is ctypes.c_void_p and value:
            yield value


def _members(packed: bytes) -> tuple[Sequence[Any], Sequence[int]]:
    """Return the types and values of a struct argument."""
    kinds = {"P": ctypes.c_void_p, "q": ctypes.c_int64}
    form = loader.FRAMES if len(packed) == struct.calcsize(loader.FRAMES) else loader.CUES
    return [kinds[letter] for letter in form], struct.unpack(form, packed)


def _argument(kind: Any, value: Any, spans: list[tuple[int, int]]) -> bytes:
    if kind is ctypes.c_char_p:
        members = [_argument(*member, spans) for member in zip(*_members(value), strict=True)]
        return b"".join([struct.pack("qqq", STRUCT, len(members), 0), *members])
    if kind is ctypes.c_double:
        return struct.pack("qdq", REAL, value, 0)
    if kind is not ctypes.c_void_p or not value:
        return struct.pack("qqq", INTEGER, int(value or 0), 0)
    for number, (low, high) in enumerate(spans):
        if low <= value <= high:
            return struct.pack("qqq", ADDRESS, number, int(value) - low)
    raise AssertionError("an address of no array that was asked for its own")


_running: dict[str, Foreign] = {}


def running(name: str) -> Foreign:
    """Return one of `MACHINES`, started at the first call; skip the test if its tools are not installed."""
    machine = MACHINES[name]
    if machine.missing_programs:
        pytest.skip(f"no {' and no '.join(machine.missing_programs)} here: scripts/install --tests brings them")
    if machine.kind == "x86_64" != platform.machine():
        pytest.skip("for x86-64")
    if name not in _running:
        _running[name] = Foreign(machine)
    return _running[name]


def close_all() -> None:
    """End all running processes."""
    while _running:
        _running.popitem()[1].close()
