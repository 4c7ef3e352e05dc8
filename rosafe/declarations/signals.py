"""The message that carries the arrays of a representation, and the content of each of its fields.

A message contains the number of frames and the lengths of the other axes, followed by the samples. An array with an ear
axis is sent in `left` and `right`, an array of both ears together in `left`. Three axes are sent with the second one
outermost: [lag][channel][frame]. A representation of several arrays has a message of its own, with a field for each.
"""

from __future__ import annotations

from typing import NamedTuple

from rosafe.declarations.representation import Part, Representation

Struct = tuple[tuple[str, str], ...]  # (member, IDL type)

SIGNALS: dict[str, Struct] = {
    "::rosAFE::signalOneD": (("data", "sequence<double>"),),
    "::rosAFE::signalND": (("dataN", "sequence<::rosAFE::signalOneD>"),),
    "::rosAFE::signalNxND": (("dataNxN", "sequence<::rosAFE::signalND>"),),
}
# The member at each level of nesting, outermost first
LEVELS = {
    "::rosAFE::signalOneD": ("data",),
    "::rosAFE::signalND": ("dataN", "data"),
    "::rosAFE::signalNxND": ("dataNxN", "dataN", "data"),
}
_BY_DIMENSIONS = dict(enumerate(SIGNALS, 1))
_HEAD = (
    ("sampleRate", "unsigned long"),
    ("lastFrameIndex", "unsigned long long"),
    ("framesOnPort", "unsigned long long"),
)
_COUNTS = {  # by axis, in the order of the fields
    "lag": ("numberOfLags", "unsigned long long"),
    "filter": ("numberOfFilters", "unsigned long"),
    "feature": ("numberOfChannels", "unsigned long"),
    "channel": ("numberOfChannels", "unsigned long"),
}


class Place(NamedTuple):
    """One field of samples in a message, and the array that it carries."""

    field: str
    part: int  # index of the part of the representation
    ear: int | None  # index of the ear; None for an array of both ears together
    present: bool = True  # False if the field is always empty, such as the right ear of ILD


class Layout(NamedTuple):
    """The message of a representation."""

    idl: str
    counts: tuple[tuple[str, int, int], ...]  # field, and the part and its axis whose length it holds
    places: tuple[Place, ...]
    members: Struct


def layout(representation: Representation) -> Layout:
    """Return the message for the output of `representation`. Raise ValueError if no message fits its axes."""
    parts = representation.parts
    largest = max(parts, key=lambda part: len(_rows(part)))
    rows = _rows(largest)
    if len(rows) > 2:
        raise ValueError(f"axes: expected at most two besides ear and time, got {', '.join(rows)}")
    kind = _message_name(parts[0])
    if len(parts) > 1:
        kind = representation.kind[:1].upper() + representation.kind[1:]
        for part in parts:
            if "ear" in part.axes:
                raise ValueError(
                    f"parts: {part.name!r} has the axis ear; a representation of several parts cannot have it, "
                    "so declare one representation for each part"
                )
    if len(rows) == 1:  # as in TimeFrequency, for rows of any kind
        counted = {"channel": 0}
    elif kind == "Modulation":
        counted = {"filter": 1, "channel": 0}
    else:
        counted = {"lag": 1, "channel": 0} if rows else {}
    counts = tuple((field, counted[axis], idl) for axis, (field, idl) in _COUNTS.items() if axis in counted)
    places = _places(parts, kind)
    fields = tuple((place.field, _BY_DIMENSIONS[1 + len(_rows(parts[place.part]))]) for place in places)
    return Layout(
        f"::rosAFE::{kind}SignalPortStruct",
        tuple((field, parts.index(largest), axis + ("ear" in largest.axes)) for field, axis, _ in counts),
        places,
        (*_HEAD, *((field, idl) for field, _, idl in counts), *fields),
    )


def _rows(part: Part) -> tuple[str, ...]:
    """Return the axes without ear and time."""
    return tuple(axis for axis in part.axes if axis not in ("ear", "time"))


def _message_name(part: Part) -> str:
    """Return the name of the message for a representation of one part."""
    rows = _rows(part)
    if len(rows) < 2:
        return ("TimeDomain", "TimeFrequency")[len(rows)]
    if rows[1] == "lag":
        return "AutoCorrelation" if "ear" in part.axes else "CrossCorrelation"
    return "Modulation"


def _places(parts: tuple[Part, ...], kind: str) -> tuple[Place, ...]:
    if len(parts) > 1:
        return tuple(Place(part.name, index, None) for index, part in enumerate(parts))
    if "ear" in parts[0].axes:
        return (Place("left", 0, 0), Place("right", 0, 1))
    if kind == "CrossCorrelation":
        return (Place("left", 0, None),)
    return (Place("left", 0, None), Place("right", 0, None, present=False))
