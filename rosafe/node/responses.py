"""What the node tells of its processors: getParameters and getSignals of the original's kinds, two services of all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from rosafe.component import serialization
from rosafe.interface import CORE_REPRESENTATIONS, format_value, ros_type
from rosafe.interface.rosafe import parameter_struct
from rosafe.node.ports import element, signal_fields
from rosafe.tree.processor import Processor


def parameters(processors: Iterable[Processor]) -> Any:
    """The `rosAFE_parameters` message: an array for each of the original's kinds, in the order of creation."""
    import rosAFE.msg as messages

    arrays: dict[str, list[Any]] = {kind: [] for kind in CORE_REPRESENTATIONS}
    for processor in processors:
        if processor.kind in arrays:
            struct = getattr(messages, ros_type(parameter_struct(processor.kind)))
            values = processor.values()
            arrays[processor.kind].append(struct(name=processor.name, **values))
    return messages.rosAFE_parameters(**arrays)


def signals(processors: Iterable[Processor]) -> dict[str, list[Any]]:
    """The members of `rosAFE_dataObjSt`: what the original's kinds put out since getSignals was called last."""
    arrays: dict[str, list[Any]] = {kind: [] for kind in CORE_REPRESENTATIONS}
    for processor in processors:
        if processor.kind in arrays:
            taken = processor.take("getSignals")
            fields = signal_fields(processor.kind, taken.parts, taken.next_index, taken.signal.rate)
            arrays[processor.kind].append(fields)
    return arrays


def descriptions(processors: Iterable[Processor], node: str, of_the_input: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The `rosAFE_processor` structs of all processors, in the order of creation.

    Parameters
    ----------
    processors : iterable of Processor
    node : str
        Full name of the node, such as ``/rosAFE``.
    of_the_input : mapping
        What InputProc was asked for, which modifyParameter does not take.
    """
    told = [processor.ask(lambda one: _description(one, node, of_the_input)) for processor in processors]
    return [description for description in told if description is not None]


def _description(processor: Processor, node: str, of_the_input: Mapping[str, Any]) -> dict[str, Any]:
    kind = processor.representation
    largest = max(range(len(kind.parts)), key=lambda part: len(kind.parts[part].axes))
    values = processor.values()
    if processor.parent is None:
        values.update(of_the_input)
    return {
        "name": processor.name,
        "kind": kind.kind,
        "request": kind.request,
        "upperDepName": "" if processor.parent is None else processor.parent.name,
        "port": kind.port,
        "topic": "/".join(filter(None, (node, kind.port, element(kind.kind, processor.name)))),
        "rate": processor.rate,
        "shape": list(processor.output_shapes[largest]),
        "axes": list(kind.parts[largest].axes[:-1]),
        "parameters": [{"name": name, "value": format_value(value)} for name, value in values.items()],
    }


def representation(processor: Processor) -> list[dict[str, Any]]:
    """The `rosAFE_representation` structs of what a processor put out since this was last asked for it."""
    taken = processor.take("getRepresentation")
    return [
        {
            "name": part.name,
            "rate": taken.signal.rate,
            "lastFrameIndex": taken.next_index,
            "axes": list(part.axes),
            "shape": list(view.shape),
            "data": view.array().ravel(),
        }
        for part, view in zip(processor.representation.parts, taken.parts, strict=True)
    ]


def response(service: str, **outputs: Any) -> dict[str, Any]:
    """The answer of a function, with arrays and dicts in the place of lists and messages."""
    return {
        "response": serialization.response_class("rosAFE", service)(genom_success=True, genom_exdetail="", **outputs)
    }
