"""Fast serialisation: the ROS wire format of every struct of the interface table, from and to numpy without lists.

`message_class` makes a subclass of a generated message class with the same type name, md5 and bytes on the wire,
whose sample arrays are numpy arrays. Publishers give it arrays (or the pieces of a sliding window); subscribers get
read-only views of the received buffer. Users of the package name the generated class instead (`array_msg`, see
docs/subscribers.md).

In such a message `left` and `right` are arrays of shape (frames,), (channels, frames) or (lags, channels, frames)
instead of the nested `data`, `dataN` and `dataNxN` lists of the generated class. Structs within it are dicts whose
members are attributes too (`message.stamp.sec`).
"""

from __future__ import annotations

import functools
import importlib
import struct
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import genpy
import numpy as np

from rosafe import interface
from rosafe.component import generate
from rosafe.declarations.idl import SCALARS
from rosafe.declarations.signals import LEVELS
from rosafe.tree.sliding_window import WindowView

_SCALARS = {idl: scalar.code for idl, scalar in SCALARS.items() if scalar.code}
_SAMPLES: dict[str, np.dtype[Any]] = {idl: np.dtype(f"<{_SCALARS[idl]}") for idl in ("double", "long", "float")}
# How many levels of nested sequences a signal struct wraps; its one member is the sequence.
_SIGNALS = {idl: len(levels) for idl, levels in LEVELS.items()}
_COUNT = struct.Struct("<I")
_MAX_RECORD = 2**31 - 1  # bytes; numpy's layouts go no further
ROW_BYTES = 4096  # rows of a window in pieces shorter than this are copied together: quicker than handling each


class ByteSink(Protocol):
    """Where messages are written to: a BytesIO, or `BufferList`."""

    def write(self, data: Any, /) -> Any:
        """Append the bytes of a buffer."""


# --- writing ----------------------------------------------------------------------------------------------------


def nested_dtype(shape: tuple[int, ...]) -> np.dtype:
    """The wire layout of a signal of regular `shape`: at every level a uint32 count, then the elements."""
    layout = _SAMPLES["double"]
    for length in reversed(shape):
        layout = np.dtype([("n", "<u4"), ("d", layout, (length,))])
    return layout


def _pack_nested(view: WindowView) -> memoryview:
    """The bytes of a signal of shape (..., frames), each level preceded by its count."""
    record = np.empty((), nested_dtype(view.shape))
    level = record
    for length in view.shape:
        level["n"] = length
        level = level["d"]
    view.copy_to(level)
    return record.reshape(1).view(np.uint8).data


def _write_rows(out: ByteSink, pieces: Sequence[np.ndarray], frames: int) -> None:
    """As `_pack_nested`, of arrays (..., n) that together make `frames`: row by row as they lie, without a copy."""
    if pieces[0].ndim == 1:
        out.write(_COUNT.pack(frames))
        for piece in pieces:
            out.write(np.ascontiguousarray(piece, _SAMPLES["double"]))
    else:
        out.write(_COUNT.pack(len(pieces[0])))
        for rows in zip(*pieces, strict=True):
            _write_rows(out, rows, frames)


def _write_signal(out: ByteSink, levels: int, value: Any) -> None:
    if isinstance(value, genpy.Message):  # of the generated class, as in a message that was made without it
        value.serialize(out)
        return
    view = value if isinstance(value, WindowView) else WindowView.of(np.asarray(value, dtype=np.float64))
    if view.shape == (0,) and levels > 1:  # an absent signal, such as ILD's `right`
        out.write(_COUNT.pack(0))
        return
    if len(view.shape) != levels:
        raise ValueError(f"a signal of shape {view.shape} where {levels} dimensions are wanted")
    pieces = view.trimmed()
    if 8 * view.frames >= ROW_BYTES * len(pieces):
        _write_rows(out, pieces, view.frames)
    else:
        out.write(_pack_nested(view))


def _samples(value: Any, dtype: np.dtype) -> np.ndarray:
    """A sequence of numbers as an array, without silent rounding or wrapping."""
    array = np.asarray(value)
    if array.ndim != 1:
        raise ValueError(f"an array of shape {array.shape} where a sequence is wanted")
    if array.dtype == dtype or array.size == 0:
        return np.ascontiguousarray(array, dtype)
    converted = array.astype(dtype, casting="same_kind")
    if dtype.kind == "i" and not np.array_equal(converted, array):
        raise ValueError(f"numbers beyond {dtype}")
    return converted


def _member(value: Any, name: str) -> Any:
    return value[name] if isinstance(value, dict) else getattr(value, name)


def encode(out: ByteSink, component: interface.ComponentSpec, idl: str, value: Any) -> None:
    """Append `value` (a message, or a dict by member name) of IDL type `idl` to `out`."""
    if idl in _SCALARS:
        out.write(struct.pack("<" + _SCALARS[idl], value))
    elif idl == "string":
        text = value.encode() if isinstance(value, str) else value
        out.write(_COUNT.pack(len(text)))
        out.write(text)
    elif idl in _SIGNALS:
        _write_signal(out, _SIGNALS[idl], value)
    elif idl.startswith("sequence<"):
        element = idl[len("sequence<") : -1]
        if element in _SAMPLES:
            value = _samples(value, _SAMPLES[element])
        out.write(_COUNT.pack(len(value)))
        if element in _SAMPLES:
            out.write(value.view(np.uint8).data)
        else:
            for item in value:
                encode(out, component, element, item)
    else:
        for name, kind in component.members(idl):
            encode(out, component, kind, _member(value, name))


# --- reading ----------------------------------------------------------------------------------------------------


class _Reader:
    """A cursor over one received message; every read is checked against the end of the buffer."""

    def __init__(self, data: bytes) -> None:
        self.data = memoryview(data)
        self.at = 0

    def take(self, size: int) -> memoryview:
        if size < 0 or self.at + size > len(self.data):
            raise genpy.DeserializationError(f"message ends at {len(self.data)} bytes, {self.at + size} are needed")
        piece = self.data[self.at : self.at + size]
        self.at += size
        return piece

    def count(self) -> int:
        return int(_COUNT.unpack(self.take(4))[0])

    def samples(self, dtype: np.dtype) -> np.ndarray:
        return np.frombuffer(self.take(self.count() * dtype.itemsize), dtype)


def _read_signal(reader: _Reader, levels: int) -> np.ndarray | list[Any]:
    """A regular nested sequence as one strided view; a ragged one (no sender of ours makes it) as lists of arrays."""
    start = reader.at
    shape = [reader.count()]
    while len(shape) < levels:
        shape.append(reader.count() if shape[-1] else 0)
    reader.at = start
    size = 8
    for length in reversed(shape):
        size = 4 + length * size
    if size <= min(len(reader.data) - start, _MAX_RECORD):
        level = np.frombuffer(reader.take(size), nested_dtype(tuple(shape)))
        regular = True
        for length in shape:
            regular = regular and bool(np.all(level["n"] == length))
            level = level["d"]
        if regular:
            return np.asarray(level[0])
        reader.at = start
    return _read_ragged(reader, levels)  # raises where it passes the end


def _read_ragged(reader: _Reader, levels: int) -> np.ndarray | list[Any]:
    if levels == 1:
        return reader.samples(_SAMPLES["double"])
    return [_read_ragged(reader, levels - 1) for _ in range(reader.count())]


class AttrDict(dict):
    """A struct within a message: its members by name, and as attributes."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(name) from None


def decode(reader: _Reader, component: interface.ComponentSpec, idl: str) -> Any:
    """The next value of IDL type `idl`: structs as `AttrDict`, signals and numeric sequences as read-only arrays."""
    if idl in _SCALARS:
        form = "<" + _SCALARS[idl]
        return struct.unpack(form, reader.take(struct.calcsize(form)))[0]
    if idl == "string":
        return str(reader.take(reader.count()), "utf-8", "replace")
    if idl in _SIGNALS:
        return _read_signal(reader, _SIGNALS[idl])
    if idl.startswith("sequence<"):
        element = idl[len("sequence<") : -1]
        if element in _SAMPLES:
            return reader.samples(_SAMPLES[element])
        return [decode(reader, component, element) for _ in range(reader.count())]
    return AttrDict((name, decode(reader, component, kind)) for name, kind in component.members(idl))


# --- message classes --------------------------------------------------------------------------------------------


def _codec(
    component: interface.ComponentSpec, members: tuple[tuple[str, str], ...]
) -> tuple[Callable[[Any, ByteSink], None], Callable[[Any, bytes], Any]]:
    def serialize(self: Any, out: ByteSink) -> None:
        try:
            for name, kind in members:
                encode(out, component, kind, getattr(self, name))
        except (struct.error, TypeError, ValueError, LookupError, AttributeError) as problem:
            raise genpy.SerializationError(f"{self._type}: {name}: {problem}") from problem

    def deserialize(self: Any, data: bytes) -> Any:
        reader = _Reader(data)
        for name, kind in members:
            setattr(self, name, decode(reader, component, kind))
        return self

    return serialize, deserialize


@functools.cache
def message_class(package: str, idl: str) -> Any:
    """The message class of struct `idl` in ROS package `package` (`rosAFE` or `bass`), with arrays instead of lists."""
    generate.ensure_messages()
    component = interface.COMPONENTS[package]
    generated = getattr(importlib.import_module(f"{package}.msg"), interface.ros_type(idl))
    serialize, deserialize = _codec(component, component.members(idl))
    return type(generated.__name__, (generated,), {"serialize": serialize, "deserialize": deserialize})


def array_msg(generated: Any) -> Any:
    """The class to subscribe or publish with in place of a generated one: same type and md5, arrays instead of lists.

    Parameters
    ----------
    generated : type
        A class of `rosAFE.msg` or `bass.msg` that holds samples, such as `rosAFE_TimeFrequencySignalPortStruct`.

    Raises
    ------
    TypeError
        For anything else.
    """
    package, _, name = str(getattr(generated, "_type", "")).partition("/")
    if package in interface.COMPONENTS:
        for idl in interface.COMPONENTS[package].structs:
            if interface.ros_type(idl) == name:
                found = message_class(package, idl)
                if found._md5sum == generated._md5sum:
                    return found
    raise TypeError(f"{generated!r} is no message class of rosAFE or bass that holds samples")


@functools.cache
def tolerant_message_class(package: str, idl: str, longest: int = 0) -> Any:
    """As `message_class`, but what cannot be read becomes a message whose `problem` says why (else it is empty).

    Where deserialisation raises, rospy breaks the connection, and cannot mend it: one bad message would end a topic.
    Its sequences have up to `longest` elements, if that is given; a message that could hold more is not even read.
    """
    strict = message_class(package, idl)

    def deserialize(self: Any, data: bytes) -> Any:
        try:
            strict.deserialize(self, data)
            self.problem = ""
        except genpy.DeserializationError as problem:
            self.problem = str(problem)
        return self

    bound = {"longest_sequence": longest} if longest else {}
    return type(strict.__name__, (strict,), {"deserialize": deserialize, **bound})


@functools.cache
def response_class(package: str, service: str) -> Any:
    """The response class of a service whose outputs hold signals (getSignals), with arrays instead of lists."""
    generate.ensure_messages()
    component = interface.COMPONENTS[package]
    generated = getattr(importlib.import_module(f"{package}.srv"), f"{service}Response")
    members = (("genom_success", "boolean"), ("genom_exdetail", "string"), *component.service(service).outputs)
    serialize, deserialize = _codec(component, members)
    return type(generated.__name__, (generated,), {"serialize": serialize, "deserialize": deserialize})


def array_srv(generated: Any) -> Any:
    """The service class to call in place of a generated one whose response holds signals, such as `getSignals`.

    Raises
    ------
    TypeError
        For anything that is no service class of rosAFE or bass.
    """
    package, _, name = str(getattr(generated, "_type", "")).partition("/")
    if not hasattr(generated, "_response_class") or package not in interface.COMPONENTS:
        raise TypeError(f"{generated!r} is no service class of rosAFE or bass")
    return type(generated.__name__, (generated,), {"_response_class": response_class(package, name)})
