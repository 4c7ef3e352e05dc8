"""The reference of all requests as Markdown: docs/parameters.md."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from rosafe.declarations.idl import ros_type
from rosafe.declarations.parameter import REQUIRED, Parameter
from rosafe.declarations.representation import Representation

from .service import ComponentSpec, PortSpec, Service

HEAD = """# Requests, parameters and ports

Made from the interface table by `python3 -m rosafe.interface`.

* Every request is a ROS service `/<component>/<Request>`; an *activity* is an action of that name as well, which
  answers when the activity ends.
* ROS requests carry no defaults: an empty string, an empty list and a zero in a numeric field mean the default. (bass's
  sampleRate is the exception: 0 has a meaning.) `modifyParameter`, `rosafe.process` and, since they have filled in the
  defaults themselves, genomixd's clients (Tcl, MATLAB, HTTP) and `rosafe request` mean every value as it is.
* Every answer begins with `bool genom_success` and `string genom_exdetail`, such as
  `{"ex":"::rosAFE::e_noData","what":"the Audio port is not connected: call connect_port first"}`; `what`, the reason
  for people, is a member of `detail` where the exception has one of that name.
* Unknown words in a string with a choice become the default at the node, as in the original, with a warning in its log,
  in `/diagnostics` and for genomixd's clients. `rosAFE-ros --strict`, or the ROS parameter `/rosAFE/strict_words` (any
  time), has them refused with `e_badNewValue`. The kinds that the original did not have, `rosafe request` and
  `rosafe.process` always refuse them.
"""


def markdown(components: Iterable[ComponentSpec], kinds: Mapping[str, Representation]) -> str:
    """The whole document."""
    lines = [HEAD]
    for component in components:
        lines += _component(component, kinds)
    return "\n".join(lines)


def _component(component: ComponentSpec, kinds: Mapping[str, Representation]) -> Iterator[str]:
    yield f"## {component.name}\n"
    yield f"{component.doc}.\n"
    for service in component.on_graph:
        yield from _service(component, service, kinds)
    yield f"### Ports of {component.name}\n"
    rows = [(_topic(component, port), f"`{ros_type(port.idl)}`", _port_doc(port)) for port in component.ports]
    yield _table(("port", "type", "what it carries"), rows)
    yield f"### Exceptions of {component.name}\n"
    yield _table(
        ("exception", "meaning"),
        [(f"`::{component.name}::{name}`", meaning) for name, meaning in component.exceptions.items()],
    )


def _service(component: ComponentSpec, service: Service, kinds: Mapping[str, Representation]) -> Iterator[str]:
    yield f"### {service.name}" + (" (activity)" if service.activity else "") + "\n"
    yield f"{service.doc}.\n"
    if service.parameters:
        yield _table(("parameter", "type", "default", "allowed", "meaning"), [_row(p) for p in service.parameters])
    for kind in kinds.values():
        if kind.request == service.name and not set(kind.parameters) <= set(service.parameters):
            yield "Only by `modifyParameter`, or in `rosafe.process`:\n"
            yield _table(("parameter", "type", "default", "allowed", "meaning"), [_row(p) for p in kind.parameters])
    if service.outputs:
        yield "Answers with " + ", ".join(f"`{name}` ({_type(idl)})" for name, idl in service.outputs) + ".\n"
    if service.throws:
        yield "Exceptions: " + ", ".join(f"`{ex}`" for ex in service.throws) + ".\n"


def _row(parameter: Parameter) -> tuple[str, ...]:
    default = "required" if parameter.default is REQUIRED else f"`{_text(parameter.default)}`"
    return f"`{parameter.name}`", _type(parameter.idl), default, parameter.range_text, parameter.doc


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_text, value)) + "]"
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def _type(idl: str) -> str:
    return f"`{ros_type(idl)}`"


def _topic(component: ComponentSpec, port: PortSpec) -> str:
    name = f"/{component.name}/{port.name}" + ("/<name>" if port.multiple else "")
    return f"`{name}`" if port.output else f"`{port.name}` (input, see connect_port)"


def _port_doc(port: PortSpec) -> str:
    return port.doc + ("; one topic per processor" if port.multiple else "")


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
