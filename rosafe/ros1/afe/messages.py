"""Output and parameters of processors as messages: of ports, the original's services, and services for all kinds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rosafe.declarations import ros_names
from rosafe.interface import CORE_REPRESENTATIONS, LAYOUTS, format_value, ros_type
from rosafe.interface.rosafe import parameter_struct
from rosafe.ros1.component import serialization
from rosafe.tree.history import WindowView
from rosafe.tree.processor import Processor

_EMPTY = WindowView([np.zeros(0)])  # for fields that a kind does not use, such as ILD's `right`


def signal_fields(kind: str, views: Sequence[WindowView], next_index: int, rate: float) -> dict[str, Any]:
    """Return the fields of a port message, or of an element of getSignals, for the output of a processor of `kind`.

    The frame rate in the message is the rounded true rate.
    """
    layout = LAYOUTS[kind]
    fields: dict[str, Any] = {
        "sampleRate": round(rate),
        "lastFrameIndex": next_index,
        "framesOnPort": views[0].frames,
    }
    for field, part, axis in layout.counts:
        fields[field] = views[part].shape[axis]
    for place in layout.places:
        view = views[place.part]
        if place.ear is not None:
            view = view.select(place.ear)
        if len(view.shape) > 2:
            view = view.swap_rows()
        fields[place.field] = view if place.present else _EMPTY
    return fields


def parameters(processors: Iterable[Processor]) -> Any:
    """Return the `rosAFE_parameters` message: an array for each of the original's kinds, in the order of creation."""
    import rosAFE.msg as messages

    def struct(processor: Processor) -> Any:
        struct_class = getattr(messages, ros_type(parameter_struct(processor.kind)))
        return struct_class(name=processor.name, **processor.values())

    return messages.rosAFE_parameters(**_by_kind(processors, struct))


def signals(processors: Iterable[Processor]) -> dict[str, list[Any]]:
    """Return the members of `rosAFE_dataObjSt`: the output of the original's kinds since the last getSignals."""

    def fields(processor: Processor) -> dict[str, Any]:
        new = processor.history.read_new("getSignals")
        return signal_fields(processor.kind, new.parts, new.next_index, new.signal.rate)

    return _by_kind(processors, fields)


def _by_kind(processors: Iterable[Processor], convert: Callable[[Processor], Any]) -> dict[str, list[Any]]:
    """Convert the processors of each of the original's kinds, in the order of creation."""
    arrays: dict[str, list[Any]] = {kind: [] for kind in CORE_REPRESENTATIONS}
    for processor in processors:
        if processor.kind in arrays:
            arrays[processor.kind].append(convert(processor))
    return arrays


def descriptions(processors: Iterable[Processor], node: str, input_values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the `rosAFE_processor` structs of all processors, in the order of creation.

    Parameters
    ----------
    processors : iterable of Processor
    node : str
        Full name of the node, such as ``/rosAFE``.
    input_values : mapping
        The parameters of InputProc that modifyParameter does not accept.
    """
    found = [processor.ask(lambda one: _description(one, node, input_values)) for processor in processors]
    return [description for description in found if description is not None]


def _description(processor: Processor, node: str, input_values: Mapping[str, Any]) -> dict[str, Any]:
    kind = processor.representation
    largest = max(range(len(kind.parts)), key=lambda part: len(kind.parts[part].axes))
    values = processor.values()
    if processor.parent is None:
        values.update(input_values)
    return {
        "name": processor.name,
        "kind": kind.kind,
        "request": kind.request,
        "upperDepName": "" if processor.parent is None else processor.parent.name,
        "port": kind.port,
        "topic": ros_names.port_topic(node, kind, processor.name),
        "rate": processor.rate,
        "shape": list(processor.output_shapes[largest]),
        "axes": list(kind.parts[largest].axes[:-1]),
        "parameters": [{"name": name, "value": format_value(value)} for name, value in values.items()],
    }


def representation(processor: Processor) -> list[dict[str, Any]]:
    """Return the `rosAFE_representation` structs of a processor's output since the last getRepresentation."""
    new_output = processor.history.read_new("getRepresentation")
    return [
        {
            "name": part.name,
            "rate": new_output.signal.rate,
            "lastFrameIndex": new_output.next_index,
            "axes": list(part.axes),
            "shape": list(view.shape),
            "data": view.array().ravel(),
        }
        for part, view in zip(processor.representation.parts, new_output.parts, strict=True)
    ]


def response(service: str, **outputs: Any) -> dict[str, Any]:
    """Return the response of a service, with arrays and dicts in place of lists and messages."""
    return {
        "response": serialization.response_class("rosAFE", service)(genom_success=True, genom_exdetail="", **outputs)
    }
