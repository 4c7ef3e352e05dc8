"""How the arrays of a representation travel: which message, and what stands in each of its fields.

A message says how many frames there are, and how many of everything else; then come the samples. An array of both ears
goes into `left` and `right`, one of both ears together into `left`. Three axes travel with the second one outermost:
[lag][channel][frame]. A representation of several arrays has a message of its own, with a field for each.
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
# The member at each level of nesting, from the outermost in.
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
    """One field of samples in a message: where it is from."""

    field: str
    part: int  # which of the representation's parts
    ear: int | None  # which one of its ears; None for an array of both together
    present: bool = True  # else it is always empty, as the right ear of ILD


class Layout(NamedTuple):
    """The message of a representation."""

    idl: str
    counts: tuple[tuple[str, int, int], ...]  # field, part and axis of it that it counts
    places: tuple[Place, ...]
    members: Struct


def _rows(part: Part) -> tuple[str, ...]:
    """The axes less ear and time."""
    return tuple(axis for axis in part.axes if axis not in ("ear", "time"))


def _type(kind: str, part: Part, single: bool) -> str:
    if not single:
        return kind[:1].upper() + kind[1:]
    rows = _rows(part)
    if len(rows) < 2:
        return ("TimeDomain", "TimeFrequency")[len(rows)]
    if rows[1] == "lag":
        return "AutoCorrelation" if "ear" in part.axes else "CrossCorrelation"
    return "Modulation"


def layout(representation: Representation) -> Layout:
    """How what `representation` puts out travels. Raises ValueError if no message has room for its axes."""
    parts, single = representation.parts, len(representation.parts) == 1
    kind = _type(representation.kind, parts[0], single)
    largest = max(parts, key=lambda part: len(_rows(part)))
    rows = _rows(largest)
    if len(rows) > 2:
        raise ValueError(f"axes: expected at most two besides ear and time, got {', '.join(rows)}")
    for part in () if single else parts:
        if "ear" in part.axes:
            raise ValueError(
                f"parts: {part.name!r} has the axis ear; a representation of several parts cannot have it, "
                "so declare one representation for each part"
            )
    if len(rows) == 1:  # of TimeFrequency, whatever the rows are
        counted = {"channel": 0}
    elif kind == "Modulation":
        counted = {"filter": 1, "channel": 0}
    else:
        counted = {"lag": 1, "channel": 0} if rows else {}
    counts = tuple((field, counted[axis], idl) for axis, (field, idl) in _COUNTS.items() if axis in counted)
    if not single:
        places = tuple(Place(part.name, index, None) for index, part in enumerate(parts))
    elif "ear" in parts[0].axes:
        places = (Place("left", 0, 0), Place("right", 0, 1))
    else:
        places = (Place("left", 0, None), Place("right", 0, None, present=False))
        if kind == "CrossCorrelation":
            places = places[:1]
    fields = tuple((place.field, _BY_DIMENSIONS[1 + len(_rows(parts[place.part]))]) for place in places)
    return Layout(
        f"::rosAFE::{kind}SignalPortStruct",
        tuple((field, parts.index(largest), axis + ("ear" in largest.axes)) for field, axis, _ in counts),
        places,
        (*_HEAD, *((field, idl) for field, _, idl in counts), *fields),
    )
