"""Fast serialization: the ROS wire format of every struct of the interface table, from and to numpy without lists.

`message_class` returns a subclass of a generated message class with the same type name, md5 and bytes on the wire,
whose samples are numpy arrays. Publishers assign arrays (or the pieces of a sliding window); subscribers get read-only
views of the received buffer. Users of the package pass the generated class to `array_msg` (docs/subscribers.md).

In such a message `left` and `right` are arrays of shape (frames,), (channels, frames) or (lags, channels, frames)
instead of the nested `data`, `dataN` and `dataNxN` lists of the generated class. Structs within it are dicts whose
members are attributes too (`message.stamp.sec`).
"""

from __future__ import annotations

import functools
import importlib
import itertools
import struct
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any, NamedTuple, Protocol

import genpy
import numpy as np

from rosafe import interface
from rosafe.declarations.idl import SCALARS, element
from rosafe.declarations.signals import LEVELS
from rosafe.ros1.component import generate
from rosafe.tree.history import WindowView

Members = tuple[tuple[str, str], ...]  # name and IDL type of each member of a struct

_SCALARS = {idl: scalar.code for idl, scalar in SCALARS.items() if scalar.code}
_SAMPLES: dict[str, np.dtype[Any]] = {idl: np.dtype(f"<{_SCALARS[idl]}") for idl in ("double", "long", "float")}
# The number of nested sequences in each signal struct, whose only member is the outer sequence.
_SIGNALS = {idl: len(levels) for idl, levels in LEVELS.items()}
_COUNT = struct.Struct("<I")
_MAX_RECORD = 2**31 - 1  # bytes; the limit of numpy's layouts
MAX_KEPT_BYTES = 2**18  # of the bytes of a window that are kept with it
MAX_TEMPLATE_BYTES = 2**16  # of a template that is kept
ROW_BYTES = 4096  # shorter rows of the pieces of a window are copied together, which is faster than one by one


class ByteSink(Protocol):
    """The destination of a message: a BytesIO, or a `BufferList`."""

    def write(self, data: Any, /) -> Any:
        """Append the bytes of a buffer."""


# --- writing ----------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=256)  # messages of a port have few shapes, and numpy takes longer than for the samples
def nested_dtype(shape: tuple[int, ...]) -> np.dtype:
    """Return the wire layout of a signal of regular `shape`: at every level a uint32 count, then the elements."""
    layout = _SAMPLES["double"]
    for length in reversed(shape):
        layout = np.dtype([("n", "<u4"), ("d", layout, (length,))])
    return layout


class _Template(NamedTuple):
    """The bytes of a signal of one shape, with its counts and without its samples, and the layout of the samples."""

    record: np.ndarray  # uint8
    offset: int  # bytes
    strides: tuple[int, ...]  # bytes


def _new_template(shape: tuple[int, ...]) -> _Template:
    record = np.zeros((), nested_dtype(shape))
    level = record
    for length in shape:
        level["n"] = length
        level = level["d"]
    offset = level.__array_interface__["data"][0] - record.__array_interface__["data"][0]
    return _Template(record.reshape(1).view(np.uint8), offset, level.strides)


_template = functools.lru_cache(maxsize=64)(_new_template)


def _pack_nested(view: WindowView) -> memoryview:
    """Return the bytes of a signal of shape (..., frames), each level preceded by its count."""
    shape = view.shape
    if nested_dtype(shape).itemsize <= MAX_TEMPLATE_BYTES:
        template = _template(shape)
        record = template.record.copy()
    else:
        template = _new_template(shape)
        record = template.record
    if 0 in shape:  # counts alone
        return record.data
    view.copy_to(np.ndarray(shape, _SAMPLES["double"], record.data, template.offset, template.strides))
    return record.data


def _write_rows(out: ByteSink, pieces: Sequence[np.ndarray], frames: int) -> None:
    """As `_pack_nested`, for arrays (..., n) with `frames` frames in total: row by row, without a copy."""
    if pieces[0].ndim == 1:
        out.write(_COUNT.pack(frames))
        for piece in pieces:
            out.write(np.ascontiguousarray(piece, _SAMPLES["double"]))
    else:
        out.write(_COUNT.pack(len(pieces[0])))
        for rows in zip(*pieces, strict=True):
            _write_rows(out, rows, frames)


def _write_signal(out: ByteSink, value: Any, levels: int) -> None:
    if isinstance(value, genpy.Message):  # of the generated class, in a message that was created with it
        value.serialize(out)
        return
    view = value if isinstance(value, WindowView) else WindowView((np.asarray(value, dtype=np.float64),))
    if view.shape == (0,) and levels > 1:  # an absent signal, such as ILD's `right`
        out.write(_COUNT.pack(0))
        return
    if len(view.shape) != levels:
        raise ValueError(f"expected a signal of {levels} dimensions, got shape {view.shape}")
    pieces = view.trimmed()
    if 8 * view.frames >= ROW_BYTES * len(pieces):
        _write_rows(out, pieces, view.frames)
        return
    packed = view.derived.get("packed")  # a port sends the same window again if a block completes no frame
    if packed is None:
        packed = _pack_nested(view)
        if len(packed) <= MAX_KEPT_BYTES:
            view.derived["packed"] = packed
    out.write(packed)


def _samples(value: Any, dtype: np.dtype) -> np.ndarray:
    """Convert a sequence of numbers to an array, without silent rounding or wrapping."""
    array = np.asarray(value)
    if array.ndim != 1:
        raise ValueError(f"expected a sequence, got an array of shape {array.shape}")
    if array.dtype == dtype or array.size == 0:
        return np.ascontiguousarray(array, dtype)
    converted = array.astype(dtype, casting="same_kind")
    if dtype.kind == "i" and not np.array_equal(converted, array):
        raise ValueError(f"expected numbers in the range of {dtype}")
    return converted


def _member(value: Any, name: str) -> Any:
    return value[name] if isinstance(value, dict) else getattr(value, name)


Encoder = Callable[[ByteSink, Any], None]  # appends a value to a message


def _encoder(component: interface.ComponentSpec, idl: str) -> Encoder:
    """Return the encoder of IDL type `idl`; a struct is a message, or a dict by member name."""
    if idl in _SCALARS:
        pack = struct.Struct("<" + _SCALARS[idl]).pack
        return lambda out, value: out.write(pack(value))
    if idl == "string":
        return _write_string
    if idl in _SIGNALS:
        return functools.partial(_write_signal, levels=_SIGNALS[idl])
    if idl.startswith("sequence<"):
        kind = element(idl)
        if kind in _SAMPLES:
            return functools.partial(_write_samples, dtype=_SAMPLES[kind])
        return functools.partial(_write_sequence, encode=_encoder(component, kind))
    members = [(name, _encoder(component, kind)) for name, kind in component.members(idl)]

    def write(out: ByteSink, value: Any) -> None:
        for name, encode in members:
            encode(out, _member(value, name))

    return write


def _write_string(out: ByteSink, value: str | bytes) -> None:
    text = value.encode() if isinstance(value, str) else value
    out.write(_COUNT.pack(len(text)))
    out.write(text)


def _write_samples(out: ByteSink, value: Any, dtype: np.dtype) -> None:
    array = _samples(value, dtype)
    out.write(_COUNT.pack(len(array)))
    out.write(array.view(np.uint8).data)


def _write_sequence(out: ByteSink, value: Sequence[Any], encode: Encoder) -> None:
    out.write(_COUNT.pack(len(value)))
    for item in value:
        encode(out, item)


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
    """Return a regular nested sequence as one strided view; a ragged one, which we never send, as lists of arrays."""
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
            regular = regular and bool((level["n"] == length).all())
            level = level["d"]
        if regular:
            return np.asarray(level[0])
        reader.at = start
    return _read_ragged(reader, levels)  # raises if it exceeds the buffer


def _read_ragged(reader: _Reader, levels: int) -> np.ndarray | list[Any]:
    if levels == 1:
        return reader.samples(_SAMPLES["double"])
    return [_read_ragged(reader, levels - 1) for _ in range(reader.count())]


class AttrDict(dict):
    """A struct in a message: its members by key, and as attributes."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(name) from None


Decoder = Callable[[_Reader], Any]  # returns the next value of a message


def _decoder(component: interface.ComponentSpec, idl: str) -> Decoder:
    """Return the decoder of IDL type `idl`: structs as `AttrDict`, signals and numbers as read-only arrays."""
    if idl in _SCALARS:
        form = struct.Struct("<" + _SCALARS[idl])
        return lambda reader: form.unpack(reader.take(form.size))[0]
    if idl == "string":
        return lambda reader: str(reader.take(reader.count()), "utf-8", "replace")
    if idl in _SIGNALS:
        return functools.partial(_read_signal, levels=_SIGNALS[idl])
    if idl.startswith("sequence<"):
        kind = element(idl)
        if kind in _SAMPLES:
            return functools.partial(_Reader.samples, dtype=_SAMPLES[kind])
        decode = _decoder(component, kind)
        return lambda reader: [decode(reader) for _ in range(reader.count())]
    return _members_decoder(component, component.members(idl))


def _members_decoder(component: interface.ComponentSpec, members: Members) -> Callable[[_Reader], AttrDict]:
    """Return the decoder of a struct. Successive scalars are read together."""
    steps: list[tuple[list[str], struct.Struct | Decoder]] = []
    for scalar, some in itertools.groupby(members, lambda member: member[1] in _SCALARS):
        if scalar:
            run = list(some)
            form = struct.Struct("<" + "".join(_SCALARS[kind] for _, kind in run))
            steps.append(([name for name, _ in run], form))
        else:
            steps += [([name], _decoder(component, kind)) for name, kind in some]

    def read(reader: _Reader) -> AttrDict:
        values = AttrDict()
        for names, step in steps:
            if isinstance(step, struct.Struct):
                values.update(zip(names, step.unpack(reader.take(step.size)), strict=True))
            else:
                values[names[0]] = step(reader)
        return values

    return read


# --- message classes --------------------------------------------------------------------------------------------


class _MessagePart(NamedTuple):
    """A member of a message, or several successive ones."""

    names: str
    get: Callable[[Any], Any]  # returns its value, or a tuple of several
    encode: Encoder


def _parts_of_message(component: interface.ComponentSpec, members: Members) -> list[_MessagePart]:
    """Return the members of a message. Successive scalars are written together."""
    parts: list[_MessagePart] = []
    for scalar, some in itertools.groupby(members, lambda member: member[1] in _SCALARS):
        run = list(some)
        if scalar and len(run) > 1:
            names, kinds = zip(*run, strict=True)
            form = struct.Struct("<" + "".join(_SCALARS[kind] for kind in kinds))
            parts.append(_MessagePart(", ".join(names), attrgetter(*names), functools.partial(_write_scalars, form)))
        else:
            parts += [_MessagePart(name, attrgetter(name), _encoder(component, kind)) for name, kind in run]
    return parts


def _write_scalars(form: struct.Struct, out: ByteSink, values: tuple[Any, ...]) -> None:
    out.write(form.pack(*values))


def _with_arrays(component: interface.ComponentSpec, generated: type[Any], members: Members) -> type[Any]:
    """Return a subclass of a generated class that serializes arrays."""
    parts = _parts_of_message(component, members)
    decode = _members_decoder(component, members)
    names = {name for name, _ in members}

    def create(self: Any, *values: Any, **fields: Any) -> None:
        if values or fields.keys() != names or any(value is None for value in fields.values()):
            generated.__init__(self, *values, **fields)
            return
        for name, value in fields.items():  # without defaults, whose creation takes longer
            setattr(self, name, value)

    def serialize(self: Any, out: ByteSink) -> None:
        try:
            for part in parts:
                part.encode(out, part.get(self))
        except (struct.error, TypeError, ValueError, LookupError, AttributeError) as problem:
            raise genpy.SerializationError(f"{self._type}: {part.names}: {problem}") from problem

    def deserialize(self: Any, data: bytes) -> Any:
        for name, value in decode(_Reader(data)).items():
            setattr(self, name, value)
        return self

    methods = {"__init__": create, "serialize": serialize, "deserialize": deserialize}
    return type(generated.__name__, (generated,), {**methods, "accepts_buffers": True})


def _generated(package: str, module: str, name: str) -> Any:
    generate.ensure_messages()
    return getattr(importlib.import_module(f"{package}.{module}"), name)


@functools.cache
def message_class(package: str, idl: str) -> Any:
    """Return the message class of struct `idl` in ROS package `package` (`rosAFE` or `bass`), with arrays."""
    component = interface.COMPONENTS[package]
    return _with_arrays(component, _generated(package, "msg", interface.ros_type(idl)), component.members(idl))


def array_msg(generated: Any) -> Any:
    """Return a message class with arrays instead of lists, and the type and md5 of a generated class.

    Parameters
    ----------
    generated : type
        A class of `rosAFE.msg` or `bass.msg` with samples, such as `rosAFE_TimeFrequencySignalPortStruct`.

    Raises
    ------
    TypeError
        If `generated` is another object.
    """
    package, _, name = str(getattr(generated, "_type", "")).partition("/")
    if package in interface.COMPONENTS:
        for idl in interface.COMPONENTS[package].structs:
            if interface.ros_type(idl) == name:
                found = message_class(package, idl)
                if found._md5sum == generated._md5sum:
                    return found
    raise TypeError(f"generated: expected a message class of rosAFE or bass with samples, got {generated!r}")


@functools.cache
def tolerant_message_class(package: str, idl: str, longest: int = 0) -> Any:
    """As `message_class`, but a malformed message is delivered with the reason in `problem`, which is otherwise empty.

    If deserialization raises, rospy closes the connection and cannot reopen it: one bad message would end a topic.
    Sequences have up to `longest` elements, if given; a message that could contain more is not read at all.
    """
    strict = message_class(package, idl)

    def deserialize(self: Any, data: bytes) -> Any:
        try:
            strict.deserialize(self, data)
            self.problem = ""
        except genpy.DeserializationError as problem:
            self.problem = str(problem)
        return self

    def create(self: Any) -> None:
        """Set no defaults: every message is deserialized next."""

    bound = {"longest_sequence": longest} if longest else {}
    return type(strict.__name__, (strict,), {"__init__": create, "deserialize": deserialize, **bound})


@functools.cache
def response_class(package: str, service: str) -> Any:
    """Return the response class of a service whose outputs contain signals (getSignals), with arrays."""
    component = interface.COMPONENTS[package]
    members = (("genom_success", "boolean"), ("genom_exdetail", "string"), *component.service(service).outputs)
    return _with_arrays(component, _generated(package, "srv", f"{service}Response"), members)


def array_srv(generated: Any) -> Any:
    """Return a service class like a generated one, such as `getSignals`, with arrays in its response.

    Raises
    ------
    TypeError
        If `generated` is not a service class of rosAFE or bass.
    """
    package, _, name = str(getattr(generated, "_type", "")).partition("/")
    if not hasattr(generated, "_response_class") or package not in interface.COMPONENTS:
        raise TypeError(f"generated: expected a service class of rosAFE or bass, got {generated!r}")
    return type(generated.__name__, (generated,), {"_response_class": response_class(package, name)})
