"""The description of a component for clients: its services, parameters, ports and representations."""

from __future__ import annotations

from typing import Any

from rosafe.interface import KINDS, REQUIRED, ROSAFE, ComponentSpec, Parameter, Representation, Service
from rosafe.interface.rosafe import WHOLE_TREES


def describe_component(component: ComponentSpec, instance: str, node: str, name: str) -> dict[str, Any]:
    """Return the description of an `instance` of a component, the node of that full name, loaded under `name`."""
    return {
        "name": name,
        "component": component.name,
        "instance": instance,
        "node": node,
        "doc": component.doc,
        "services": {
            **{s.name: _describe_service(s, composite=False) for s in component.services},
            **{s.name: _describe_service(s, composite=s in WHOLE_TREES) for s in component.client_side_services},
        },
        "ports": {
            p.name: {
                "doc": p.doc,
                "type": p.idl,
                "multiple": p.multiple,
                "output": p.output,
                "aliases": list(p.aliases),
            }
            for p in component.ports
        },
        "exceptions": {f"::{component.name}::{short}": doc for short, doc in component.exceptions.items()},
        "representations": {kind: _describe_representation(r) for kind, r in KINDS.items() if component is ROSAFE},
    }


def _describe_service(service: Service, composite: bool) -> dict[str, Any]:
    return {
        "doc": service.doc,
        "activity": service.activity,
        "composite": composite,
        "aliases": list(service.aliases),
        "parameters": {p.name: describe_parameter(p) for p in service.parameters},
        "outputs": dict(service.outputs),
        "throws": list(service.throws),
    }


def _describe_representation(representation: Representation) -> dict[str, Any]:
    return {
        "word": representation.word,
        "aliases": list(representation.word_aliases),
        "request": representation.request,
        "port": representation.port,
        "parent": representation.parent,
        "name": representation.name,
        "binaural": representation.binaural,
        "parts": {part.name: {"axes": list(part.axes), "unit": part.unit} for part in representation.parts},
        "parameters": [p.name for p in representation.parameters],
        "derived": [d.name for d in representation.derived],
        "coordinates": list(representation.coordinates),
        "features": list(representation.features),
    }


def describe_parameter(parameter: Parameter) -> dict[str, Any]:
    """Return the description of a parameter in the interface table."""
    required = parameter.default is REQUIRED
    return {
        "type": parameter.idl,
        "doc": parameter.doc,
        "required": required,
        "default": "" if required else parameter.default,
        "range": parameter.range_text,
        "choices": list(parameter.choices),
        "unit": parameter.unit,
        "aliases": list(parameter.aliases),
    }
