"""`python3 -m rosafe.interface`: write all files that are derived from the interface table."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import rosafe
from rosafe.declarations.idl import ros_type
from rosafe.declarations.parameter import REQUIRED, Parameter, format_value
from rosafe.declarations.representation import Representation
from rosafe.representations.registry import builtin_stages

from . import BASS, citing, files, functions
from .remarks import PRESETS
from .rosafe import derive
from .service import ComponentSpec, PortSpec, Service

ROOT = Path(__file__).parents[2]


def main(argv: list[str] | None = None) -> int:
    """Write the files and list those that changed; with ``--check`` only list them, and return 1 if there are any."""
    parser = argparse.ArgumentParser(
        prog="python3 -m rosafe.interface",
        description="Write the .msg, .srv and .action files of ROS 1, their lists in CMakeLists.txt, "
        "docs/parameters.md, docs/citing.md and rosafe/__init__.pyi.",
        epilog="example: python3 -m rosafe.interface --check",
    )
    parser.add_argument("--check", action="store_true", help="write nothing, only list the files that are out of date")
    options = parser.parse_args(argv)
    kinds = {kind: stage.REPRESENTATION for kind, stage in builtin_stages().items()}  # without the user's plugins
    components = (derive(kinds), BASS)
    expected = files.all_files(ROOT, components)
    expected[ROOT / "docs" / "parameters.md"] = parameters_page(components, kinds)
    expected[ROOT / "docs" / "citing.md"] = citing.markdown(kinds)
    expected[ROOT / "rosafe" / "__init__.pyi"] = functions.stub(kinds, rosafe._MODULES, rosafe.__all__)
    stale = files.stale(expected)
    for path in stale:
        print(path.relative_to(ROOT))
    if options.check:
        return 1 if stale else 0
    files.write(expected)
    return 0


# --- docs/parameters.md -------------------------------------------------------------------------------------------


def parameters_page(components: Iterable[ComponentSpec], kinds: Mapping[str, Representation]) -> str:
    """Return docs/parameters.md."""
    lines = [Path(__file__).with_name("parameters_head.md").read_text("utf-8")]
    for component in components:
        lines += _component(component, kinds)
    return "\n".join([*lines, *_presets()])


def _presets() -> Iterator[str]:
    yield Path(__file__).with_name("parameters_presets.md").read_text("utf-8").rstrip("\n")
    for name, values in PRESETS.items():
        yield from (f"| `{name}` | `{parameter}` | {format_value(value)} |" for parameter, value in values.items())
    yield ""


def _component(component: ComponentSpec, kinds: Mapping[str, Representation]) -> Iterator[str]:
    yield f"## {component.name}\n"
    yield f"{component.doc}.\n"
    for service in component.on_graph:
        yield from _service(component, service, kinds)
    yield f"### Ports of {component.name}\n"
    rows = [(_topic(component, port), f"`{ros_type(port.idl)}`", _port_doc(port)) for port in component.ports]
    yield _table(("port", "type", "content"), rows)
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
            yield "Only with `modifyParameter` or in `rosafe.process`:\n"
            yield _table(("parameter", "type", "default", "allowed", "meaning"), [_row(p) for p in kind.parameters])
    if service.outputs:
        yield "Returns " + ", ".join(f"`{name}` ({_type(idl)})" for name, idl in service.outputs) + ".\n"
    if service.throws:
        yield "Exceptions: " + ", ".join(f"`{ex}`" for ex in service.throws) + ".\n"


def _row(parameter: Parameter) -> tuple[str, ...]:
    text = _text(parameter.default)
    default = "required" if parameter.default is REQUIRED else f"`{text}`" if text else "empty"
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


if __name__ == "__main__":
    sys.exit(main())
