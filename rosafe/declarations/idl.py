"""The scalar types of the interface: name on the ROS graph, binary format and range."""

from __future__ import annotations

from typing import NamedTuple


class Scalar(NamedTuple):
    """One IDL type. `code` is its format in the struct module; `bounds` is the inclusive range of a whole number."""

    ros: str
    code: str = ""
    bounds: tuple[int, int] | None = None


def _whole(ros: str, code: str, bits: int, signed: bool) -> Scalar:
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    return Scalar(ros, code, (low, high))


SCALARS = {
    "boolean": Scalar("bool", "?"),
    "unsigned short": _whole("uint16", "H", 16, signed=False),
    "short": _whole("int16", "h", 16, signed=True),
    "unsigned long": _whole("uint32", "I", 32, signed=False),
    "long": _whole("int32", "i", 32, signed=True),
    "unsigned long long": _whole("uint64", "Q", 64, signed=False),
    "long long": _whole("int64", "q", 64, signed=True),
    "float": Scalar("float32", "f"),
    "double": Scalar("float64", "d"),
    "char": _whole("int8", "b", 8, signed=True),
    "octet": _whole("uint8", "B", 8, signed=False),
    "string": Scalar("string"),
}


def element(idl: str) -> str:
    """Return the type of the elements of a sequence; empty if `idl` is not a sequence."""
    return idl[len("sequence<") : -1] if idl.startswith("sequence<") else ""


TIME = "::ros::time"  # the only struct for which ROS has a type of its own
TIME_MEMBERS = (("sec", "unsigned long"), ("nsec", "unsigned long"))


def ros_type(idl: str) -> str:
    """Return the ROS type of an IDL type: ``unsigned long`` is ``uint32``, ``sequence<double>`` is ``float64[]``."""
    if idl == TIME:
        return "time"
    if of := element(idl):
        return ros_type(of) + "[]"
    if idl.startswith("::"):
        return idl[2:].replace("::", "_")
    return SCALARS[idl].ros
